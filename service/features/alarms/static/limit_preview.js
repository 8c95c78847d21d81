// The preview of a limit: what it would have done to recorded batches, in words and on the trend.
import { posix, utc } from "./times.js";
import { element } from "./actions.js";
import { requestJson } from "./requests.js";
import { Trend } from "./trend.js";

const POINTS = 240;
const MOST_LISTED = 8;
const charts = JSON.parse(document.querySelector("[data-json]").content.textContent);

function holderOf(quantity) {
  return document.getElementById(`preview-${quantity}`);
}

// Shows an empty preview; returns the line that tells its state.
export function beginPreview(quantity) {
  const status = element("p", { role: "status" });
  holderOf(quantity).replaceChildren(status);
  holderOf(quantity).hidden = false;
  return status;
}

export function clearPreview(quantity) {
  holderOf(quantity).replaceChildren();
  holderOf(quantity).hidden = true;
}

function value(number, { percent, unit }) {
  return `${+(percent ? 100 * number : number).toPrecision(3)}${"″°".includes(unit) ? "" : "\u202f"}${unit}`.replace("-", "−");
}

function alarmsIn(count) {
  return count === 1 ? "1 alarm" : `${count || "no"} alarms`;
}

function sentence(name, trial) {
  const beyond = Object.entries(trial.beyond).filter(([severity]) => ["low", "high"].some((bound) => trial.settings[severity][bound] !== null));
  const counts = beyond.map(([severity, count]) => `${count} of ${trial.evaluated} values beyond ${severity}`);
  const told = trial.settings.enabled ? counts.join(", ") || "no bounds" : "off";
  return `${name}: ${alarmsIn(trial.alarms)}; ${told}.`;
}

function listOf(excursions, measure) {
  const list = document.createElement("ol");
  // Numbered as the marks of the trend.
  list.start = Math.max(0, excursions.length - MOST_LISTED) + 1;
  for (const each of excursions.slice(-MOST_LISTED)) {
    const end = each.end === null ? "to the end" : `to ${utc(posix(each.end))} UTC`;
    list.append(element("li", {}, `${each.severity}, ${utc(posix(each.start))} UTC ${end}: ${value(each.worst, measure)}, bound ${value(each.bound, measure)}`));
  }
  return list;
}

// The trend over the same batches, with the bounds that are tried and the times beyond them.
async function draw(holder, found, chart) {
  const readout = element("p", { className: "readout soft" }, "\u00a0");
  const place = element("div", { className: "chart", tabIndex: 0, role: "img" });
  holder.append(readout, place);
  const query = new URLSearchParams({ quantity: found.quantity, run: found.run, start: found.start, size: POINTS });
  // The latest batch belongs to the period, whose end does not.
  query.set("end", new Date(posix(found.end) * 1000 + 1).toISOString());
  if (found.tracker) query.set("tracker", found.tracker);
  const history = await requestJson(`/api/v1/spacecraft/${encodeURIComponent(found.spacecraft)}/history?${query}`);
  const lines = chart.quantities.map((each) => ({ ...each, tone: "--curve" }));
  const limits = [{ quantity: found.quantity, settings: found.proposed.settings }];
  const marks = found.proposed.excursions.map(({ start, end }, index) => ({ number: index + 1, start: posix(start), end: end ? posix(end) : posix(found.end) }));
  new Trend(place, readout, { ...chart, quantities: lines, marks: "times out of these limits" }, limits, `preview-${found.quantity}`, () => {}).show(history, posix(found.start), posix(found.end), marks);
}

// `measure` says how values are written, as in the form.
export async function showPreview(found, measure) {
  const holder = holderOf(found.quantity);
  const chart = charts[found.quantity];
  if (!found.batches) {
    holder.append(element("p", {}, "There is no batch in these days."));
    return;
  }
  const cut = found.is_cut ? ", the latest of more" : "";
  holder.append(
    element("p", { className: "soft" }, `${found.batches} batches${cut}, ${utc(posix(found.start))} to ${utc(posix(found.end))} UTC.`),
    element("p", {}, sentence("These limits", found.proposed)),
    element("p", {}, sentence("The limits in force", found.in_force)),
    listOf(found.proposed.excursions, measure),
  );
  if (chart) await draw(holder, found, chart);
}
