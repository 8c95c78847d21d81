// Makes and revokes tokens.
import { attempt, send } from "./actions.js";
import { refreshSoon } from "./live_updates.js";

const HERE = "/api/v1/tokens";
const message = document.getElementById("message");
const shown = document.getElementById("token-shown");

document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-revoke]");
  if (!button) return;
  const { token } = button.closest("[data-token]").dataset;
  attempt(button, message, async () => {
    await send("DELETE", `${HERE}/${encodeURIComponent(token)}`);
    refreshSoon();
    return `Revoked: ${token}.`;
  });
});

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
    const { token } = await send("POST", HERE, JSON.stringify(settings));
    document.getElementById("token").textContent = token;
    shown.hidden = false;
    event.target.reset();
    refreshSoon();
    return `Made: ${settings.name}.`;
  });
});
