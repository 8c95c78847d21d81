// Bars under a chart of trends: when alarms of its quantities were out of their limits.

import { element } from "./actions.js";
import { posix, utc } from "./times.js";
import { rooted } from "./requests.js";

const SHAPES = { watch: "△", warning: "▲", critical: "◆" };
const SEVERITIES = Object.keys(SHAPES);
const MOST_ROWS = 4;

export class AlarmBars {
  constructor(holder, quantities) {
    Object.assign(this, { holder, labels: new Map(quantities.map(({ name, label }) => [name, label])) });
  }

  // The left end and the width of the chart's own area, below which the bars stand.
  align(left, width) {
    this.holder.style.marginLeft = `${left}px`;
    this.holder.style.width = `${width}px`;
  }

  // A row for each quantity and tracker, with its name above: of the shown tracker, out now and the worst first.
  // The page of alarms has those beyond the last row.
  show(alarms, start, end) {
    const rows = new Map();
    const query = new URLSearchParams(location.search);
    const rank = ({ tracker, severity, end: until }) => 9 * (tracker !== null && tracker === query.get("tracker")) + 3 * (until === null) + SEVERITIES.indexOf(severity);
    const worst = ([, spans]) => Math.max(...spans.map(rank));
    for (const alarm of alarms) {
      if (!this.labels.has(alarm.quantity)) continue;
      const name = [...(alarm.tracker ? [alarm.tracker] : []), this.labels.get(alarm.quantity)].join(": ");
      rows.set(name, [...(rows.get(name) ?? []), alarm]);
    }
    this.holder.hidden = rows.size === 0;
    const shown = [...rows].reverse().sort((a, b) => worst(b) - worst(a)).slice(0, MOST_ROWS).map(([name, spans]) => {
      const track = element("div", { className: "track" }, ...spans.map((each) => this.bar(each, name, start, end)));
      return element("div", {}, element("p", {}, name), track);
    });
    if (rows.size > MOST_ROWS) {
      const listed = new URLSearchParams({ run: document.body.dataset.run, spacecraft: document.getElementById("charts").dataset.spacecraft, state: "all" });
      shown.push(element("p", {}, element("a", { href: rooted(`/alarms?${listed}`) }, `${rows.size - MOST_ROWS} more`)));
    }
    this.holder.replaceChildren(...shown);
  }

  bar({ id, severity, start: from, end: until }, name, start, end) {
    const part = (text) => Math.min(1, Math.max(0, (posix(text) - start) / (end - start)));
    const left = part(from);
    const right = until === null ? 1 : part(until);
    const run = new URLSearchParams(location.search).get("run");
    const title = `${severity}: ${name}, from ${utc(posix(from))} ${until === null ? "until now" : `to ${utc(posix(until))}`} UTC`;
    const href = rooted(`/alarms/${id}${run ? `?run=${encodeURIComponent(run)}` : ""}`);
    // A shape for which the bar is too narrow breaks to a line that is not seen.
    const bar = element("a", { href, title, ariaLabel: title, className: severity }, `\u200b${SHAPES[severity]}`);
    // A short bar at the end of the chart stays within it.
    bar.style.left = `min(${100 * left}%, 100% - 6px)`;
    bar.style.width = `${100 * (right - left)}%`;
    return bar;
  }
}
