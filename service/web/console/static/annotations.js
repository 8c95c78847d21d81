// Annotations of the shown period: the marks that charts draw, and the form that writes them.
import { posix } from "./times.js";
import { attempt, rememberWho, send } from "./actions.js";
import { signed } from "./sign.js";
import { refreshSoon } from "./live_updates.js";

const form = document.getElementById("annotate");
const message = document.getElementById("annotate-status");

// The annotations of the list, numbered as there.
export function annotationsShown() {
  return [...document.querySelectorAll("[data-annotation]")].map(({ dataset: { start, end, mark } }, index) => ({
    number: mark ?? index + 1,
    start: posix(start),
    end: end ? posix(end) : null,
  }));
}

async function remove(button) {
  const sign = await signed("Delete this annotation", ["It is gone from every page. The audit list keeps its text, your name and the reason."], "Delete");
  if (sign === null) return;
  attempt(button, message, async () => {
    await send("DELETE", `/api/v1/annotations/${button.dataset.delete}?${new URLSearchParams(sign)}`);
    refreshSoon();
    return "Annotation deleted.";
  });
}

if (form) {
  const { start, end, text, spacecraft, who } = form.elements;
  rememberWho(who);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const note = { text: text.value, start: start.value.trim(), end: end.value.trim() || null, spacecraft: spacecraft.value || null, who: who.value.trim() };
    attempt(event.submitter, message, async () => {
      await send("POST", "/api/v1/annotations", JSON.stringify(note));
      text.value = end.value = "";
      refreshSoon();
      return "Annotation added.";
    });
  });
  document.addEventListener("click", (event) => {
    if (event.target.closest("[data-whole-period]")) {
      ({ start: start.value, end: end.value } = document.getElementById("stretch").dataset);
      return;
    }
    const button = event.target.closest("[data-delete]");
    if (button) remove(button);
  });
  // The time of a click on a chart.
  document.addEventListener("moment", ({ detail: { seconds } }) => {
    start.value = new Date(Math.round(seconds) * 1000).toISOString();
  });
}
