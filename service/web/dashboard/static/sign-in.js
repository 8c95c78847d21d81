// Exchanges a token for a session's cookie, which scripts cannot read, and goes on.
const form = document.getElementById("sign-in");
const said = document.getElementById("said");

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  said.textContent = "";
  try {
    const response = await fetch("/api/v1/session", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ token: form.elements.token.value.trim() }),
    });
    if (response.ok) {
      location.replace(form.dataset.next);
    } else {
      said.textContent = `Not signed in: ${(await response.json()).detail}`;
    }
  } catch {
    said.textContent = "Not signed in: the service does not answer.";
  }
});
