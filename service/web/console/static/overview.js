// The overview: filter and order its rows without loading the page anew, and the heat map.
import { HeatMap } from "./heat_map.js";
import { withoutReload } from "./regions.js";
import { rooted } from "./requests.js";

const TYPING_MS = 200;
const heat = new HeatMap(document.getElementById("heat"));
const go = withoutReload((text) => heat.say(text));

function show() {
  const cells = document.querySelector("#overview template[data-json]");
  heat.show(cells && JSON.parse(cells.content.textContent));
}

// The present address with the fields of the filter; other parameters stay.
function asked(form) {
  const query = new URLSearchParams(location.search);
  for (const [name, value] of new FormData(form)) {
    if (name === "run" || name === "sort") continue;
    if (value === "") query.delete(name);
    else query.set(name, value);
  }
  return rooted(query.size ? `/?${query}` : "/");
}

let typing = null;
document.addEventListener("input", (event) => {
  const form = event.target.closest("#filter");
  if (!form) return;
  clearTimeout(typing);
  typing = setTimeout(() => go(asked(form), "replaceState"), event.target.matches("select") ? 0 : TYPING_MS);
});
document.addEventListener("submit", (event) => {
  if (event.target.id !== "filter") return;
  event.preventDefault();
  clearTimeout(typing);
  go(asked(event.target), "replaceState");
});
document.addEventListener("drawn", show);
document.addEventListener("theme", show);
addEventListener("resize", show);
show();
