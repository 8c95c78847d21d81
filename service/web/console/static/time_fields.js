// Fields for times: what is wrong with one is said beside it before anything is sent, and a
// calendar fills it in.
import { typedTime } from "./times.js";

const messageOf = (form) => form.querySelector("[data-time-fault]");

function tell(form, field, text) {
  field.setAttribute("aria-invalid", "true");
  const line = messageOf(form) ?? document.createElement("p");
  line.className = "problem";
  line.dataset.timeFault = "";
  line.setAttribute("role", "alert");
  line.textContent = text;
  form.append(line);
  field.focus();
}

function nameOf(field) {
  return field.closest("label").textContent.trim().replace(/, UTC$/, "");
}

// Completes every time of a form; returns false, and says why, where one cannot be read.
function completed(form) {
  messageOf(form)?.remove();
  const seconds = {};
  for (const field of form.querySelectorAll("[data-time]")) {
    field.removeAttribute("aria-invalid");
    if (!field.value.trim()) continue;
    try {
      const typed = typedTime(field.value);
      field.value = typed.text;
      seconds[field.name] = typed.seconds;
    } catch (error) {
      tell(form, field, `${nameOf(field)} ${error.message}`);
      return false;
    }
  }
  const [from, to] = form.elements.since ? ["since", "until"] : ["start", "end"];
  if (seconds[from] > seconds[to]) {
    tell(form, form.elements[to], `${nameOf(form.elements[to])} must not be before ${nameOf(form.elements[from])}`);
    return false;
  }
  return true;
}

// Before every other listener of a page, which sends what the fields contain.
document.addEventListener("submit", (event) => {
  if (completed(event.target)) return;
  event.preventDefault();
  event.stopImmediatePropagation();
}, true);

document.addEventListener("input", (event) => {
  if (!event.target.matches("[data-picks]") || !event.target.value) return;
  const field = event.target.closest(".timed").querySelector("[data-time]");
  field.value = `${event.target.value}${event.target.value.length === 16 ? ":00" : ""}Z`;
  field.dispatchEvent(new Event("input", { bubbles: true }));
});
