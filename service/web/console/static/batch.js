// What-if: every change of a setting redraws the outcome; the address contains the changes.
import { fetchPage } from "./regions.js";
import { attempt, send } from "./actions.js";
import { signed } from "./sign.js";
import { rooted } from "./requests.js";

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
  return text ? `${form().action}?${text}` : form().action;
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
    fresh.getElementById("settings").open = document.getElementById("settings").open;
    outcome.replaceWith(document.adoptNode(fresh.getElementById("outcome")));
    if (focus) document.getElementById(focus)?.focus({ preventScroll: true });
  } catch (error) {
    if (mine !== asked) return;
    outcome.removeAttribute("aria-busy");
    const status = document.getElementById("try-status");
    status.className = "problem";
    status.textContent = `Not computed: ${error.message}`;
  }
}

// Adopts a result with a signature, which the batch, its former result, trends and the audit list show.
async function adopt(button) {
  const { adopt: options, parent, title, changes } = button.dataset;
  const sign = await signed(title, changes.split("|"), "Adopt");
  if (sign === null) return;
  attempt(button, document.getElementById("try-status"), async () => {
    const wanted = { options: JSON.parse(options), adopt: true, ...sign };
    const adopted = await send("POST", `/api/v1/batches/${parent}/what-if`, JSON.stringify(wanted));
    location.href = rooted(`/batches/${adopted.id}`);
  });
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
});
document.addEventListener("mouseover", (event) => point(event, true));
document.addEventListener("mouseout", (event) => point(event, false));
