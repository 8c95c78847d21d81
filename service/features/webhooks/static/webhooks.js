// Registers, tries out and pauses webhooks.
import { attempt, send } from "./actions.js";
import { refreshSoon } from "./live_updates.js";

const HERE = "/api/v1/webhooks";
const SETTINGS = ["name", "url", "kinds", "spacecraft", "severity", "run"];
const message = document.getElementById("message");
const shown = document.getElementById("secret-shown");

function showSecret({ secret }) {
  document.getElementById("secret").textContent = secret;
  shown.hidden = false;
}

// The settings of a webhook with only `enabled` changed; null stands for every run.
async function changed(address, enabled) {
  const webhook = await send("GET", address);
  const settings = Object.fromEntries(SETTINGS.map((name) => [name, webhook[name]]));
  return send("PUT", address, JSON.stringify({ ...settings, run: webhook.run ?? "*", enabled }));
}

const ACTIONS = {
  async test(address) {
    const outcome = await send("POST", `${address}/test`, undefined);
    if (!outcome.delivered) throw new Error(outcome.fault);
    return `The receiver answered ${outcome.status} after ${outcome.duration_ms} ms.`;
  },
  async pause(address) {
    await changed(address, false);
    return "Paused: nothing is sent until it goes on.";
  },
  async resume(address) {
    await changed(address, true);
    return "It goes on where it stopped.";
  },
  async secret(address) {
    showSecret(await send("POST", `${address}/secret`, "{}"));
    return "New secret. The previous one signs too for 24 hours.";
  },
};

document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-do]");
  if (!button) return;
  const address = `${HERE}/${button.closest("[data-webhook]").dataset.webhook}`;
  attempt(button, message, async () => {
    const said = await ACTIONS[button.dataset.do](address);
    refreshSoon();
    return said;
  });
});

document.getElementById("new-webhook")?.addEventListener("submit", (event) => {
  event.preventDefault();
  const { name, url, kind, spacecraft, severity } = event.target.elements;
  attempt(event.submitter, message, async () => {
    const settings = {
      name: name.value,
      url: url.value.trim(),
      kinds: kind.value ? [kind.value] : null,
      spacecraft: spacecraft.value ? [spacecraft.value] : null,
      severity: severity.value || null,
    };
    showSecret(await send("POST", HERE, JSON.stringify(settings)));
    event.target.reset();
    refreshSoon();
    return `Added: ${settings.name}.`;
  });
});
