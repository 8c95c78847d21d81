// Makes the definitive attitude of a period, and shows how far it is; charts are read and zoomed.
import { attempt, ended, rememberWho, send } from "./actions.js";
import { refreshSoon } from "./live_updates.js";
import { posix, utc } from "./times.js";

const form = document.getElementById("definitive");
const message = document.getElementById("message");
const bar = document.getElementById("definitive-progress");

function tell(job) {
  bar.hidden = false;
  bar.max = job.total || 1;
  bar.value = job.done;
  message.textContent = job.total ? `${job.done} of ${job.total} days.` : `${job.state}…`;
}

if (form) {
  rememberWho(form.elements.who);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const { start, end, who } = form.elements;
    const address = `/api/v1/spacecraft/${encodeURIComponent(form.dataset.spacecraft)}/definitive-attitude`;
    attempt(event.submitter, message, async () => {
      const wanted = { run: document.body.dataset.run, start: start.value.trim() || null, end: end.value.trim() || null, who: who.value.trim() };
      const { id } = await send("POST", address, JSON.stringify(wanted));
      const job = await ended(`${address}/${id}`, (each) => each.ended !== null, tell);
      bar.hidden = true;
      if (job.state !== "done") throw new Error(job.fault ?? job.state);
      refreshSoon();
      return `Done: ${job.recorded} of ${job.total} days have a new revision${job.fault ? `; ${job.fault}` : ""}.`;
    });
  });
}

// ---- charts -------------------------------------------------------------------------------------

// Units of a panel's width and of its empty ends, and how near a point must be to be read.
const [WIDTH, PAD, NEAR] = [1280, 10, 24];
const STEP = 0.01;
const LEAST_DRAG_PX = 6;
const pointsOf = new WeakMap();
let at = 0.5;
let pressed = null;

// The points of a path of moves and relative steps.
function points(path) {
  if (pointsOf.has(path)) return pointsOf.get(path);
  const found = [];
  let [x, y] = [0, 0];
  for (const [, kind, a, b] of path.getAttribute("d").matchAll(/([Ml])(-?\d+) (-?\d+)/g)) {
    [x, y] = kind === "M" ? [Number(a), Number(b)] : [x + Number(a), y + Number(b)];
    found.push([x, y]);
  }
  pointsOf.set(path, found);
  return found;
}

// The inverse of the scale on which the service drew the panel.
function valueOf(plot, y) {
  const [low, high, isLog, unit = ""] = plot.dataset.plot.split(" ");
  const [from, to] = [low, high].map((each) => (isLog === "1" ? Math.log(Number(each)) : Number(each)));
  const room = 0.04 * (to - from) || 1;
  const value = from - room + (1 - y / plot.viewBox.baseVal.height) * (to - from + 2 * room);
  return `${Number((isLog === "1" ? Math.exp(value) : value).toPrecision(4))}${unit}`;
}

function readings(plot, x) {
  const nearest = new Map();
  for (const path of plot.querySelectorAll(".value")) {
    const grade = path.classList[path.classList.length - 1];
    for (const [px, py] of points(path)) {
      const away = Math.abs(px - x);
      if (away <= NEAR && away < (nearest.get(grade)?.away ?? Infinity)) nearest.set(grade, { away, py });
    }
  }
  return [...nearest].map(([grade, { py }]) => `${grade} ${valueOf(plot, py)}`);
}

function period() {
  const { start, end } = document.getElementById("grades").dataset;
  return [posix(start), posix(end)];
}

function timeAt(share) {
  const [start, end] = period();
  const along = (share * WIDTH - PAD) / (WIDTH - 2 * PAD);
  return start + Math.min(Math.max(along, 0), 1) * (end - start);
}

// The same moment on every chart.
function read(share) {
  at = Math.min(Math.max(share, 0), 1);
  const seconds = timeAt(at);
  for (const plot of document.querySelectorAll("[data-plot]")) {
    const cross = plot.parentElement.querySelector(".cross");
    for (const end of ["x1", "x2"]) cross.setAttribute(end, `${100 * at}%`);
    cross.removeAttribute("visibility");
    const note = plot.closest(".plot").previousElementSibling.querySelector("[data-note]");
    note.dataset.before ??= note.textContent;
    note.textContent = `${utc(seconds).slice(-8)}: ${readings(plot, at * WIDTH).join(", ") || "no value"}`;
  }
}

function leave() {
  for (const cross of document.querySelectorAll(".cross")) cross.setAttribute("visibility", "hidden");
  for (const note of document.querySelectorAll("[data-note][data-before]")) note.textContent = note.dataset.before;
}

function shareOf(plot, event) {
  const { left, width } = plot.getBoundingClientRect();
  return (event.clientX - left) / width;
}

function zoom(one, other) {
  const address = new URL(location.href);
  address.searchParams.delete("range");
  const [from, to] = [timeAt(Math.min(one, other)), timeAt(Math.max(one, other))];
  address.searchParams.set("start", new Date(from * 1000).toISOString());
  address.searchParams.set("end", new Date(Math.max(to, from + 1) * 1000).toISOString());
  location.href = address;
}

const plotOf = (event) => event.target.closest?.("[data-plot]");
document.addEventListener("pointermove", (event) => {
  const plot = plotOf(event);
  if (plot) read(shareOf(plot, event));
  else if (!pressed && !document.activeElement?.matches("[data-plot]")) leave();
});
document.addEventListener("pointerdown", (event) => {
  const plot = plotOf(event);
  pressed = plot && event.pointerType === "mouse" ? { plot, x: event.clientX, share: shareOf(plot, event) } : null;
});
document.addEventListener("pointerup", (event) => {
  if (pressed && Math.abs(event.clientX - pressed.x) > LEAST_DRAG_PX) zoom(pressed.share, shareOf(pressed.plot, event));
  pressed = null;
});
document.addEventListener("dblclick", (event) => plotOf(event) && document.querySelector('[data-key="-"]')?.click());
document.addEventListener("keydown", (event) => {
  if (!plotOf(event)) return;
  const step = { ArrowLeft: -STEP, ArrowRight: STEP }[event.key];
  if (step) read(at + step);
  else if (event.key === "Escape") leave();
  else if (["+", "-"].includes(event.key)) document.querySelector(`[data-key="${event.key}"]`)?.click();
  else return;
  event.preventDefault();
});
