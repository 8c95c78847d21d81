// Saves a chart as a PNG file, as the page shows it: canvases, shapes and words, below a heading.
import { element } from "./actions.js";
import { posix, utc } from "./times.js";

const LEFT_OUT = "svg, details, h2, .button, .hide, [role=status], [data-picture], [aria-pressed=false]";
const LINE_PX = 20;
const MARGIN_PX = 12;
const fontOf = ({ fontWeight, fontSize, fontFamily }) => `${fontWeight} ${fontSize} ${fontFamily}`;
const words = (each) => each?.textContent.replace(/\s+/g, " ").trim();

// The outline of a shape in its own units; a canvas draws no dot without a length.
function outline(shape) {
  const path = new Path2D((shape.getAttribute("d") ?? "").replace(/h0\b/g, "h.01"));
  const sizes = (...names) => names.map((name) => shape[name].baseVal.value);
  if (shape.tagName === "rect") path.rect(...sizes("x", "y", "width", "height"));
  if (shape.tagName === "circle") path.arc(...sizes("cx", "cy", "r"), 0, 2 * Math.PI);
  if (shape.tagName === "line") for (const end of ["1", "2"]) path.lineTo(...sizes(`x${end}`, `y${end}`));
  for (const { x, y } of shape.points ?? []) path.lineTo(x, y);
  if (shape.tagName === "polygon") path.closePath();
  return path;
}

function drawShape(pen, shape, toSheet) {
  const style = getComputedStyle(shape);
  const { fill, stroke, strokeDasharray: dashes } = style;
  if (style.visibility === "hidden") return;
  const toPage = DOMMatrix.fromMatrix(shape.getScreenCTM());
  pen.setTransform(toSheet.multiply(toPage));
  Object.assign(pen, { globalAlpha: Number(style.opacity), fillStyle: fill, strokeStyle: stroke, lineWidth: parseFloat(style.strokeWidth), lineCap: style.strokeLinecap, font: fontOf(style), textBaseline: "alphabetic" });
  pen.setLineDash(dashes === "none" ? [] : dashes.split(/[ ,]+/).map(parseFloat));
  if (shape.tagName === "text") {
    const { x, y } = shape.getStartPositionOfChar(0);
    if (stroke !== "none") pen.strokeText(shape.textContent, x, y);
    pen.fillText(shape.textContent, x, y);
    return;
  }
  const path = outline(shape);
  if (fill !== "none") pen.fill(path);
  if (stroke === "none") return;
  const onPage = new Path2D();
  onPage.addPath(path, toPage);
  const isRigid = style.vectorEffect === "non-scaling-stroke";
  if (isRigid) pen.setTransform(toSheet);
  pen.stroke(isRigid ? onPage : path);
}

function drawSvg(pen, svg, toSheet) {
  const { left, top, width, height } = svg.getBoundingClientRect();
  pen.save();
  pen.beginPath();
  pen.rect(left, top, width, height);
  if (getComputedStyle(svg).overflow === "hidden") pen.clip();
  for (const shape of svg.querySelectorAll("rect, circle, line, path, polyline, polygon, text")) {
    if (!shape.closest("clipPath") && shape.checkVisibility()) drawShape(pen, shape, toSheet);
  }
  pen.restore();
}

function drawWords(pen, text) {
  const holder = text.parentElement;
  if (holder.closest(LEFT_OUT) || !holder.checkVisibility()) return;
  const style = getComputedStyle(holder);
  Object.assign(pen, { fillStyle: style.color, font: fontOf(style), textBaseline: "middle" });
  const range = document.createRange();
  for (const { 0: word, index } of text.data.matchAll(/\S+/g)) {
    range.setStart(text, index);
    range.setEnd(text, index + word.length);
    const { left, top, height } = range.getBoundingClientRect();
    pen.fillText(word, left, top + height / 2);
  }
}

// The figures of the button, or its section, down to the button.
function save(button) {
  const whole = button.closest("figure, .maps, section");
  const section = whole.closest("section");
  const label = section.ariaLabel ?? words(document.getElementById(section.getAttribute("aria-labelledby")));
  const title = [label, button.dataset.picture].filter(Boolean).join(": ");
  const { start, end } = document.querySelector("main [data-start]")?.dataset ?? {};
  const period = [start, end].filter(Boolean).map((each) => utc(posix(each))).join(" to ");
  const { run } = document.body.dataset;
  const page = words(document.querySelector("h1"));
  const heading = [`${page}: ${title}`, `Run ${run}${period && `, ${period} UTC`}`];
  const { left, width, ...box } = whole.getBoundingClientRect().toJSON();
  const top = whole.querySelector(":scope > h2")?.getBoundingClientRect().bottom ?? box.top;
  const pen = element("canvas").getContext("2d");
  const { color, fontFamily } = getComputedStyle(document.body);
  const font = `600 14px ${fontFamily}`;
  pen.font = font;
  const room = Math.max(width, ...heading.map((each) => pen.measureText(each).width));
  const above = heading.length * LINE_PX + MARGIN_PX;
  // A canvas has pixels of its own; shapes are drawn finer than a coarse screen shows them.
  const px = whole.querySelector("canvas") ? devicePixelRatio : Math.max(2, devicePixelRatio);
  const sheet = Object.assign(pen.canvas, { width: px * (room + 2 * MARGIN_PX), height: px * (above + button.getBoundingClientRect().top - top + MARGIN_PX) });
  pen.fillStyle = getComputedStyle(section).backgroundColor;
  pen.fillRect(0, 0, sheet.width, sheet.height);
  pen.scale(px, px);
  Object.assign(pen, { fillStyle: color, font, textBaseline: "top" });
  for (const [row, text] of heading.entries()) pen.fillText(text, MARGIN_PX, MARGIN_PX + row * LINE_PX);
  const toSheet = new DOMMatrix([px, 0, 0, px, px * (MARGIN_PX - left), px * (above - top)]);
  pen.setTransform(toSheet);
  for (const each of whole.querySelectorAll("canvas, .alarm-bars *")) {
    const { x, y, width: wide, height: high } = each.getBoundingClientRect();
    pen.fillStyle = getComputedStyle(each).backgroundColor;
    pen.fillRect(x, y, wide, high);
    if (each.matches("canvas")) pen.drawImage(each, x, y, wide, high);
  }
  for (const svg of whole.querySelectorAll("svg")) if (!svg.closest("details")) drawSvg(pen, svg, toSheet);
  const texts = document.createTreeWalker(whole, NodeFilter.SHOW_TEXT);
  while (texts.nextNode()) drawWords(pen, texts.currentNode);
  const href = sheet.toDataURL();
  if (href.length < 100) {
    button.textContent = "The picture is too large for this browser";
    return;
  }
  element("a", { href, download: `${[page, title, run].join(" ").replace(/[^\w.-]+/g, "-")}.png` }).click();
}

document.addEventListener("click", ({ target }) => {
  const button = target.closest("[data-picture]");
  if (button) save(button);
});
