// Cancelling a replay.
import { drawSoon } from "./live.js";
import { attempt, send } from "./sending.js";

const told = document.getElementById("told");

document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-cancel]");
  if (!button) return;
  attempt(button, told, async () => {
    const replay = await send("DELETE", `/api/v1/replays/${button.dataset.cancel}`);
    drawSoon();
    return replay.state === "cancelled" ? "Cancelled." : "The replay ends as soon as it can.";
  });
});
