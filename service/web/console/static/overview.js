// The overview: filter and order its rows without loading the page anew, and the heat map.
import { HeatMap } from "./heat_map.js";
import { withoutReload } from "./regions.js";

const TYPING_MS = 200;
const heat = new HeatMap(document.getElementById("heat"));
withoutReload((text) => heat.say(text));

function show() {
  const cells = document.querySelector("#overview template[data-json]");
  heat.show(cells && JSON.parse(cells.content.textContent));
}

let typing = null;
document.addEventListener("input", ({ target }) => {
  const { form } = target;
  if (form?.id !== "filter") return;
  clearTimeout(typing);
  typing = setTimeout(() => form.requestSubmit(), target.matches("select") ? 0 : TYPING_MS);
});
document.addEventListener("drawn", show);
document.addEventListener("theme", show);
addEventListener("resize", show);
show();
