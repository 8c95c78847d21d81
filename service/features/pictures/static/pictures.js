// Solves a picture without recording it, shows what was found, and records it where that is asked.
import { attempt, element } from "./actions.js";
import { parsed, rooted, unexpected } from "./requests.js";

const MOST_ROWS = 30;
const byId = (id) => document.getElementById(id);
const form = byId("picture");
const file = byId("file");
let solved = null;
let asked = 0;

// Sends the file and reports how much of it has arrived.
function upload(address, body) {
  return new Promise((resolve, reject) => {
    const sending = new XMLHttpRequest();
    sending.open("POST", rooted(address));
    sending.setRequestHeader("Content-Type", "application/octet-stream");
    sending.upload.addEventListener("progress", (event) => {
      if (event.lengthComputable) show(event.loaded / event.total, `Sending: ${Math.round((100 * event.loaded) / event.total)} %`);
    });
    sending.upload.addEventListener("load", () => show(null, "Looking for stars; a large or difficult picture takes some seconds…"));
    sending.addEventListener("error", () => reject(new Error("the service does not answer; check that it is running and reachable, then try again")));
    sending.addEventListener("load", () => {
      const content = parsed(sending.responseText);
      if (sending.status < 300 && content) resolve(content);
      else reject(new Error(content?.detail ?? unexpected(sending)));
    });
    sending.send(body);
  });
}

function show(share, text) {
  const progress = byId("progress");
  progress.hidden = text === "";
  if (share === null) progress.removeAttribute("value");
  else progress.value = share;
  byId("picture-status").textContent = text;
}

// The advice comes with a word of its kind before the colon.
const inWords = (remark) => remark.replace(/^(\w+): /, (_, word) => `${word.replaceAll("_", " ")}: `);

function items(list, texts) {
  byId(list).replaceChildren(...texts.map((text) => element("li", {}, inWords(text))));
}

function row([[, first], ...others]) {
  const cells = others.map(([name, text]) => {
    const cell = element("td", { className: "number" }, text);
    cell.dataset.name = name;
    return cell;
  });
  return element("tr", {}, element("th", { scope: "row" }, first), ...cells);
}

const fact = ([name, text]) => element("div", {}, element("dt", {}, name), element("dd", {}, text));

const within = (sigma, unit) => (sigma === null ? "" : ` ± ${sigma}${unit}`);

function facts(picture) {
  const { attitude, lens } = picture;
  const [width, height] = lens.field_deg;
  const found = [
    ["middle", `RA ${attitude.ra_deg.toFixed(4)}°, Dec ${attitude.dec_deg.toFixed(4)}°`],
    ["roll", `${attitude.roll_deg.toFixed(3)}°, of the upper edge, from north through east`],
    ["quaternion", `${attitude.quaternion.join(", ")} (ICRS to camera, scalar last)`],
    ["sigma", `${attitude.sigma_arcsec.map((each) => each.toFixed(1)).join(", ")}″ about x, y, z`],
    ["aberration", attitude.aberration],
    ["field", `${width.toFixed(3)}° × ${height.toFixed(3)}°`],
    ["focal length", `${lens.focal_px.toFixed(1)} px${within(lens.focal_sigma_px, " px")}`],
    ["distortion", `${(100 * lens.distortion_corner).toFixed(3)} % at the corners`],
    ["optical axis", `${lens.center_px.join(", ")} px${within(lens.center_sigma_px, " px")}`],
    ["residuals", `${picture.residual_rms_px.toFixed(2)} px rms`],
    ["star images", `${picture.psf_sigma_px} px, one sigma`],
    ["time", picture.time ?? "not in the file"],
    ["pixels", picture.orientation],
  ];
  if (picture.zero_point_mag !== null) found.push(["zero point", `${picture.zero_point_mag} mag for one count${picture.exposure_s === null ? "" : " a second"}`]);
  return found;
}

function address(bytes, kind) {
  return URL.createObjectURL(new Blob([bytes], { type: kind }));
}

