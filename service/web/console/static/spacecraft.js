// The trends of one spacecraft: charts of the period in the address.
import { attempt, element } from "./actions.js";
import { annotationsShown } from "./annotations.js";
import { requestJson, rooted } from "./requests.js";
import { fetchPage, withoutReload } from "./regions.js";
import { AlarmBars } from "./alarm_bars.js";
import { posix, utc } from "./times.js";
import { Trend } from "./trend.js";

const stretch = () => document.getElementById("stretch");
const status = document.getElementById("charts-status");

const LINES = [{ tone: "--curve" }, { tone: "--soft", dash: [5, 4] }];

const menu = document.getElementById("other-chart");
const narrow = matchMedia("(max-width: 720px)").matches;
if (menu) menu.value = localStorage.getItem("other-chart") ?? (narrow ? "batches" : "");

let trends = [];
let asked = 0;
let shown = null;

const asText = (seconds) => new Date(seconds * 1000).toISOString();

function make() {
  const { limits, charts } = JSON.parse(document.querySelector("[data-json]").content.textContent);
  trends = charts.map(({ id, quantities, ...chart }) => {
    const holder = document.querySelector(`[data-chart="${id}"]`);
    const readout = document.querySelector(`[data-readout="${id}"]`);
    const lines = quantities.map((each, index) => ({ ...each, ...LINES[index % LINES.length] }));
    const bars = new AlarmBars(document.querySelector(`[data-bars="${id}"]`), quantities);
    return new Trend(holder, readout, { ...chart, quantities: lines, bars }, limits, "trends", zoom);
  });
}

async function draw() {
  const mine = ++asked;
  const { history, start, end, alarms, y, others, before, shift } = stretch().dataset;
  delete document.getElementById("charts").dataset.drawn;
  try {
    const wanted = [history, ...JSON.parse(others ?? "[]"), ...(before ? [before] : [])];
    const [found, ...beside] = await Promise.all(wanted.map((each) => requestJson(each)));
    if (mine !== asked) return;
    if (before) Object.assign(beside.at(-1), { unix_s: beside.at(-1).unix_s.map((each) => each + Number(shift)), shift: Number(shift) });
    shown = found;
    for (const trend of trends.filter((each) => isShown(each, found))) {
      trend.vertical = y ?? "robust";
      trend.show(shown, posix(start), posix(end), annotationsShown(), beside);
      trend.definition.bars.show(JSON.parse(alarms), posix(start), posix(end));
    }
    status.textContent = "";
    document.getElementById("charts").dataset.drawn = String(found.unix_s.length);
  } catch (error) {
    if (mine !== asked) return;
    tellFault(`The trends could not be read: ${error.message}. The page shows the previous ones.`);
  }
}

// Of the other charts one without a value is not drawn, nor one that the menu leaves out.
function isShown(trend, history) {
  const section = trend.holder.closest("#other-charts > section");
  if (!section) return true;
  const { chart } = trend.holder.dataset;
  const option = menu.querySelector(`[value="${chart}"]`);
  option.hidden = !trend.valued(history).length;
  section.hidden = option.hidden || ![chart, ""].includes(menu.value);
  return !section.hidden;
}

// A part of another page, below the link to it.
async function showPart(event) {
  const link = event.target.closest("[data-part]");
  if (!link || event.ctrlKey || event.metaKey) return;
  event.preventDefault();
  attempt(null, status, async () => {
    const fresh = await fetchPage(link.href);
    const part = fresh.getElementById(link.dataset.part);
    if (part === null) return "There are no batches in this period.";
    document.getElementById(part.id).replaceWith(document.adoptNode(part));
  });
}

function tellFault(text) {
  status.className = "problem";
  status.textContent = text;
}

const go = withoutReload(tellFault);

function zoom(bounds) {
  if (bounds === null) {
    const link = document.querySelector('[data-key="-"]');
    if (link) go(link.href);
    return;
  }
  const address = new URL(rooted(stretch().dataset.trends ?? location.href), location.href);
  address.searchParams.delete("range");
  address.searchParams.set("start", asText(bounds[0]));
  address.searchParams.set("end", asText(bounds[1]));
  // The chart of an alarm leads to the trends, which have controls.
  if (stretch().dataset.trends) location.href = address.href;
  else go(address.href);
}

// The batches about a point of a chart.
function linkTo({ start, end }) {
  const query = new URLSearchParams({ run: document.body.dataset.run, spacecraft: document.getElementById("charts").dataset.spacecraft, start: asText(start), end: asText(end) });
  status.className = "";
  status.replaceChildren(element("a", { href: rooted(`/batches?${query}`) }, `Batches from ${utc(start)} to ${utc(end)} UTC`));
}

// Of the list of spacecraft only those whose names hold the typed text are shown.
function narrowList() {
  const typed = document.querySelector("[data-narrow] input")?.value.trim().toLowerCase() ?? "";
  for (const each of document.querySelectorAll(".picks li")) each.hidden = !each.textContent.toLowerCase().includes(typed);
}

if (stretch()) {
  make();
  draw();
  document.addEventListener("click", showPart);
  menu?.addEventListener("change", () => {
    localStorage.setItem("other-chart", menu.value);
    draw();
  });
  document.addEventListener("keydown", (event) => {
    if (!event.target.matches?.("[data-chart]")) return;
    const link = document.querySelector(`[data-key="${CSS.escape(event.key)}"]`);
    if (!link) return;
    event.preventDefault();
    go(link.href);
  });
  document.addEventListener("moment", ({ detail }) => linkTo(detail));
  document.addEventListener("input", narrowList);
  document.addEventListener("drawn", narrowList);
  document.addEventListener("drawn", draw);
  document.addEventListener("theme", () => shown && draw());
} else {
  // The first batch needs the full page, with charts.
  document.addEventListener("drawn", () => document.querySelector("#state .empty") ?? location.reload());
}
