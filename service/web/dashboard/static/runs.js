// Starting a replay, and having a run watched for alarms.
import { drawSoon } from "./live.js";
import { attempt, send } from "./sending.js";

const told = document.getElementById("told");

document.getElementById("replay").addEventListener("submit", (event) => {
  event.preventDefault();
  const { file, run, alarms } = event.target.elements;
  attempt(event.submitter, told, async () => {
    const query = new URLSearchParams({ run: run.value.trim() });
    if (alarms.checked) query.set("alarms", "true");
    const headers = { "Content-Type": "application/x-ndjson" };
    const replay = await send("POST", `/api/v1/replays?${query}`, file.files[0], headers);
    drawSoon();
    return `Replaying ${file.files[0].name}: ${replay.lines.total} lines into run ${replay.run}.`;
  });
});

document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-watch]");
  if (!button) return;
  attempt(button, told, async () => {
    const alarms = button.dataset.alarms === "true";
    await send("PUT", `/api/v1/runs/${encodeURIComponent(button.dataset.watch)}`, JSON.stringify({ alarms }));
    drawSoon();
    return `Run ${button.dataset.watch} is ${alarms ? "watched" : "no longer watched"} for alarms.`;
  });
});
