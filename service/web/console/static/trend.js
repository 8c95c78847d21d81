// One chart of trends: a line for each quantity's mean, a band from least to greatest, its limits.

import { element } from "./actions.js";
import { DAY_S, dayOfYear, twoDigits, utc } from "./times.js";

const DASHES = { watch: [2, 4], warning: [6, 4], critical: [] };
const TONES = ["--other-1", "--other-2", "--other-3", "--other-4"];
const LABEL_PX = 16;
// So wide are the axes of neighbouring charts, so that their times stand below each other.
const LEAST_AXIS_PX = 58;
// Beyond so many times what lasts, a value is marked at the edge.
const OUTLIER = 3;
const NEARLY_ALL = 0.98;

// Room for half of a label at the top and at the right end of an axis.
const PADDING = [12, 48, 0, 0];
const MARK_PX = 16;

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

const toneOf = ({ shift }, k) => (shift ? "--soft" : TONES[k % TONES.length]);

// The mark of a line before its name, in the line's colour.
function mark(tone, dash) {
  return element("span", { className: tone.slice(2), ariaHidden: "true" }, dash ? "╌ " : "━ ");
}

// Ticks: the time of day, where a day begins its date below; the day of the year below the date.
function tickLabels(_, splits, __, ___, step) {
  let before = "";
  return splits.map((seconds) => {
    const moment = new Date(seconds * 1000);
    const day = `${moment.toISOString().slice(0, 10)}\n(${dayOfYear(moment)})`;
    if (step >= DAY_S) return day;
    const clock = `${twoDigits(moment.getUTCHours())}:${twoDigits(moment.getUTCMinutes())}`;
    const label = step < 60 ? `${clock}:${twoDigits(moment.getUTCSeconds())}` : clock;
    const shown = day === before ? label : `${label}\n${day}`;
    before = day;
    return shown;
  });
}

// Medians of five neighbours: they leave out what is alone, and keep a step.
function lasting(values) {
  const known = values.filter((value) => value !== null && value !== undefined).map(Math.abs);
  return known.map((_, k) => {
    const near = known.slice(Math.max(0, k - 2), k + 3).sort((a, b) => a - b);
    return near[(near.length - 1) >> 1];
  });
}

function limitLines(limits, quantities) {
  const lines = [];
  for (const { quantity, settings } of limits) {
    if (!settings.enabled || !quantities.includes(quantity)) continue;
    for (const severity of Object.keys(DASHES)) {
      for (const bound of ["low", "high"]) {
        const value = settings[severity]?.[bound];
        if (value !== null && value !== undefined) lines.push({ severity, value, quantity });
      }
    }
  }
  return lines;
}

// The width of the longest label, so that none is cut off.
function labelWidth(chart, labels, index, cycle) {
  const axis = chart.axes[index];
  if (cycle > 1) return axis._size;
  chart.ctx.font = axis.font[0];
  const widths = (labels ?? []).map((label) => chart.ctx.measureText(label).width / devicePixelRatio);
  return Math.ceil(Math.max(LEAST_AXIS_PX - axis.ticks.size - axis.gap - 4, ...widths) + axis.ticks.size + axis.gap + 4);
}

// Bounds that several quantities share are one line, named after the severity alone.
function merged(lines, names) {
  const places = new Map();
  for (const { severity, value, quantity } of lines) {
    const key = `${severity} ${value}`;
    const place = places.get(key) ?? { severity, value, quantities: new Set() };
    place.quantities.add(quantity);
    places.set(key, place);
  }
  return [...places.values()].map(({ severity, value, quantities }) => {
    const whose = quantities.size < names.length ? `, ${[...quantities].map((name) => name.split("_")[0]).join(", ")}` : "";
    return { severity, value, text: severity + whose };
  });
}

