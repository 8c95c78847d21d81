// Acknowledges or shelves many alarms at once: each is a request of its own, with its own outcome.
import { attempt, rememberWho, send } from "./actions.js";
import { refreshSoon } from "./live_updates.js";

const AT_ONCE = 4;
const ALLOWED = { acknowledge: ["open", "shelved"], shelve: ["open", "acknowledged"] };
const DONE = { acknowledge: "acknowledged", shelve: "shelved" };
const form = document.getElementById("bulk");
const message = document.getElementById("message");
const selected = new Set();

const boxes = () => [...document.querySelectorAll("[data-select]")];

// The list is replaced by newer ones: what was selected stays so.
function mark() {
  const here = boxes();
  for (const id of selected) if (!here.some((each) => each.dataset.select === id)) selected.delete(id);
  for (const each of here) each.checked = selected.has(each.dataset.select);
  for (const button of form.querySelectorAll("[data-act]")) button.disabled = ids(button.dataset.act).length === 0;
  const all = document.querySelector("[data-select-all]");
  if (!all) return;
  all.checked = here.length > 0 && selected.size === here.length;
  all.indeterminate = selected.size > 0 && !all.checked;
}

// The selected alarms that an action applies to.
function ids(action) {
  const apt = boxes().filter((each) => each.checked && ALLOWED[action].includes(each.dataset.state));
  return apt.map((each) => each.dataset.select);
}

async function sendAll(waiting, action, body) {
  const refused = [];
  const work = async () => {
    for (let id = waiting.pop(); id !== undefined; id = waiting.pop()) {
      try {
        await send("POST", `/api/v1/alarms/${id}/${action}`, JSON.stringify(body));
        selected.delete(id);
      } catch (error) {
        refused.push(error.message);
      }
    }
  };
  await Promise.all(Array.from({ length: AT_ONCE }, work));
  return refused;
}

if (form) {
  rememberWho(form.elements.who);
  document.addEventListener("change", (event) => {
    if (event.target.matches("[data-select-all]")) {
      for (const each of boxes()) event.target.checked ? selected.add(each.dataset.select) : selected.delete(each.dataset.select);
    } else if (event.target.matches("[data-select]")) {
      const { select } = event.target.dataset;
      event.target.checked ? selected.add(select) : selected.delete(select);
    } else return;
    message.textContent = selected.size ? `${selected.size} selected.` : "None selected.";
    mark();
  });
  document.addEventListener("drawn", mark);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const action = event.submitter?.dataset.act ?? "acknowledge";
    const { who, comment, minutes } = form.elements;
    const waiting = ids(action);
    const count = waiting.length;
    const body = { who: who.value.trim() };
    if (comment.value.trim()) body.comment = comment.value.trim();
    if (action === "shelve") body.minutes = Number(minutes.value);
    attempt(null, message, async () => {
      const refused = await sendAll(waiting, action, body);
      refreshSoon();
      if (refused.length) throw new Error(`${refused.length} of ${count}; the first: ${refused[0]}`);
      comment.value = "";
      return `${count} ${DONE[action]}.`;
    });
  });
  mark();
}
