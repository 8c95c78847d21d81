// Sending what a form asks for, and telling in words how it went.
import { requestJson } from "./requests.js";

// The answer's JSON; throws with the service's own words where it refused.
export async function send(method, address, body, headers = { "Content-Type": "application/json" }) {
  return requestJson(address, { method, headers: body === undefined ? {} : headers, body });
}

// Runs what a form or a button asks for; meanwhile it cannot be asked again.
export async function attempt(button, status, work) {
  if (button) button.disabled = true;
  status.className = "";
  status.textContent = "Working…";
  try {
    status.textContent = (await work()) ?? "";
  } catch (error) {
    status.className = "problem";
    status.textContent = `Not done: ${error.message}`;
  } finally {
    if (button) button.disabled = false;
  }
}

// Who acts: remembered in this browser, so that it is typed once.
export function rememberWho(field) {
  // Signed in, everybody acts under the name of their token.
  field.value ||= document.body.dataset.reader || localStorage.getItem("who") || "";
  field.readOnly = Boolean(document.body.dataset.reader);
  field.addEventListener("change", () => localStorage.setItem("who", field.value.trim()));
}