function drawLimits(chart, lines) {
  const { ctx, bbox } = chart;
  ctx.save();
  ctx.strokeStyle = ctx.fillStyle = colour("--limit");
  ctx.textAlign = "left";
  ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
  const px = devicePixelRatio;
  let last = null;
  // A label is above its line, or below it if there is no room.
  const isHigh = (y) => y - bbox.top < LABEL_PX * px;
  const shown = lines.map((line) => ({ ...line, y: chart.valToPos(line.value, "y", true) }));
  for (const { severity, text, y } of shown.sort((a, b) => b.y - a.y)) {
    if (y < bbox.top || y > bbox.top + bbox.height) continue;
    ctx.setLineDash(DASHES[severity].map((each) => each * devicePixelRatio));
    ctx.beginPath();
    ctx.moveTo(bbox.left, y);
    ctx.lineTo(bbox.left + bbox.width, y);
    ctx.stroke();
    // The labels of lines that are close to each other stand side by side.
    const isClose = last !== null && last.y - y < (isHigh(y) ? 2 : 1) * LABEL_PX * px;
    const x = isClose ? last.right : bbox.left + 4 * px;
    ctx.textBaseline = isHigh(y) ? "top" : "bottom";
    ctx.fillText(text, x, y + (isHigh(y) ? 3 : -2) * px);
    last = { y, right: x + ctx.measureText(text).width + 12 * px };
  }
  ctx.restore();
}

// A triangle at the edge for every point beyond it.
function drawBeyond(chart, data, quantities) {
  const { ctx, bbox } = chart;
  const { min: least, max: most } = chart.scales.y;
  const px = devicePixelRatio;
  ctx.save();
  ctx.fillStyle = colour("--accent");
  for (let k = 0; k < quantities; k++) {
    if (!chart.series[3 * k + 1].show) continue;
    data[0].forEach((seconds, index) => {
      const isAbove = data[3 * k + 3][index] > most;
      const isBelow = data[3 * k + 2][index] !== null && data[3 * k + 2][index] < least;
      if (!isAbove && !isBelow) return;
      const x = chart.valToPos(seconds, "x", true);
      const [y, way] = isAbove ? [bbox.top, 1] : [bbox.top + bbox.height, -1];
      ctx.beginPath();
      ctx.moveTo(x, y);
      ctx.lineTo(x - 4 * px, y + 7 * way * px);
      ctx.lineTo(x + 4 * px, y + 7 * way * px);
      ctx.fill();
    });
  }
  ctx.restore();
}

// A line at the beginning of each annotation, a shade for its period, its number above.
function drawAnnotations(chart, annotations) {
  const { ctx, bbox } = chart;
  const px = devicePixelRatio;
  const right = bbox.left + bbox.width;
  const marks = [];
  ctx.save();
  ctx.font = `${11 * px}px system-ui, sans-serif`;
  ctx.textAlign = "left";
  ctx.textBaseline = "bottom";
  for (const { number, start, end } of annotations) {
    const from = chart.valToPos(start, "x", true);
    const to = end === null ? from : chart.valToPos(end, "x", true);
    if (to < bbox.left || from > right) continue;
    const left = Math.max(from, bbox.left);
    ctx.fillStyle = colour("--shade");
    ctx.fillRect(left, bbox.top, Math.min(to, right) - left, bbox.height);
    ctx.strokeStyle = colour("--ink");
    ctx.lineWidth = px;
    ctx.beginPath();
    ctx.moveTo(left, bbox.top - 3 * px);
    ctx.lineTo(left, bbox.top + bbox.height);
    ctx.stroke();
    marks.push({ left, number });
  }
  ctx.fillStyle = colour("--ink");
  for (const { left, text } of joined(marks.sort((a, b) => a.left - b.left), (text) => ctx.measureText(text).width + 4 * px)) {
    ctx.fillText(text, Math.min(left, right - ctx.measureText(text).width), bbox.top - 3 * px);
  }
  ctx.restore();
}

// Numbers that would overlap become one text.
function joined(marks, width) {
  const groups = [];
  for (const { left, number } of marks) {
    const last = groups.at(-1);
    if (!last || left > last.left + width(last.text)) groups.push({ left, numbers: [number], text: String(number) });
    else {
      last.numbers.push(number);
      last.text = last.numbers.length === 2 ? last.numbers.join(",") : `${last.numbers[0]}…${number}`;
    }
  }
  return groups;
}

// Tells the page the time of a click and the bin there; the end of a drag is none.
function reportClicks(chart, width) {
  let pressedAt = null;
  chart.over.addEventListener("mousedown", (event) => (pressedAt = event.clientX));
  chart.over.addEventListener("click", (event) => {
    if (pressedAt === null || Math.abs(event.clientX - pressedAt) > 3) return;
    const seconds = chart.posToVal(event.clientX - chart.over.getBoundingClientRect().left, "x");
    reportMoment(seconds, chart.data[0][chart.cursor.idx] ?? seconds, width);
  });
}

function reportMoment(seconds, middle, width) {
  document.dispatchEvent(new CustomEvent("moment", { detail: { seconds, start: middle - width / 2, end: middle + width / 2 } }));
}

