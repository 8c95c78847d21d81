// Builds and drops zones.
import { refreshSoon } from "./live_updates.js";
import { attempt, send } from "./actions.js";

const message = document.getElementById("message");

function priorOf({ ra_deg, dec_deg }) {
  if (ra_deg.value.trim() === "" && dec_deg.value.trim() === "") return { sun_pointed: true };
  return { boresight: { ra_deg: Number(ra_deg.value), dec_deg: Number(dec_deg.value) } };
}

document.getElementById("warm").addEventListener("submit", (event) => {
  event.preventDefault();
  const fields = event.target.elements;
  attempt(event.submitter, message, async () => {
    const body = { spacecraft: fields.spacecraft.value, time: fields.time.value, a_priori: [priorOf(fields)] };
    const { items } = await send("POST", "/api/v1/zones", JSON.stringify(body));
    refreshSoon();
    return `Built or found: ${items.map((zone) => `${zone.kind} of ${zone.stars} stars and ${zone.pairs} pairs`).join("; ")}.`;
  });
});

document.getElementById("drop-zones").addEventListener("submit", (event) => {
  event.preventDefault();
  const name = event.target.elements.spacecraft.value;
  attempt(event.submitter, message, async () => {
    const query = name ? `?${new URLSearchParams({ spacecraft: name })}` : "";
    const { dropped } = await send("DELETE", `/api/v1/zones${query}`);
    refreshSoon();
    return `Dropped ${dropped} zones.`;
  });
});
