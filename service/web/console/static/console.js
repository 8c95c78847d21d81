// Parts of every page: the theme, the choice of a run, copying, and the event stream.
import { keepFresh, refreshSoon } from "./live_updates.js";
import { attempt, send } from "./actions.js";
import "./picture.js";
import "./time_fields.js";
import { rooted } from "./requests.js";

const theme = document.getElementById("theme");
const system = matchMedia("(prefers-color-scheme: dark)");

function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : system.matches;
}

function nameTheme() {
  theme.textContent = isDark() ? "Light" : "Dark";
  theme.setAttribute("aria-label", `Switch to the ${isDark() ? "light" : "dark"} theme`);
}

theme.addEventListener("click", () => {
  document.documentElement.dataset.theme = isDark() ? "light" : "dark";
  localStorage.setItem("theme", document.documentElement.dataset.theme);
  nameTheme();
  document.dispatchEvent(new Event("theme"));
});
system.addEventListener("change", () => {
  nameTheme();
  document.dispatchEvent(new Event("theme"));
});
nameTheme();

// On a narrow screen the content stands before the filter.
if (matchMedia("(max-width: 720px)").matches) {
  for (const each of document.querySelectorAll(".filter:not([data-open])")) each.open = each.querySelector("[aria-invalid]") !== null;
}

// A form with `data-now` is sent at each choice; a menu then lets go of the focus, so that it is drawn anew.
document.addEventListener("change", ({ target }) => {
  const { form } = target;
  if (!form?.matches("[data-now]")) return;
  if (target.matches("select")) target.blur();
  form.requestSubmit();
});

// The address of a page has the fields of its form that are filled in.
document.addEventListener("formdata", ({ target, formData }) => {
  if (!target.matches('[method="get"]')) return;
  const filled = [...formData].filter(([, value]) => value !== "");
  for (const name of [...formData.keys()]) formData.delete(name);
  for (const each of filled) formData.append(...each);
});

// The navigation is one stop of the Tab key; arrow keys go from page to page.
const pages = document.querySelector("nav");
function oneStop() {
  const links = [...pages.querySelectorAll("a")];
  const stop = links.find((each) => each === document.activeElement) ?? links.find((each) => each.ariaCurrent) ?? links[0];
  for (const each of links) each.tabIndex = each === stop ? 0 : -1;
}
oneStop();
document.addEventListener("drawn", oneStop);
pages.addEventListener("keydown", (event) => {
  const links = [...pages.querySelectorAll("a")];
  const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (!step) return;
  event.preventDefault();
  links[(links.indexOf(event.target) + step + links.length) % links.length].focus();
  oneStop();
});

// A sound at a new critical alarm, if it is switched on in this browser.
const sound = document.getElementById("sound");
let audio = null;

function nameSound() {
  sound.textContent = localStorage.getItem("sound") === "on" ? "Sound on" : "Sound off";
}

// Two tones; a browser makes none before the page was clicked or typed into.
function ring() {
  if (!navigator.userActivation?.hasBeenActive) {
    sound.textContent = "▲ Sound: click once to hear it";
    return;
  }
  audio ??= new AudioContext();
  audio.resume();
  for (const [number, hertz] of [880, 660].entries()) {
    const tone = new OscillatorNode(audio, { frequency: hertz });
    const volume = new GainNode(audio, { gain: 0.2 });
    tone.connect(volume).connect(audio.destination);
    tone.start(audio.currentTime + 0.25 * number);
    tone.stop(audio.currentTime + 0.25 * number + 0.2);
  }
  sound.dataset.rung = String(Number(sound.dataset.rung ?? 0) + 1);
}

sound.hidden = document.body.dataset.stream === "off";
nameSound();
sound.addEventListener("click", () => {
  localStorage.setItem("sound", localStorage.getItem("sound") === "on" ? "off" : "on");
  nameSound();
  // Also what tells the reader how it will sound, and lets the browser play it later.
  if (localStorage.getItem("sound") === "on") ring();
});
document.addEventListener("critical", () => localStorage.getItem("sound") === "on" && ring());

document.addEventListener("click", async (event) => {
  const button = event.target.closest("[data-copy]");
  if (!button) return;
  const source = document.getElementById(button.dataset.copy);
  try {
    await navigator.clipboard.writeText(source.textContent);
    button.textContent = "Copied";
  } catch {
    // Without permission for the clipboard: select the text, so that the keyboard can copy it.
    source.hidden = false;
    getSelection().selectAllChildren(source);
    button.textContent = "Marked: press Ctrl-C";
  }
});

// A button with all of its request: `data-send` is method and address, `data-done` what is said then.
document.addEventListener("click", ({ target }) => {
  const button = target.closest("[data-send]");
  if (!button) return;
  const { send: asked, body, done } = button.dataset;
  attempt(button, document.getElementById("message"), async () => {
    try {
      await send(...asked.split(" "), body);
    } finally {
      refreshSoon();
    }
    return done;
  });
});

document.getElementById("sign-out")?.addEventListener("click", (event) => {
  attempt(event.target, document.getElementById("connection"), async () => {
    await send("DELETE", "/api/v1/session");
    location.href = rooted("/sign-in");
  });
});

keepFresh();
