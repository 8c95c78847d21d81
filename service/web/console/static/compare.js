// Comparing takes up to ten seconds: says so, and sends only the fields that ask for something.
const form = document.getElementById("compare");

form.addEventListener("submit", () => {
  for (const field of form.elements) {
    if (field.name && field.value === "") field.disabled = true;
  }
  document.getElementById("message").textContent = "Comparing…";
  form.setAttribute("aria-busy", "true");
});

// Back again by the browser's own button: every field works as before.
addEventListener("pageshow", () => {
  for (const field of form.elements) field.disabled = false;
  document.getElementById("message").textContent = "";
  form.removeAttribute("aria-busy");
});
