// From a point of the sky to its batch: by pointer, or with the arrow keys and Enter.
import { attempt } from "./actions.js";
import { requestJson, rooted } from "./requests.js";
import { posix, utc } from "./times.js";

// Pixels of the chart within which a point is meant.
const NEAR = 14;
let at = null;

const figure = () => document.getElementById("sky-figure");
const points = () => JSON.parse(figure().querySelector("[data-json]").content.textContent);

// The number of the point that is nearest to the pointer, or null.
function nearest(event) {
  const chart = figure().querySelector(".all-sky");
  const place = new DOMPoint(event.clientX, event.clientY).matrixTransform(chart.getScreenCTM().inverse());
  const away = points().map(([x, y]) => Math.hypot(x - place.x, y - place.y));
  // Of several batches at one place the latest.
  const best = away.lastIndexOf(Math.min(...away));
  return away[best] <= NEAR ? best : null;
}

function read(number) {
  if (number === at) return;
  at = number;
  const mark = figure().querySelector(".track-read");
  mark.setAttribute("visibility", at === null ? "hidden" : "visible");
  const status = document.getElementById("sky-status");
  status.className = "";
  status.textContent = "Select a point to open its batch.";
  if (at === null) return;
  const [x, y, time] = points()[at];
  mark.setAttribute("cx", x);
  mark.setAttribute("cy", y);
  status.textContent = `Batch at ${utc(posix(time))} UTC: select it to open it.`;
}

function open() {
  if (at === null) return;
  const [, , start] = points()[at];
  const { run } = document.body.dataset;
  const end = new Date(posix(start) * 1000 + 1000).toISOString();
  const query = new URLSearchParams({ run, spacecraft: figure().dataset.spacecraft, start, end });
  attempt(null, document.getElementById("sky-status"), async () => {
    const { items } = await requestJson(`/api/v1/batches?${query}`);
    // Those of one second are newest first.
    const found = items.find(({ time }) => time === start) ?? items.at(-1);
    location.href = rooted(`/batches/${found.id}`);
  });
}

const onChart = (event) => event.target.closest?.(".all-sky");
document.addEventListener("pointermove", (event) => onChart(event) && read(nearest(event)));
document.addEventListener("click", (event) => {
  if (!onChart(event)) return;
  read(nearest(event));
  open();
});
document.addEventListener("keydown", (event) => {
  if (!onChart(event)) return;
  const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (step) read(Math.min(Math.max((at ?? points().length) + step, 0), points().length - 1));
  else if (event.key === "Enter") open();
  else return;
  event.preventDefault();
});
