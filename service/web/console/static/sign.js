// Asks for name and reason before something is adopted, and says what that will change.
import { element, rememberWho } from "./actions.js";

// Resolves to { who, comment }, or to null if the reader changed their mind.
export function signed(title, changes, action) {
  const who = element("input", { name: "who", required: true, maxLength: 64, autocomplete: "name", size: 16 });
  const comment = element("input", { name: "comment", required: true, maxLength: 2000 });
  const form = element(
    "form",
    { className: "form", method: "dialog" },
    element("label", {}, "Name ", who),
    element("label", { className: "grow" }, "Reason ", comment),
    element("button", { className: "main", value: "yes", textContent: action }),
    element("button", { value: "no", type: "button", textContent: "Cancel", onclick: () => dialog.close("no") }),
  );
  const dialog = element(
    "dialog",
    { ariaLabel: title },
    element("h2", { textContent: title }),
    element("ul", {}, ...changes.map((each) => element("li", { textContent: each, className: each.startsWith("▲") ? "problem" : "" }))),
    form,
  );
  rememberWho(who);
  document.body.append(dialog);
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "yes" ? { who: who.value.trim(), comment: comment.value.trim() } : null);
    });
  });
}
