// Cancels a replay.
import { refreshSoon } from "./live_updates.js";
import { attempt, send } from "./actions.js";

const message = document.getElementById("message");

document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-cancel]");
  if (!button) return;
  attempt(button, message, async () => {
    const replay = await send("DELETE", `/api/v1/replays/${button.dataset.cancel}`);
    refreshSoon();
    return replay.state === "cancelled" ? "Cancelled." : "The replay ends as soon as it can.";
  });
});
