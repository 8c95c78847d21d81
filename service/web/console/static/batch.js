// What-if: every change of a setting redraws the outcome; the address contains the changes.
import { fetchPage, swapRegions } from "./regions.js";
import { send } from "./actions.js";

const WAIT_MS = 350;
const form = () => document.getElementById("try");
let waiting = null;
let asked = 0;

function address() {
  const query = new URLSearchParams();
  for (const field of form().elements) {
    if (field.name && field.value !== field.dataset.before) query.set(field.name, field.value);
  }
  const text = query.toString();
  return text ? `${form().getAttribute("action")}?${text}` : form().getAttribute("action");
}

async function draw(where) {
  const outcome = document.getElementById("outcome");
  const mine = ++asked;
  outcome.setAttribute("aria-busy", "true");
  const focus = document.activeElement?.id;
  try {
    const fresh = await fetchPage(where);
    if (mine !== asked) return;
    history.replaceState(null, "", where);
    outcome.replaceWith(document.adoptNode(fresh.getElementById("outcome")));
    if (focus) document.getElementById(focus)?.focus({ preventScroll: true });
    ready();
  } catch (error) {
    if (mine !== asked) return;
    outcome.removeAttribute("aria-busy");
    const status = document.getElementById("try-status");
    status.className = "problem";
    status.textContent = `Not computed: ${error.message}`;
  }
}

async function adopt(button) {
  button.disabled = true;
  const status = document.getElementById("try-status");
  const options = JSON.parse(button.dataset.adopt);
  try {
    const address = `/api/v1/batches/${form().dataset.id}/what-if`;
    const adopted = await send("POST", address, JSON.stringify({ options, adopt: true }));
    location.href = `/batches/${adopted.id}`;
  } catch (error) {
    button.disabled = false;
    status.className = "problem";
    status.textContent = `Not adopted: ${error.message}`;
  }
}

// Shows the buttons that need scripts.
function ready() {
  for (const button of document.querySelectorAll("[data-copy], [data-adopt]")) button.hidden = false;
}

function point(event, on) {
  const star = event.target.closest?.("[data-star]")?.dataset.star;
  if (!star) return;
  for (const same of document.querySelectorAll(`[data-star="${CSS.escape(star)}"]`)) same.classList.toggle("pointed", on);
}

document.addEventListener("input", (event) => {
  if (!event.target.closest("#try")) return;
  clearTimeout(waiting);
  waiting = setTimeout(() => draw(address()), WAIT_MS);
});
document.addEventListener("submit", (event) => {
  if (event.target.id !== "try") return;
  event.preventDefault();
  clearTimeout(waiting);
  draw(address());
});
document.addEventListener("click", (event) => {
  const adopting = event.target.closest("[data-adopt]");
  if (adopting) adopt(adopting);
  const view = event.target.closest("[data-view]");
  if (view) {
    event.preventDefault();
    form().elements.view.value = view.dataset.view;
    draw(address());
  }
  if (event.target.closest("[data-reset]")) {
    event.preventDefault();
    draw(form().getAttribute("action"));
  }
});
document.addEventListener("mouseover", (event) => point(event, true));
document.addEventListener("mouseout", (event) => point(event, false));
ready();