function draw(name, picture) {
  const { overlay_png: overlay, ...numbers } = picture;
  for (const link of ["save", "save-json"]) URL.revokeObjectURL(byId(link).href);
  const image = address(Uint8Array.from(atob(overlay), (each) => each.charCodeAt(0)), "image/png");
  const stars = picture.stars.length;
  Object.assign(byId("drawn"), { src: image, alt: `${name} with ${stars} identified stars among ${picture.candidates} points of light; the table lists the brightest` });
  Object.assign(byId("full"), { href: image, download: `${name}-stars.png` });
  Object.assign(byId("save"), { href: image, download: `${name}-stars.png` });
  Object.assign(byId("save-json"), { href: address(JSON.stringify(numbers), "application/json"), download: `${name}-stars.json` });
  byId("found").hidden = false;
  byId("failed").hidden = picture.attitude !== null;
  byId("numbers").hidden = picture.attitude === null;
  if (picture.attitude === null) {
    items("advice", picture.remarks);
    byId("hint-field").hidden = Boolean(byId("field").value || byId("camera").value);
    return `No attitude; ${picture.candidates} points of light.`;
  }
  const shown = picture.stars.slice(0, MOST_ROWS);
  byId("star-rows").replaceChildren(...shown.map((star) => row([
    ["star", star.name ? `${star.name} (${star.id})` : star.id],
    ["V, mag", star.v_mag.toFixed(2)],
    ["right, px", star.u_px.toFixed(1)],
    ["down, px", star.v_px.toFixed(1)],
    ["residual, px", Math.hypot(...star.residual_px).toFixed(2)],
  ])));
  byId("more-stars").textContent = stars > MOST_ROWS ? `The ${MOST_ROWS} brightest of ${stars}; the JSON has all.` : "";
  byId("suspect").hidden = picture.attitude.status !== "suspect";
  byId("facts").replaceChildren(...facts(picture).map(fact));
  items("remarks", picture.remarks);
  return `${stars} stars identified, ${picture.candidates} points of light.`;
}

async function solve() {
  const mine = ++asked;
  const chosen = file.files[0];
  const query = new URLSearchParams({ overlay: "true" });
  if (byId("camera").value) query.set("spacecraft", byId("camera").value);
  if (byId("field").value) query.set("field_of_view_deg", byId("field").value);
  if (byId("image").value.trim()) query.set("image", byId("image").value.trim());
  const button = form.querySelector("button.main");
  button.disabled = true;
  for (const part of ["found", "failed", "record"]) if (byId(part)) byId(part).hidden = true;
  byId("picture-status").className = "";
  show(0, "Sending…");
  let text = "";
  let isRefused = false;
  try {
    const picture = await upload(`/api/v1/pictures?${query}`, chosen);
    if (mine !== asked) return;
    text = draw(chosen.name, picture);
    solved = chosen;
    offerRecord(picture);
  } catch (error) {
    if (mine !== asked) return;
    isRefused = true;
    text = `Not solved: ${error.message}`;
  } finally {
    if (mine === asked) button.disabled = false;
  }
  show(0, "");
  byId("picture-status").className = isRefused ? "problem" : "";
  byId("picture-status").textContent = text;
}

function offerRecord(picture) {
  if (!byId("record")) return;
  byId("record").hidden = false;
  if (byId("camera").value) byId("record-camera").value = byId("camera").value;
  byId("record-time").value = picture.time ?? "";
  byId("record-status").textContent = "";
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  solve();
});
byId("record-form")?.addEventListener("submit", (event) => {
  event.preventDefault();
  attempt(event.target.querySelector("button"), byId("record-status"), async () => {
    const query = new URLSearchParams();
    if (byId("image").value.trim()) query.set("image", byId("image").value.trim());
    for (const name of ["time", "batch"]) {
      if (byId(`record-${name}`).value) query.set(name, byId(`record-${name}`).value);
    }
    const name = encodeURIComponent(byId("record-camera").value);
    const answer = await upload(`/api/v1/spacecraft/${name}/frames?${query}`, solved).finally(() => show(0, ""));
    location.href = rooted(`/batches/${answer.id}`);
  });
});
// A picture may be dropped anywhere on the page.
for (const kind of ["dragover", "dragleave", "drop"]) {
  document.addEventListener(kind, (event) => {
    event.preventDefault();
    form.classList.toggle("over", kind === "dragover");
    if (kind !== "drop" || !event.dataTransfer.files.length) return;
    file.files = event.dataTransfer.files;
    solve();
  });
}
