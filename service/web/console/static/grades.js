// Makes the definitive attitude of a period, and shows how far it is.
import { attempt, rememberWho, send } from "./actions.js";
import { refreshSoon } from "./live_updates.js";

const POLL_MS = 500;
const form = document.getElementById("definitive");
const message = document.getElementById("message");
const bar = document.getElementById("definitive-progress");
const pause = () => new Promise((resolve) => setTimeout(resolve, POLL_MS));

async function finished(address, job) {
  while (job.ended === null) {
    bar.hidden = false;
    bar.max = job.total || 1;
    bar.value = job.done;
    message.textContent = job.total ? `${job.done} of ${job.total} days.` : `${job.state}…`;
    await pause();
    job = await send("GET", `${address}/${job.id}`);
  }
  bar.hidden = true;
  return job;
}

if (form) {
  rememberWho(form.elements.who);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const { start, end, who } = form.elements;
    const address = `/api/v1/spacecraft/${encodeURIComponent(form.dataset.spacecraft)}/definitive-attitude`;
    attempt(event.submitter, message, async () => {
      const wanted = { run: document.body.dataset.run, start: start.value.trim() || null, end: end.value.trim() || null, who: who.value.trim() };
      const job = await finished(address, await send("POST", address, JSON.stringify(wanted)));
      if (job.state !== "done") throw new Error(job.fault ?? job.state);
      refreshSoon();
      return `Done: ${job.recorded} of ${job.total} days have a new revision${job.fault ? `; ${job.fault}` : ""}.`;
    });
  });
}
