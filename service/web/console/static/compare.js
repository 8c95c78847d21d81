// Comparing takes up to ten seconds: shows that, and sends only the fields that are not empty.
const form = document.getElementById("compare");

form.addEventListener("submit", () => {
  for (const field of form.elements) {
    if (field.name && field.value === "") field.disabled = true;
  }
  document.getElementById("message").textContent = "Comparing…";
  form.setAttribute("aria-busy", "true");
});

// After the browser's Back button the fields work again.
addEventListener("pageshow", () => {
  for (const field of form.elements) field.disabled = false;
  document.getElementById("message").textContent = "";
  form.removeAttribute("aria-busy");
});
