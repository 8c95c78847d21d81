// Keeps the page up to date: asks for it anew and puts the fresh part in place.
// Without this script the page reloads itself twice a minute.
"use strict";

const EVERY_MS = 5000;
const connection = document.getElementById("connection");
let lostAt = null;

function keepOpen(fresh) {
  for (const open of document.querySelectorAll("main details[open]")) {
    const same = fresh.querySelector(`details[id="${CSS.escape(open.id)}"]`);
    if (same) same.open = true;
  }
}

function isBusy(view) {
  // Someone reads with the keyboard or has text marked: do not pull it away.
  const marked = document.getSelection();
  return view.contains(document.activeElement) || (marked && !marked.isCollapsed);
}

async function refresh() {
  const view = document.getElementById("view");
  if (document.hidden || isBusy(view)) return;
  try {
    const answer = await fetch(location.href, { headers: { Accept: "text/html" } });
    if (!answer.ok) throw new Error(String(answer.status));
    const fresh = new DOMParser().parseFromString(await answer.text(), "text/html").getElementById("view");
    keepOpen(fresh);
    if (!isBusy(view)) view.replaceWith(document.adoptNode(fresh));
    lostAt = null;
    connection.textContent = "";
  } catch {
    lostAt = lostAt || new Date().toISOString().slice(0, 19).replace("T", " ");
    connection.textContent = `No answer from the service since ${lostAt} UTC; what stands below is of its own time.`;
  }
}

setInterval(refresh, EVERY_MS);
document.addEventListener("visibilitychange", refresh);
