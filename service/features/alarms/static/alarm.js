// Actions on an alarm: every button sends the author and the comment.
import { refreshSoon } from "./live_updates.js";
import { attempt, rememberWho, send } from "./actions.js";

const form = document.getElementById("act-form");
const message = document.getElementById("message");
const DONE = { acknowledge: "Acknowledged.", comment: "Comment added.", shelve: "Shelved.", unshelve: "Unshelved." };

// The actions allowed in each state; a comment is always allowed.
const ALLOWED = { open: ["acknowledge", "shelve"], acknowledged: ["shelve"], shelved: ["acknowledge", "unshelve"], cleared: [] };

function enableAllowed() {
  const allowed = [...ALLOWED[document.getElementById("alarm").dataset.state], "comment"];
  for (const button of form.querySelectorAll("[data-act]")) button.disabled = !allowed.includes(button.dataset.act);
}

rememberWho(form.elements.who);
enableAllowed();
document.addEventListener("drawn", enableAllowed);

form.addEventListener("submit", (event) => {
  event.preventDefault();
  const action = event.submitter?.dataset.act ?? "acknowledge";
  const { who, comment, minutes } = form.elements;
  attempt(null, message, async () => {
    const body = { who: who.value.trim() };
    if (comment.value.trim()) body.comment = comment.value.trim();
    if (action === "shelve") body.minutes = Number(minutes.value);
    await send("POST", `/api/v1/alarms/${form.dataset.id}/${action}`, JSON.stringify(body));
    comment.value = "";
    refreshSoon();
    return DONE[action];
  });
});
