// Solves a picture without recording it, shows what was found, and records it where that is asked.
import { attempt } from "./actions.js";
import { parsed, rooted, unexpected } from "./requests.js";

const MOST_ROWS = 30;
const element = (id) => document.getElementById(id);
const form = element("picture");
const file = element("file");
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
  const progress = element("progress");
  progress.hidden = text === "";
  if (share === null) progress.removeAttribute("value");
  else progress.value = share;
  element("picture-status").textContent = text;
}

// The advice comes with a word of its kind before the colon.
const inWords = (remark) => remark.replace(/^(\w+): /, (_, word) => `${word.replaceAll("_", " ")}: `);

function items(list, texts) {
  element(list).replaceChildren(...texts.map((text) => Object.assign(document.createElement("li"), { textContent: inWords(text) })));
}

function row(cells) {
  const line = document.createElement("tr");
  for (const [index, [name, text]] of cells.entries()) {
    const cell = document.createElement(index ? "td" : "th");
    if (index) Object.assign(cell, { className: "number" }).dataset.name = name;
    else cell.scope = "row";
    cell.textContent = text;
    line.append(cell);
  }
  return line;
}

function fact([name, text]) {
  const line = document.createElement("div");
  line.append(Object.assign(document.createElement("dt"), { textContent: name }), Object.assign(document.createElement("dd"), { textContent: text }));
  return line;
}

const within = (sigma, unit) => (sigma === null ? "" : ` ± ${sigma}${unit}`);

function facts(picture) {
  const { attitude, lens } = picture;
  const [width, height] = lens.field_deg;
  const found = [
    ["middle", `RA ${attitude.ra_deg.toFixed(4)}°, Dec ${attitude.dec_deg.toFixed(4)}°`],
    ["roll", `${attitude.roll_deg.toFixed(3)}°, of the upper edge, from north through east`],
    ["quaternion", `${attitude.quaternion.join(", ")} (ICRS to camera, scalar last)`],
    ["sigma", `${attitude.sigma_arcsec.map((each) => each.toFixed(1)).join(", ")}″ about x, y, z`],
    ["status", `${attitude.status}: the lens was fitted on the picture itself`],
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
  for (const link of ["save", "save-json"]) URL.revokeObjectURL(element(link).href);
  const image = address(Uint8Array.from(atob(overlay), (each) => each.charCodeAt(0)), "image/png");
  const stars = picture.stars.length;
  Object.assign(element("drawn"), { src: image, alt: `${name} with ${stars} identified stars among ${picture.candidates} points of light; the table lists the brightest` });
  Object.assign(element("full"), { href: image, download: `${name}-stars.png` });
  Object.assign(element("save"), { href: image, download: `${name}-stars.png` });
  Object.assign(element("save-json"), { href: address(JSON.stringify(numbers), "application/json"), download: `${name}-stars.json` });
  element("found").hidden = false;
  element("failed").hidden = picture.attitude !== null;
  element("numbers").hidden = picture.attitude === null;
  if (picture.attitude === null) {
    items("advice", picture.remarks);
    element("hint-field").hidden = Boolean(element("field").value || element("camera").value);
    return `No attitude; ${picture.candidates} points of light.`;
  }
  const shown = picture.stars.slice(0, MOST_ROWS);
  element("star-rows").replaceChildren(...shown.map((star) => row([
    ["star", star.name ? `${star.name} (${star.id})` : star.id],
    ["V, mag", star.v_mag.toFixed(2)],
    ["right, px", star.u_px.toFixed(1)],
    ["down, px", star.v_px.toFixed(1)],
    ["residual, px", Math.hypot(...star.residual_px).toFixed(2)],
  ])));
  element("more-stars").textContent = stars > MOST_ROWS ? `The ${MOST_ROWS} brightest of ${stars}; the JSON has all.` : "";
  element("facts").replaceChildren(...facts(picture).map(fact));
  items("remarks", picture.remarks);
  return `${stars} stars identified, ${picture.candidates} points of light.`;
}

async function solve() {
  const mine = ++asked;
  const chosen = file.files[0];
  const query = new URLSearchParams({ overlay: "true" });
  if (element("camera").value) query.set("spacecraft", element("camera").value);
  if (element("field").value) query.set("field_of_view_deg", element("field").value);
  if (element("image").value.trim()) query.set("image", element("image").value.trim());
  const button = form.querySelector("button.main");
  button.disabled = true;
  for (const part of ["found", "failed", "record"]) if (element(part)) element(part).hidden = true;
  element("picture-status").className = "";
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
  element("picture-status").className = isRefused ? "problem" : "";
  element("picture-status").textContent = text;
}

function offerRecord(picture) {
  if (!element("record")) return;
  element("record").hidden = false;
  if (element("camera").value) element("record-camera").value = element("camera").value;
  element("record-time").value = picture.time ?? "";
  element("record-status").textContent = "";
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  solve();
});
element("record-form")?.addEventListener("submit", (event) => {
  event.preventDefault();
  attempt(event.target.querySelector("button"), element("record-status"), async () => {
    const query = new URLSearchParams();
    if (element("image").value.trim()) query.set("image", element("image").value.trim());
    for (const name of ["time", "batch"]) {
      if (element(`record-${name}`).value) query.set(name, element(`record-${name}`).value);
    }
    const name = encodeURIComponent(element("record-camera").value);
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
