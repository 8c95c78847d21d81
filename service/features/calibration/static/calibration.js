// Calibrates, tries a calibration over recorded batches, adopts it, and takes it back.
import { attempt, element, ended, rememberWho, send } from "./actions.js";
import { refreshSoon } from "./live_updates.js";
import { signed } from "./sign.js";

const message = document.getElementById("message");
const form = document.getElementById("calibrate");
const trial = document.getElementById("trial");

if (form) rememberWho(form.elements.who);

form?.addEventListener("submit", (event) => {
  event.preventDefault();
  const { who, start, end, degree, sample, alignment, scale, magnitudes, time_tag: timeTag } = form.elements;
  attempt(event.submitter, message, async () => {
    const begun = await send("POST", "/api/v1/calibrations", JSON.stringify({
      spacecraft: form.dataset.spacecraft,
      run: document.body.dataset.run,
      start: start.value.trim() || null,
      end: end.value.trim() || null,
      degree: degree.value === "" ? null : Number(degree.value),
      sample: Number(sample.value),
      alignment: alignment.checked,
      scale: scale.checked,
      magnitudes: magnitudes.checked,
      time_tag: timeTag.checked,
      who: who.value.trim(),
    }));
    const found = await ended(`/api/v1/calibrations/${begun.id}`, ({ state }) => !["queued", "running"].includes(state), ({ version, done, total }) => {
      message.textContent = `Version ${version}: ${done} of ${total} batches.`;
    });
    if (found.state !== "done") throw new Error(found.fault ?? found.state);
    const here = new URL(location.href);
    here.searchParams.set("version", found.version);
    location.assign(here);
    return `Version ${found.version} is done.`;
  });
});

const SHOWN = [
  ["batches with a suspect attitude", (side, found) => share(side.suspect, found.compared)],
  ["stars unique", (side) => share(side.unique, side.observed)],
  ["stars ambiguous", (side) => share(side.ambiguous, side.observed)],
  ["stars unmatched", (side) => share(side.unmatched, side.observed)],
  ["residual over predicted, mean", (side) => side.residual_ratio_mean?.toFixed(2) ?? "–"],
];

function share(part, whole) {
  return whole ? `${part} of ${whole} (${((100 * part) / whole).toFixed(1)} %)` : "–";
}

function showTrial(found) {
  const caption = `${found.compared} of ${found.batches_in_stretch} batches${found.cut_short ? ", stopped after ten seconds" : ""}`;
  const number = (kind, textContent) => element(kind, { textContent, className: "number", scope: "col" });
  const head = element("tr", {}, element("td"), number("th", "in force"), number("th", "with this calibration"));
  const rows = SHOWN.map(([name, text]) => element("tr", {}, element("th", { textContent: name, scope: "row" }), number("td", text(found.a, found)), number("td", text(found.b, found))));
  trial.replaceChildren(element("table", {}, element("caption", { textContent: caption }), element("thead", {}, head), element("tbody", {}, ...rows)));
  trial.hidden = false;
}

document.getElementById("try")?.addEventListener("submit", (event) => {
  event.preventDefault();
  const { sample } = event.target.elements;
  const address = `/api/v1/calibrations/${event.target.dataset.calibration}/trial`;
  attempt(event.submitter, document.getElementById("trial-message"), async () => {
    showTrial(await send("POST", address, JSON.stringify({ run: document.body.dataset.run, sample: Number(sample.value) })));
    return "Nothing is recorded.";
  });
});

document.addEventListener("click", async (event) => {
  const button = event.target.closest("[data-adopt], [data-revert]");
  if (!button) return;
  const { adopt, revert, title } = button.dataset;
  const { changes } = document.getElementById("what-changes").dataset;
  const sign = await signed(title, changes.split("|"), adopt === undefined ? "Put back" : "Adopt");
  if (sign === null) return;
  const said = { who: sign.who, note: sign.comment };
  attempt(button, message, async () => {
    if (adopt !== undefined) {
      const adopted = await send("POST", `/api/v1/calibrations/${adopt}/adopt`, JSON.stringify(said));
      refreshSoon();
      return `In force: version ${adopted.version}. To undo it, put the former one back in the history below.`;
    }
    const address = `/api/v1/spacecraft/${encodeURIComponent(form.dataset.spacecraft)}/calibration/revert`;
    const back = await send("POST", address, JSON.stringify({ ...said, to: revert || null }));
    refreshSoon();
    return back.version === null ? "In force: the mission file." : `In force: version ${back.version}.`;
  });
});
