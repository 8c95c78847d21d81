// Starts a replay, also of a file that is sent again into the run that the address names.
import { refreshSoon } from "./live_updates.js";
import { attempt, send } from "./actions.js";

const message = document.getElementById("message");

const form = document.getElementById("replay");

function sendAgain() {
  const into = new URLSearchParams(location.hash.slice(1)).get("into");
  if (into === null) return;
  history.replaceState(null, "", location.pathname + location.search);
  form.elements.run.value = into;
  form.scrollIntoView({ block: "center" });
  form.elements.file.focus({ preventScroll: true });
}

addEventListener("hashchange", sendAgain);
sendAgain();

form.addEventListener("submit", (event) => {
  event.preventDefault();
  const { file, run, alarms } = event.target.elements;
  attempt(event.submitter, message, async () => {
    const query = new URLSearchParams({ run: run.value.trim(), name: file.files[0].name.slice(-200) });
    if (alarms.checked) query.set("alarms", "true");
    const ending = `.${file.files[0].name.split(".").at(-1).toLowerCase()}`;
    const headers = { "Content-Type": JSON.parse(form.dataset.kinds)[ending] ?? "application/x-ndjson" };
    const replay = await send("POST", `/api/v1/replays?${query}`, file.files[0], headers);
    refreshSoon();
    return `Replaying ${file.files[0].name} into run ${replay.run}.`;
  });
});
