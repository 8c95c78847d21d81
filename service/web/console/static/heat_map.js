// A heat map of spacecraft and time on a canvas, from a byte for each cell: 0 is no batch, 1 the
// share 0, 255 the share 1.  Pointer or arrow keys read a cell; a click or Enter leads to it.

import { utc } from "./times.js";
import { rooted } from "./requests.js";

const TALLEST_PX = matchMedia("(max-width: 720px)").matches ? 100 : 240;
const MOST_ROW_PX = 14;
const NAMES_FROM_PX = 11;
// The worst rows, as many as have room for their names.
const MOST_NAMED = Math.floor(TALLEST_PX / 12);
const NAMES_PX = 120;
const CELLS_AROUND = 3;
const KEY_SHARES = [0, 0.05, 0.25, 0.5, 1];

const tone = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const channels = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
const moment = (seconds) => utc(seconds, false);
const percent = (level) => `${((100 * (level - 1)) / 254).toFixed(level > 26 ? 0 : 1)} %`;

// The root of the share: a few percent are told from none.
function palette() {
  const [from, to] = [channels(tone("--rail")), channels(tone("--accent"))];
  return Array.from({ length: 256 }, (_, level) => {
    const part = level < 2 ? 0 : 0.15 + 0.85 * Math.sqrt((level - 1) / 254);
    return `rgb(${from.map((each, k) => Math.round(each + part * (to[k] - each))).join(" ")})`;
  });
}

const bytes = (text) => Uint8Array.from(atob(text), (each) => each.charCodeAt(0));

// The quantity to show first: the one that was chosen last in this browser.
const FIRST = localStorage.getItem("heat") ?? "ambiguous_share";

export class HeatMap {
  constructor(section) {
    this.section = section;
    this.canvas = section.querySelector("canvas");
    this.choice = section.querySelector("select");
    this.readout = section.querySelector("#heat-readout");
    this.at = null;
    this.choice.addEventListener("change", () => this.choose());
    this.canvas.addEventListener("pointermove", (event) => this.read(this.cellAt(event)));
    this.canvas.addEventListener("pointerleave", () => this.read(null));
    this.canvas.addEventListener("click", (event) => this.open(this.cellAt(event)));
    this.canvas.addEventListener("keydown", (event) => this.press(event));
  }

  say(text) {
    this.readout.textContent = text;
  }

  // Draws what the page has now; without any cells the map is hidden.
  show(shown) {
    this.shown = shown;
    this.section.hidden = shown === null;
    if (shown === null) return;
    const asked = new URLSearchParams(location.search).get("heat") ?? (this.choice.value || FIRST);
    this.choice.replaceChildren(
      ...shown.quantities.map(({ name, label }) => new Option(label, name, false, name === asked)),
    );
    this.section.querySelector("h2").textContent = `Each spacecraft over the last ${shown.period}`;
    this.draw();
  }

  choose() {
    const address = new URL(location.href);
    address.searchParams.set("heat", this.choice.value);
    localStorage.setItem("heat", this.choice.value);
    history.replaceState(null, "", address);
    this.draw();
  }

