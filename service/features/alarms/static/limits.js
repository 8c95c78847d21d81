// Changes limits, one quantity at a time, with author and comment.
import { refreshSoon } from "./live_updates.js";
import { attempt, rememberWho, send } from "./actions.js";
import { beginPreview, clearPreview, showPreview } from "./limit_preview.js";

const message = document.getElementById("message");
const signed = document.getElementById("signed");

rememberWho(signed.elements.who);
signed.addEventListener("submit", (event) => event.preventDefault());

const MAX_DIGITS = 12;

// An empty field means no bound; shares are entered in percent.
function numberIn(field, scale = 1) {
  const text = field.value.trim();
  if (text === "") return null;
  const value = Number((Number(text) / scale).toPrecision(MAX_DIGITS));
  if (Number.isNaN(value)) throw new Error(`${field.name} must be a number, not ${text}`);
  return value;
}

function settingsIn(form) {
  const { elements } = form;
  const scale = form.dataset.percent === undefined ? 1 : 100;
  const settings = { enabled: elements.enabled.checked };
  for (const severity of ["watch", "warning", "critical"]) {
    settings[severity] = { low: numberIn(elements[`${severity}.low`], scale), high: numberIn(elements[`${severity}.high`], scale) };
  }
  settings.hysteresis = numberIn(elements.hysteresis, scale);
  for (const name of ["minimum_count", "duration_s"]) settings[name] = numberIn(elements[name]);
  return settings;
}

function addressOf(form, query = {}, part = "") {
  const { spacecraft, tracker, limit } = form.dataset;
  const asked = new URLSearchParams(tracker ? { ...query, tracker } : query);
  return `/api/v1/spacecraft/${encodeURIComponent(spacecraft)}/limits/${limit}${part}?${asked}`;
}

async function preview(form) {
  const query = { days: signed.elements.days.value, run: document.body.dataset.run };
  const found = await send("POST", addressOf(form, query, "/preview"), JSON.stringify({ settings: settingsIn(form) }));
  await showPreview(found, { percent: form.dataset.percent !== undefined, unit: form.dataset.unit });
  return "Preview: nothing is changed.";
}

function change(button, form, work) {
  if (!signed.reportValidity()) return;
  attempt(button, message, async () => {
    const changed = await work({ who: signed.elements.who.value.trim(), comment: signed.elements.comment.value.trim() });
    document.activeElement?.blur();
    refreshSoon();
    return changed;
  });
}

document.addEventListener("submit", (event) => {
  const form = event.target.closest("[data-limit]");
  if (!form) return;
  event.preventDefault();
  change(event.submitter, form, async (who) => {
    clearPreview(form.dataset.limit);
    await send("PUT", addressOf(form), JSON.stringify({ settings: settingsIn(form), ...who }));
    return `Changed: ${form.dataset.limit}.`;
  });
});

document.addEventListener("click", (event) => {
  const trying = event.target.closest("[data-preview]");
  if (trying) {
    const form = trying.closest("form");
    attempt(trying, beginPreview(form.dataset.limit), () => preview(form));
    return;
  }
  const button = event.target.closest("[data-default]");
  if (!button) return;
  const form = button.closest("form");
  change(button, form, async (who) => {
    await send("DELETE", addressOf(form, who));
    return `Shipped limit restored: ${form.dataset.limit}.`;
  });
});
