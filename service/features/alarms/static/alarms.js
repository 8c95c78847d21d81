// Acts on the selected alarms of a list, or on the alarm of a page: each is a request of its own.
import { attempt, rememberWho, send } from "./actions.js";
import { refreshSoon } from "./live_updates.js";

const AT_ONCE = 4;
// The states in which an action applies; a comment always does.
const ALLOWED = { acknowledge: ["open", "shelved"], shelve: ["open", "acknowledged"], unshelve: ["shelved"] };
const DONE = { acknowledge: "acknowledged", shelve: "shelved", unshelve: "unshelved", comment: "commented" };
const form = document.querySelector("#bulk, #act-form");
const message = document.getElementById("message");
// The alarm of a page stays selected.
const only = form?.dataset.id;
const selected = new Set(only ? [only] : []);

const shown = () => [...document.querySelectorAll("[data-select]")];

// The list is replaced by newer ones: what was selected stays so.
function mark() {
  const here = shown();
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
  const apt = shown().filter(({ dataset: { select, state } }) => selected.has(select) && (ALLOWED[action]?.includes(state) ?? true));
  return apt.map((each) => each.dataset.select);
}

async function sendAll(waiting, action, body) {
  const refused = [];
  const work = async () => {
    for (let id = waiting.pop(); id !== undefined; id = waiting.pop()) {
      try {
        await send("POST", `/api/v1/alarms/${id}/${action}`, JSON.stringify(body));
        if (!only) selected.delete(id);
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
      for (const each of shown()) event.target.checked ? selected.add(each.dataset.select) : selected.delete(each.dataset.select);
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
      if (refused.length) throw new Error(count === 1 ? refused[0] : `${refused.length} of ${count}; the first: ${refused[0]}`);
      comment.value = "";
      return `${count} ${DONE[action]}.`;
    });
  });
  mark();
}