  draw() {
    const { names, columns, start, width, quantities } = this.shown;
    const quantity = quantities[this.choice.selectedIndex] ?? quantities[0];
    this.cells = bytes(quantity.cells);
    this.rows = Math.min(names.length, MOST_NAMED);
    const row = Math.min(MOST_ROW_PX, Math.max(1, Math.floor(TALLEST_PX / this.rows)));
    const across = this.section.querySelector(".heat-axis").clientWidth;
    this.left = row >= NAMES_FROM_PX ? Math.min(NAMES_PX, across / 4) : 0;
    this.row = row;
    this.column = (across - this.left) / columns;
    const ratio = devicePixelRatio;
    this.canvas.width = across * ratio;
    this.canvas.height = this.rows * row * ratio;
    this.canvas.style.height = `${this.rows * row}px`;
    const ink = this.canvas.getContext("2d");
    ink.scale(ratio, ratio);
    const colours = palette();
    const gap = row > 4 ? 1 : 0;
    for (let k = 0; k < this.rows; k++) {
      for (let j = 0; j < columns; j++) {
        const level = this.cells[k * columns + j];
        if (level === 0) continue;
        ink.fillStyle = colours[level];
        const x = Math.round(this.left + j * this.column);
        const next = Math.round(this.left + (j + 1) * this.column);
        ink.fillRect(x, k * row, Math.max(next - x - (this.column > 6 ? 1 : 0), 1), row - gap);
      }
    }
    if (this.left) this.name(ink, names);
    this.tell(quantity, colours);
    this.section.querySelectorAll(".heat-axis span").forEach((each, k) => {
      each.textContent = moment(start + (k / 2) * columns * width);
    });
    this.section.querySelector(".heat-axis").style.paddingLeft = `${this.left}px`;
    this.section.dataset.drawn = String(names.length);
  }

  name(ink, names) {
    ink.fillStyle = tone("--soft");
    ink.font = "11px system-ui, sans-serif";
    ink.textBaseline = "middle";
    names.slice(0, this.rows).forEach((each, k) => ink.fillText(each, 0, (k + 0.5) * this.row, this.left - 6));
  }

  // The key, and in words what the picture shows.
  tell(quantity, colours) {
    const key = this.section.querySelector("#heat-key");
    key.replaceChildren("empty: no batch");
    for (const share of KEY_SHARES) {
      const mark = document.createElement("i");
      mark.style.background = colours[1 + Math.round(254 * share)];
      key.append(mark, `${100 * share} %`);
    }
    const { names, columns, start, width } = this.shown;
    const greatest = this.cells.reduce((best, each, k) => (each > this.cells[best] ? k : best), 0);
    const where = `${names[Math.floor(greatest / columns)]} at ${moment(start + (greatest % columns) * width)} UTC`;
    const most = this.cells[greatest] ? `; greatest ${percent(this.cells[greatest])}, ${where}` : "";
    this.canvas.setAttribute("aria-label", `${quantity.label} of ${names.length} spacecraft${most}`);
    this.label = quantity.label;
  }

  cellAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const j = Math.floor((event.clientX - box.left - this.left) / this.column);
    const k = Math.floor((event.clientY - box.top) / this.row);
    const inside = j >= 0 && j < this.shown.columns && k >= 0 && k < this.rows;
    return inside ? { k, j } : null;
  }

  read(at) {
    this.at = at;
    if (!at) return this.say("");
    const { names, columns, start, width } = this.shown;
    const level = this.cells[at.k * columns + at.j];
    const begin = start + at.j * width;
    const value = level ? `${percent(level)} ${this.label}` : "no batch";
    this.say(`${names[at.k]}, ${moment(begin)} to ${moment(begin + width).slice(17)} UTC: ${value}`);
  }

  // The spacecraft's trends about a cell.
  open(at) {
    if (!at) return;
    const { names, start, width } = this.shown;
    const text = (j) => new Date(1000 * (start + j * width)).toISOString();
    const address = new URL(rooted(`/spacecraft/${encodeURIComponent(names[at.k])}`), location.href);
    const run = new URLSearchParams(location.search).get("run");
    if (run) address.searchParams.set("run", run);
    address.searchParams.set("start", text(at.j - CELLS_AROUND));
    address.searchParams.set("end", text(at.j + 1 + CELLS_AROUND));
    location.href = address;
  }

  press(event) {
    const step = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }[event.key];
    if (event.key === "Enter") this.open(this.at);
    if (!step) return;
    event.preventDefault();
    const { columns } = this.shown;
    const from = this.at ?? { k: -step[0], j: columns - 1 - step[1] };
    const bound = (value, count) => Math.min(count - 1, Math.max(0, value));
    this.read({ k: bound(from.k + step[0], this.rows), j: bound(from.j + step[1], columns) });
  }
}
