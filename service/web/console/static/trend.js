// One chart of trends: a line for each quantity's mean, a band from least to greatest, its limits.

const DASHES = { watch: [2, 4], warning: [6, 4], critical: [] };
const DAY_S = 86400;
const LABEL_PX = 16;

// Room for half of a label at the top and at the right end of an axis.
const PADDING = [12, 32, 0, 0];
const MARK_PX = 16;

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function twoDigits(value) {
  return String(value).padStart(2, "0");
}

// UTC with the day of the year, as everywhere in the console.
export function utc(seconds, withSeconds = true) {
  const moment = new Date(seconds * 1000);
  const text = moment.toISOString();
  return `${text.slice(0, 10)} (${dayOfYear(moment)}) ${text.slice(11, withSeconds ? 19 : 16)}`;
}

function dayOfYear(moment) {
  const first = Date.UTC(moment.getUTCFullYear(), 0, 1);
  return String(Math.floor((moment.getTime() - first) / (DAY_S * 1000)) + 1).padStart(3, "0");
}

// Ticks: the time of day within a day, day of the year beyond; the year where it begins.
function tickLabels(_, splits, __, ___, step) {
  let before = "";
  return splits.map((seconds) => {
    const moment = new Date(seconds * 1000);
    const day = `${moment.getUTCFullYear()}-${dayOfYear(moment)}`;
    if (step >= DAY_S) return day;
    const clock = `${twoDigits(moment.getUTCHours())}:${twoDigits(moment.getUTCMinutes())}`;
    const label = step < 60 ? `${clock}:${twoDigits(moment.getUTCSeconds())}` : clock;
    const shown = day === before ? label : `${label}\n${day}`;
    before = day;
    return shown;
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
  return Math.ceil(Math.max(40, ...widths) + axis.ticks.size + axis.gap + 4);
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
  const labels = [];
  // A label is above its line, or below it if there is no room.
  const isHigh = (y) => y - bbox.top < LABEL_PX * devicePixelRatio;
  const shown = lines.map((line) => ({ ...line, y: chart.valToPos(line.value, "y", true) }));
  for (const { severity, text, y } of shown.sort((a, b) => b.y - a.y)) {
    if (y < bbox.top || y > bbox.top + bbox.height) continue;
    ctx.setLineDash(DASHES[severity].map((each) => each * devicePixelRatio));
    ctx.beginPath();
    ctx.moveTo(bbox.left, y);
    ctx.lineTo(bbox.left + bbox.width, y);
    ctx.stroke();
    // Lines that are close to each other share a label.
    const last = labels.at(-1);
    if (last && last.y - y < (isHigh(y) ? 2 : 1) * LABEL_PX * devicePixelRatio) last.text += `, ${text}`;
    else labels.push({ text, y });
  }
  for (const { text, y } of labels) {
    ctx.textBaseline = isHigh(y) ? "top" : "bottom";
    ctx.fillText(text, bbox.left + 4 * devicePixelRatio, y + (isHigh(y) ? 3 : -2) * devicePixelRatio);
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

// Tells the page the time of a click; the end of a drag is none.
function reportClicks(chart) {
  let pressedAt = null;
  chart.over.addEventListener("mousedown", (event) => (pressedAt = event.clientX));
  chart.over.addEventListener("click", (event) => {
    if (pressedAt === null || Math.abs(event.clientX - pressedAt) > 3) return;
    const seconds = chart.posToVal(event.clientX - chart.over.getBoundingClientRect().left, "x");
    document.dispatchEvent(new CustomEvent("moment", { detail: seconds }));
  });
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
    new ResizeObserver(() => this.chart?.setSize(this.size())).observe(holder);
  }

  size() {
    return { width: this.holder.clientWidth, height: this.holder.clientHeight };
  }

  show(history, start, end, annotations = []) {
    this.history = history;
    this.annotations = annotations;
    this.bounds = [start, end];
    const { quantities } = this.definition;
    const known = quantities.filter((each) => history.series[each.name]?.count.some((count) => count > 0));
    this.chart?.destroy();
    this.chart = null;
    this.holder.replaceChildren();
    if (!known.length) {
      const note = document.createElement("p");
      note.className = "chart-note";
      note.textContent = history.unix_s.length ? "No batch here has a value of this quantity." : "No batches in this period.";
      this.holder.append(note);
      this.readout.textContent = "\u00a0";
      return;
    }
    const { moments, pick } = withGaps(history);
    const scale = this.definition.percent ? 100 : 1;
    const scaled = (values) => pick(values).map((value) => (value === null || value === undefined ? null : value * scale));
    const data = [moments];
    for (const { name } of known) {
      const { mean, min, max } = history.series[name];
      data.push(scaled(mean), scaled(min), scaled(max));
    }
    this.data = data;
    this.known = known;
    this.chart = new uPlot(this.options(known), data, this.holder);
    this.describe();
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
    const scale = this.definition.percent ? 100 : 1;
    const names = known.map(({ name }) => name);
    const lines = merged(limitLines(this.limits, names), names).map((line) => ({ ...line, value: line.value * scale }));
    return {
      ...this.size(),
      padding: this.annotations.length ? [MARK_PX, ...PADDING.slice(1)] : PADDING,
      tzDate: (seconds) => uPlot.tzDate(new Date(seconds * 1000), "Etc/UTC"),
      legend: { show: false },
      cursor: { sync: { key: this.group }, drag: { x: true, y: false, setScale: false }, points: { size: 6 }, bind: { dblclick: () => () => this.onZoom(null) } },
      scales: { x: { time: true, range: () => this.bounds }, y: { range: (_, low, high) => this.range(low, high, lines) } },
      series,
      bands,
      axes: [
        { ...axis, values: tickLabels, space: 70, size: 40 },
        { ...axis, size: labelWidth, values: (_, splits) => splits.map((value) => `${+value.toPrecision(6)}${this.definition.unit}`) },
      ],
      hooks: {
        ready: [reportClicks],
        drawAxes: [(chart) => drawAnnotations(chart, this.annotations)],
        draw: [(chart) => drawLimits(chart, lines), ({ bbox }) => this.definition.bars?.align(bbox.left / devicePixelRatio, bbox.width / devicePixelRatio)],
        setSelect: [(chart) => chart.select.width > 4 && this.onZoom([chart.posToVal(chart.select.left, "x"), chart.posToVal(chart.select.left + chart.select.width, "x")])],
        setCursor: [(chart) => this.read(chart.cursor.idx)],
      },
    };
  }

  // Zero belongs to the picture of what cannot be negative; limits near the data are shown too.
  range(low, high, lines) {
    if (low === null) return [0, 1];
    const near = lines.map(({ value }) => value).filter((value) => Math.abs(value) <= Math.max(Math.abs(high), Math.abs(low)) * 3 || this.definition.percent);
    let [least, most] = [Math.min(low, ...near), Math.max(high, ...near)];
    if (least >= 0) least = 0;
    const room = (most - least || 1) * 0.08;
    return [least < 0 ? least - room : 0, this.definition.percent ? Math.min(100, most + room) : most + room];
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
      const [mean, min, max] = [1, 2, 3].map((each) => this.data[3 * k + each][index]);
      if (mean === null || mean === undefined) return `${label} –`;
      const spread = min === max ? "" : ` (${this.text(min)} to ${this.text(max)})`;
      return `${label} ${this.text(mean)}${spread}`;
    });
    this.readout.textContent = `${utc(this.data[0][index])} UTC: ${parts.join(", ")}`;
  }

  // The chart in words, for readers who cannot see it; and the key of its lines.
  describe() {
    const values = this.known.map(({ label }, k) => {
      const greatest = Math.max(...this.data[3 * k + 3].filter((value) => value !== null));
      const at = this.data[0][this.data[3 * k + 3].indexOf(greatest)];
      return `${label}: greatest ${this.text(greatest)} at ${utc(at)} UTC`;
    });
    this.legend = this.known.map(({ label, dash }) => `${dash ? "╌" : "━"} ${label}`).join("   ") + "; shaded: least to greatest";
    this.readout.textContent = this.legend;
    const marked = this.annotations.length ? `; ${this.definition.marks ?? "annotations"}: ${this.annotations.length}, listed below` : "";
    this.holder.setAttribute("aria-label", `${this.definition.title}. ${values.join("; ")}${marked}`);
  }
}
