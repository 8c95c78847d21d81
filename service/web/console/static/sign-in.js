// Exchanges a token for a session's cookie, which scripts cannot read, and opens the requested page.
import { send } from "./actions.js";
import { rooted } from "./requests.js";

const form = document.getElementById("sign-in");
const message = document.getElementById("message");

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  message.textContent = "";
  try {
    await send("POST", "/api/v1/session", JSON.stringify({ token: form.elements.token.value.trim() }));
    location.replace(rooted(form.dataset.next));
  } catch (error) {
    message.textContent = `Not signed in: ${error.message}`;
  }
});
