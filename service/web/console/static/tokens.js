// Makes tokens.
import { attempt, send } from "./actions.js";
import { refreshSoon } from "./live_updates.js";

const message = document.getElementById("message");
const shown = document.getElementById("token-shown");

document.getElementById("new-token").addEventListener("submit", (event) => {
  event.preventDefault();
  const { name, spacecraft, days } = event.target.elements;
  const scopes = new FormData(event.target).getAll("scope");
  attempt(event.submitter, message, async () => {
    const settings = {
      name: name.value.trim(),
      scopes,
      spacecraft: spacecraft.value ? [spacecraft.value] : null,
      days: Number(days.value),
    };
    const { token } = await send("POST", "/api/v1/tokens", JSON.stringify(settings));
    document.getElementById("token").textContent = token;
    shown.hidden = false;
    event.target.reset();
    refreshSoon();
    return `Made: ${settings.name}.`;
  });
});