// The usual time from a bucket with batches to the next: batches may come less often than buckets.
function usualStep({ unix_s: starts, bucket_s: width }) {
  const steps = starts.slice(1).map((start, index) => start - starts[index]).sort((a, b) => a - b);
  return Math.max(width, steps[Math.floor(steps.length / 2)] ?? 0);
}

// Values of a quantity, with a gap of one point wherever buckets are missing.
function withGaps(history) {
  const moments = [];
  const places = [];
  const width = history.bucket_s;
  const step = usualStep(history);
  history.unix_s.forEach((start, index) => {
    if (index && start - history.unix_s[index - 1] > 1.5 * step) {
      moments.push(history.unix_s[index - 1] + width);
      places.push(null);
    }
    moments.push(start + width / 2);
    places.push(index);
  });
  return { moments, pick: (values) => places.map((place) => (place === null ? null : values[place])) };
}

export class Trend {
  constructor(holder, readout, definition, limits, group, onZoom) {
    Object.assign(this, { holder, readout, definition, limits, group, onZoom });
    this.chart = null;
    this.vertical = "robust";
    this.hidden = new Set();
    // Enter on a chart is a click on the point that was read last.
    holder.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" || !this.chart) return;
      const middle = this.data[0][this.chart.cursor.idx ?? this.data[0].length - 1];
      reportMoment(middle, middle, this.history.bucket_s ?? 1);
    });
    new ResizeObserver(() => this.chart?.setSize(this.size())).observe(holder);
  }

  size() {
    return { width: this.holder.clientWidth, height: this.holder.clientHeight };
  }

  // The quantities of which a history has values.
  valued({ series }) {
    return this.definition.quantities.filter((each) => series[each.name]?.mean.some((value) => value !== null));
  }

  // `others` are histories of further spacecraft, of which the first quantity is drawn.
  show(history, start, end, annotations = [], others = []) {
    this.history = history;
    this.others = others;
    this.annotations = annotations;
    this.bounds = [start, end];
    const known = this.valued(history);
    this.chart?.destroy();
    this.chart = null;
    this.holder.replaceChildren();
    if (!known.length) {
      const note = history.unix_s.length ? "No batch here has a value of this quantity." : "No batches in this period.";
      this.holder.append(element("p", { className: "chart-note" }, note));
      this.readout.textContent = "\u00a0";
      return;
    }
    const { moments, pick } = withGaps(history);
    this.moments = new Set(moments);
    const scale = this.definition.percent ? 100 : 1;
    const scaled = (values) => pick(values).map((value) => (value === null || value === undefined ? null : value * scale));
    let data = [moments];
    for (const { name } of known) {
      const { mean, min, max } = history.series[name];
      data.push(scaled(mean), scaled(min), scaled(max));
    }
    const beside = others.map((other) => {
      const own = withGaps(other);
      return [own.moments, own.pick(other.series[known[0].name].mean).map((value) => (value === null || value === undefined ? null : value * scale))];
    });
    if (beside.length) data = uPlot.join([data, ...beside]);
    this.data = data;
    this.known = known;
    this.described = false;
    this.chart = new uPlot(this.options(known), data, this.holder);
  }

  options(known) {
    const grid = { stroke: colour("--line"), width: 1 };
    const axis = { stroke: colour("--soft"), grid, ticks: grid, font: "11px system-ui, sans-serif" };
    const series = [{}];
    const bands = [];
    for (const { tone, dash } of known) {
      const stroke = colour(tone);
      const first = series.length;
      const points = { show: (_, __, from, to) => to - from < 60, size: 4, fill: stroke, stroke };
      series.push({ stroke, width: 1.6, dash, points }, { stroke: "transparent", points: { show: false } }, { stroke: "transparent", points: { show: false } });
      bands.push({ series: [first + 2, first + 1], fill: `color-mix(in srgb, ${stroke} 20%, transparent)` });
    }
    known.forEach(({ name }, k) => {
      for (let part = 1; part <= 3; part++) series[3 * k + part].show = !this.hidden.has(name);
    });
    this.others.forEach((each, k) => series.push({ stroke: colour(toneOf(each, k)), width: 1.3, spanGaps: true, points: { show: false } }));
    const scale = this.definition.percent ? 100 : 1;
    const names = known.map(({ name }) => name);
    const lines = merged(limitLines(this.limits, names), names).map((line) => ({ ...line, value: line.value * scale, text: `${line.text} ${this.text(line.value * scale)}` }));
    return {
      ...this.size(),
      padding: this.annotations.length ? [MARK_PX, ...PADDING.slice(1)] : PADDING,
      tzDate: (seconds) => uPlot.tzDate(new Date(seconds * 1000), "Etc/UTC"),
      legend: { show: false },
      cursor: { sync: { key: this.group }, drag: { x: true, y: false, setScale: false }, points: { size: 6 }, bind: { dblclick: () => () => this.onZoom(null) } },
      scales: { x: { time: true, range: () => this.bounds }, y: this.scale(lines) },
      series,
      bands,
      axes: [
        { ...axis, values: tickLabels, space: 74, size: 64 },
        { ...axis, size: labelWidth, values: (_, splits) => splits.map((value) => (value === null ? "" : `${+value.toPrecision(6)}${this.definition.unit}`)) },
      ],
      hooks: {
        ready: [(chart) => reportClicks(chart, this.history.bucket_s ?? 1)],
        drawAxes: [(chart) => drawAnnotations(chart, this.annotations)],
        draw: [(chart) => drawLimits(chart, lines), (chart) => drawBeyond(chart, this.data, known.length), (chart) => this.describe(chart), ({ bbox }) => this.definition.bars?.align(bbox.left / devicePixelRatio, bbox.width / devicePixelRatio)],
        setSelect: [(chart) => chart.select.width > 4 && this.onZoom([chart.posToVal(chart.select.left, "x"), chart.posToVal(chart.select.left + chart.select.width, "x")])],
        setCursor: [(chart) => this.read(chart.cursor.idx)],
      },
    };
  }

  // The vertical axis: `robust`, `all` values, or `log`.
  scale(lines) {
    const positive = this.shownValues().filter((value) => value > 0);
    if (this.vertical === "log" && positive.length && this.shownValues().every((value) => value >= 0)) {
      const [low, high] = [positive.reduce((a, b) => Math.min(a, b)), positive.reduce((a, b) => Math.max(a, b))];
      return { distr: 3, range: () => [10 ** Math.floor(Math.log10(low)), 10 ** Math.ceil(Math.log10(high) + 1e-9)] };
    }
    return { range: (_, low, high) => this.range(low, high, lines) };
  }

  // Means, least and greatest values of what is not hidden.
  shownColumns() {
    const columns = this.known.flatMap(({ name }, k) => (this.hidden.has(name) ? [] : [1, 2, 3].map((part) => this.data[3 * k + part])));
    return [...columns, ...this.data.slice(3 * this.known.length + 1)];
  }

  shownValues() {
    return this.shownColumns().flat().filter((value) => value !== null && value !== undefined);
  }

  // Zero belongs to the picture of what cannot be negative; limits near the data are shown too.
  // A few values far beyond all others do not flatten these: they are marked at the edge.
  range(low, high, lines) {
    if (low === null) return [0, 1];
    if (this.vertical !== "all" && !this.definition.percent) [low, high] = this.withoutOutliers(low, high);
    const near = lines.map(({ value }) => value).filter((value) => Math.abs(value) <= Math.max(Math.abs(high), Math.abs(low)) * 3 || this.definition.percent);
    let [least, most] = [Math.min(low, ...near), Math.max(high, ...near)];
    if (least >= 0) least = 0;
    const room = (most - least || 1) * 0.08;
    return [least < 0 ? least - room : 0, this.definition.percent ? Math.min(100, most + room) : most + room];
  }

  withoutOutliers(low, high) {
    const sizes = this.shownColumns().flatMap(lasting).sort((a, b) => a - b);
    const usual = sizes[Math.floor(NEARLY_ALL * (sizes.length - 1))] ?? 0;
    const edge = OUTLIER * usual;
    return usual > 0 ? [Math.max(low, -edge), Math.min(high, edge)] : [low, high];
  }

  text(value) {
    return value === null || value === undefined ? "–" : `${+value.toPrecision(3)}${this.definition.unit}`.replace("-", "−");
  }

  read(index) {
    if (index === null || index === undefined || this.data[0][index] === null) {
      this.readout.textContent = this.legend;
      return;
    }
    const parts = this.known.map(({ label }, k) => {
      // At a moment of another spacecraft alone the nearest own value is told.
      const at = this.moments.has(this.data[0][index]) ? index : this.nearest(3 * k + 1, index, this.history);
      const [mean, min, max] = [1, 2, 3].map((each) => this.data[3 * k + each][at]);
      const spread = at === undefined || mean === null || min === max ? "" : ` (${this.text(min)} to ${this.text(max)})`;
      return `${this.own}${label} ${this.text(mean)}${spread}`;
    });
    const beside = this.others.map((other, k) => {
      const column = 3 * this.known.length + 1 + k;
      return `${this.nameOf(other)} ${this.text(this.data[column][this.nearest(column, index, other)])}`;
    });
    this.readout.textContent = `${utc(this.data[0][index])} UTC: ${[...parts, ...beside].join(", ")}`;
    // A shorter text leaves the chart where it is below the pointer.
    this.readout.style.minHeight = `${this.readout.offsetHeight}px`;
  }

  // Spacecraft have times of their own: the place of a column's value nearest in time, within half the usual step of its history.
  nearest(column, index, history) {
    const [times, values] = [this.data[0], this.data[column]];
    let [found, least] = [undefined, usualStep(history) / 2];
    times.forEach((time, place) => {
      const away = Math.abs(time - times[index]);
      if ((values[place] ?? null) !== null && away <= least) [found, least] = [place, away];
    });
    return found;
  }

  get own() {
    return this.others.length ? `${this.history.spacecraft}: ` : "";
  }

  nameOf({ spacecraft, shift }) {
    return `${spacecraft}: ${this.known[0].label}${shift ? `, ${shift / DAY_S} d before` : ""}`;
  }

  // The chart in words, for readers who cannot see it; and the key of its lines.
  describe(chart) {
    // The range of a chart is known once it is drawn; later drawings have the same.
    if (this.described) return;
    this.described = true;
    const values = this.known.map(({ label }, k) => {
      const greatest = this.data[3 * k + 3].reduce((most, value) => Math.max(most, value ?? -Infinity), -Infinity);
      const at = this.data[0][this.data[3 * k + 3].indexOf(greatest)];
      return `${label}: greatest ${this.text(greatest)} at ${utc(at)} UTC`;
    });
    const { min: least, max: most } = chart.scales.y;
    const outside = (value) => value !== null && (value > most || value < least);
    const extremes = (index) => this.known.flatMap((_, k) => [this.data[3 * k + 3][index], this.data[3 * k + 2][index]].filter(outside));
    const beyond = this.data[0].map((_, index) => extremes(index)).filter((found) => found.length);
    const farthest = beyond.flat().reduce((a, b) => (Math.abs(b) > Math.abs(a) ? b : a), 0);
    const words = `${beyond.length} beyond the edge, the farthest ${this.text(farthest)}`;
    this.legend = beyond.length ? `▲ ${words}` : "\u00a0";
    this.readout.textContent = this.legend;
    this.drawKeys();
    const marked = this.annotations.length ? `; ${this.definition.marks ?? "annotations"}: ${this.annotations.length}, listed below` : "";
    this.holder.setAttribute("aria-label", `${this.definition.title}. ${values.join("; ")}${marked}${beyond.length ? `; ${words}` : ""}`);
  }

  // A button for each line of several, which hides it and shows it; names of several spacecraft.
  drawKeys() {
    const keys = this.holder.nextElementSibling?.matches(".chart-keys") ? this.holder.nextElementSibling : document.createElement("p");
    keys.className = "chart-keys range";
    const buttons = this.own || this.known.length > 1 ? this.known.map((each) => this.key(each)) : [];
    const names = this.others.map((each, k) => element("span", {}, mark(toneOf(each, k)), `${this.nameOf(each)}${each.unix_s.length ? "" : ", no batches then"}`));
    keys.replaceChildren(...buttons, ...names);
    keys.hidden = !keys.childElementCount;
    this.holder.after(keys);
    // The button that was pressed was replaced.
    keys.children[this.pressed ?? -1]?.focus({ preventScroll: true });
    this.pressed = null;
  }

  key({ name, label, tone, dash }) {
    const button = element("button", { type: "button", ariaPressed: String(!this.hidden.has(name)) }, mark(tone, dash), `${this.own}${label}`);
    button.addEventListener("click", () => {
      this.hidden.has(name) ? this.hidden.delete(name) : this.hidden.add(name);
      this.show(this.history, ...this.bounds, this.annotations, this.others);
      this.pressed = this.known.findIndex((each) => each.name === name);
    });
    return button;
  }
}
