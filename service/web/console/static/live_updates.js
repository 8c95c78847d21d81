// The event stream: it reports what was recorded, and the page is then fetched and redrawn.
//
// Every event has a number.  After an interruption the request names the last number received, and
// the events since then follow.  A hidden page without sound closes its stream, because a browser keeps only six
// connections to a server, and catches up when it is visible again.
import { fetchLatest, swapRegions } from "./regions.js";
import { rooted } from "./requests.js";
import { utc } from "./times.js";

const EVENT_KINDS = [
  "batches",
  "alarm",
  "limit",
  "annotation",
  "replay",
  "adopted",
  "tracking",
  "calibration",
];
const DRAW_EVERY_MS = 1000;
const SHARE_OF_DRAWING = 0.2;
const FIRST_RETRY_MS = 1000;
const LONGEST_RETRY_MS = 30000;
const SHOW_LOST_AFTER_MS = 3000;
const POLL_MS = 10000;

const shown = document.getElementById("connection");
const run = document.body.dataset.run;
// True for pages that list replays of every run.
const isOfEveryRun = document.querySelector("[data-every-run]") !== null;
let source = null;
let last = document.body.dataset.lastEvent || null;
let drawing = null;
let lostAt = null;
let retryMs = FIRST_RETRY_MS;
let retry = null;
let refused = false;
let stale = false;
let drawEveryMs = DRAW_EVERY_MS;

function showState(state, text) {
  shown.className = "";
  shown.dataset.state = state;
  shown.textContent = text;
}

function concernsRun(data) {
  return data.run === undefined || data.run === run;
}

// Redraws the page soon, at most once a second however much is recorded; less often if the page
// takes so long that it would keep the service busy.
export function refreshSoon() {
  drawing ??= setTimeout(async () => {
    drawing = null;
    const begun = performance.now();
    try {
      const fresh = await fetchLatest(location.href);
      if (fresh === null) return;
      const wishedMs = (performance.now() - begun) / SHARE_OF_DRAWING;
      drawEveryMs = Math.min(POLL_MS, Math.max(DRAW_EVERY_MS, wishedMs));
      swapRegions(fresh);
      document.dispatchEvent(new CustomEvent("drawn"));
      if (stale && lostAt === null && !refused) showState("live", "● Connected");
      stale = false;
    } catch (error) {
      stale = true;
      showState("lost", `▲ Not up to date: ${error.message}; trying again every ${POLL_MS / 1000} s; the page shows the previous state`);
      setTimeout(refreshSoon, POLL_MS);
    }
  }, drawEveryMs);
}

// Ages on the page, counted on from the time at which it was drawn.
let drawnAt = performance.now();
document.addEventListener("drawn", () => (drawnAt = performance.now()));

function ageText(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  const units = [[86400, "d", 3600, "h"], [3600, "h", 60, "min"], [60, "min", 1, "s"]];
  for (const [size, unit, below, smaller] of units) {
    if (whole < size) continue;
    const small = whole >= 100 * size ? 0 : Math.floor((whole % size) / below);
    return `${Math.floor(whole / size)}\u202f${unit}${small ? ` ${small}\u202f${smaller}` : ""}`;
  }
  return `${whole}\u202fs`;
}

setInterval(() => {
  for (const each of document.querySelectorAll("[data-age]")) {
    each.textContent = ageText(Number(each.dataset.age) + (performance.now() - drawnAt) / 1000);
  }
}, 1000);

function streamAddress() {
  const query = new URLSearchParams(isOfEveryRun ? {} : { run });
  if (document.body.dataset.stream) query.set("spacecraft", document.body.dataset.stream);
  if (last !== null) query.set("last_event_id", last);
  return rooted(`/api/v1/events?${query}`);
}

function connect() {
  source = new EventSource(streamAddress());
  source.addEventListener("hello", connected);
  source.addEventListener("reset", (event) => {
    last = event.lastEventId;
    refreshSoon();
  });
  for (const kind of EVENT_KINDS) source.addEventListener(kind, received);
  source.addEventListener("error", interrupted);
}

function connected(event) {
  // The events since the requested number follow.
  last = event.lastEventId;
  lostAt = null;
  retryMs = FIRST_RETRY_MS;
  showState("live", "● Connected");
}

export function received(event) {
  last = event.lastEventId || last;
  const data = JSON.parse(event.data);
  if (!isOfEveryRun && !concernsRun(data)) return;
  if (event.type === "alarm" && concernsRun(data)) noteCritical(data);
  refreshSoon();
}

// Alarms that are critical now: each excursion is reported once to whatever sounds.
const critical = new Set();

function noteCritical({ id, state, current_severity: severity }) {
  if (severity !== "critical" || state !== "open") critical.delete(id);
  else if (!critical.has(id)) {
    critical.add(id);
    document.dispatchEvent(new CustomEvent("critical"));
  }
}

// A hidden page listens only for what sounds.
const isIdle = () => document.hidden && localStorage.getItem("sound") !== "on";

async function interrupted() {
  // Streams end now and then by design, and the next attempt succeeds: that is not shown.
  if (lostAt === null) {
    lostAt = Date.now();
    setTimeout(showLost, SHOW_LOST_AFTER_MS);
  }
  // A browser gives up a stream that was answered with a status other than 200.
  const wasRefused = source.readyState === EventSource.CLOSED;
  // Opened again here and not by the browser, so that the request names the last number received.
  source.close();
  source = null;
  let waitMs = retryMs;
  retryMs = Math.min(2 * retryMs, LONGEST_RETRY_MS);
  if (wasRefused) {
    const { status, retryAfterMs } = await refusal();
    if (status === 401 || status === 403) {
      stop(status);
      return;
    }
    waitMs = Math.max(waitMs, retryAfterMs);
  }
  scheduleRetry(waitMs);
}

// The status of the stream's address, which an EventSource does not report; 0 without an answer.
async function refusal() {
  const ended = new AbortController();
  try {
    const { status, headers } = await fetch(streamAddress(), { signal: ended.signal });
    return { status, retryAfterMs: 1000 * (Number(headers.get("Retry-After")) || 0) };
  } catch {
    return { status: 0, retryAfterMs: 0 };
  } finally {
    ended.abort();
  }
}

function scheduleRetry(waitMs) {
  clearTimeout(retry);
  retry = setTimeout(() => {
    retry = null;
    if (source === null && !isIdle()) connect();
  }, waitMs);
  if (lostAt !== null && Date.now() - lostAt > SHOW_LOST_AFTER_MS) showLost();
}

function stop(status) {
  refused = true;
  lostAt = null;
  const reason = status === 401 ? "The session has ended: sign in again" : "This token may not read the events";
  showState("lost", `▲ Not connected. ${reason}; the page shows the state of ${utc(Date.now() / 1000)} UTC`);
}

function showLost() {
  if (lostAt === null) return;
  showState("lost", `▲ Connection lost since ${utc(lostAt / 1000)} UTC; trying again. The page shows the previous state`);
}

export function keepFresh() {
  // Nothing that is recorded changes such a page.
  if (document.body.dataset.stream === "off") return;
  // There is no stream for a token that is bound to several spacecraft.
  if (document.body.dataset.stream === "none") {
    setInterval(() => document.hidden || refreshSoon(), POLL_MS);
    showState("live", "● Updated every 10 s");
    return;
  }
  document.addEventListener("visibilitychange", () => {
    if (isIdle()) {
      source?.close();
      source = null;
    } else if (source === null && retry === null && !refused) connect();
  });
  if (!isIdle()) connect();
}
