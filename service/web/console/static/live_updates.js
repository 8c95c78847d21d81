// The live connection: hears what was recorded and has the page drawn anew, without losing anything.
//
// Every message has a number.  After a break the last one heard is named, and what came since
// follows.  A hidden page lets go of its connection, since a browser keeps only six to a server,
// and catches up when it is looked at again.
import { fetchLatest, swapRegions } from "./regions.js";

const EVENT_KINDS = ["batches", "alarm", "limit", "replay", "adopted"];
const DRAW_EVERY_MS = 1000;
const RECONNECT_MS = 1000;
const SHOW_LOST_AFTER_MS = 3000;
const POLL_MS = 10000;

const shown = document.getElementById("connection");
const run = document.body.dataset.run;
let source = null;
let last = document.body.dataset.lastEvent || null;
let drawing = null;
let lostAt = null;
let stale = false;

function clock(moment) {
  return moment.toISOString().slice(0, 19).replace("T", " ");
}

function say(state, text) {
  shown.className = "";
  shown.dataset.state = state;
  shown.textContent = text;
}

function isOurs(data) {
  return data.run === undefined || data.run === run;
}

// Draws soon, and not more often than once a second however much is recorded.
export function refreshSoon() {
  drawing ??= setTimeout(async () => {
    drawing = null;
    try {
      const fresh = await fetchLatest(location.href);
      if (fresh === null) return;
      swapRegions(fresh);
      document.dispatchEvent(new CustomEvent("drawn"));
      if (stale && lostAt === null) say("live", "● Connected");
      stale = false;
    } catch (error) {
      stale = true;
      say("lost", `▲ Not up to date: ${error.message}; trying again every ${POLL_MS / 1000} s; the page shows the previous state`);
      setTimeout(refreshSoon, POLL_MS);
    }
  }, DRAW_EVERY_MS);
}

// How long ago something was, counted on from what the page was drawn with.
let drawnAt = performance.now();
document.addEventListener("drawn", () => (drawnAt = performance.now()));

function inWords(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  const units = [[86400, "d", 3600, "h"], [3600, "h", 60, "min"], [60, "min", 1, "s"]];
  for (const [size, unit, below, smaller] of units) {
    if (whole < size) continue;
    const small = Math.floor((whole % size) / below);
    return `${Math.floor(whole / size)}\u202f${unit}${small ? ` ${small}\u202f${smaller}` : ""}`;
  }
  return `${whole}\u202fs`;
}

setInterval(() => {
  for (const each of document.querySelectorAll("[data-age]")) {
    each.textContent = inWords(Number(each.dataset.age) + (performance.now() - drawnAt) / 1000);
  }
}, 1000);

function connect() {
  const query = new URLSearchParams({ run });
  if (document.body.dataset.stream) query.set("spacecraft", document.body.dataset.stream);
  if (last !== null) query.set("last_event_id", last);
  source = new EventSource(`/api/v1/events?${query}`);
  source.addEventListener("hello", (event) => heardFirst(event));
  source.addEventListener("reset", (event) => {
    last = event.lastEventId;
    refreshSoon();
  });
  for (const kind of EVENT_KINDS) source.addEventListener(kind, (event) => heard(kind, event));
  source.addEventListener("error", lost);
}

function heardFirst(event) {
  // What came since the number that was asked for follows by itself.
  last = event.lastEventId;
  lostAt = null;
  say("live", "● Connected");
}

function heard(kind, event) {
  last = event.lastEventId || last;
  const data = JSON.parse(event.data);
  if (!isOurs(data)) return;
  document.dispatchEvent(new CustomEvent("heard", { detail: { kind, data } }));
  refreshSoon();
}

function lost() {
  // Streams end now and then by design, and the next attempt succeeds: no reason for alarm yet.
  if (lostAt === null) {
    lostAt = new Date();
    setTimeout(tellLost, SHOW_LOST_AFTER_MS);
  }
  // Tried again here and not by the browser, so that the number asked for is the last one heard.
  source.close();
  source = null;
  setTimeout(() => source ?? (document.hidden || connect()), RECONNECT_MS);
}

function tellLost() {
  if (lostAt === null) return;
  say("lost", `▲ Connection lost since ${clock(lostAt)} UTC; trying again every second. The page shows the previous state`);
}

export function keepFresh() {
  // There is no stream for a token that is bound to several spacecraft.
  if (document.body.dataset.stream === "none") {
    setInterval(() => document.hidden || refreshSoon(), POLL_MS);
    say("live", "● Updated every 10 s");
    return;
  }
  document.addEventListener("visibilitychange", () => {
    if (document.hidden) {
      source?.close();
      source = null;
    } else if (source === null) connect();
  });
  if (!document.hidden) connect();
}
