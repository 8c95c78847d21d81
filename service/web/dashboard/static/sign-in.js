// Exchanges a token for a session's cookie, which scripts cannot read, and goes on.
import { send } from "./sending.js";

const form = document.getElementById("sign-in");
const said = document.getElementById("said");

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  said.textContent = "";
  try {
    await send("POST", "/api/v1/session", JSON.stringify({ token: form.elements.token.value.trim() }));
    location.replace(form.dataset.next);
  } catch (error) {
    said.textContent = `Not signed in: ${error.message}`;
  }
});
