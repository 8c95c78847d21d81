// Sends requests for forms and buttons, and shows their outcome.
import { requestJson } from "./requests.js";

// The answer's JSON; throws an error with the service's message if the request was refused.
export async function send(method, address, body, headers = { "Content-Type": "application/json" }) {
  return requestJson(address, { method, headers: body === undefined ? {} : headers, body });
}

// Runs the work of a form or a button, which is disabled meanwhile.
export async function attempt(button, status, work) {
  if (button) button.disabled = true;
  status.className = "";
  status.textContent = "Working…";
  try {
    status.textContent = (await work()) ?? "";
  } catch (error) {
    status.className = "problem";
    status.textContent = `Not done: ${error.message}`;
    status.scrollIntoView({ block: "nearest" });
  } finally {
    if (button) button.disabled = false;
  }
}

// A new element with its properties and what it holds.
export function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

// A job once it has ended; it is asked for twice a second, and told meanwhile.
export async function ended(address, isOver, tell) {
  for (;;) {
    const job = await send("GET", address);
    if (isOver(job)) return job;
    tell(job);
    await new Promise((resolve) => setTimeout(resolve, 500));
  }
}

// The name of the author, stored in this browser so that it is typed once.
export function rememberWho(field) {
  // After sign-in the author is the name of the token.
  field.value ||= document.body.dataset.reader || localStorage.getItem("who") || "";
  field.readOnly = Boolean(document.body.dataset.reader);
  field.addEventListener("change", () => localStorage.setItem("who", field.value.trim()));
}
