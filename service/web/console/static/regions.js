// Replaces parts of a page by newer ones; focus, input and selected text stay.
import { request, rooted, unexpected } from "./requests.js";

// The present page at an address; throws for an error page.
export async function fetchPage(address) {
  const { answer, text } = await request(address, { headers: { Accept: "text/html" } });
  // The session has ended: sign in again and return here.
  if (new URL(answer.url).pathname === rooted("/sign-in")) location.href = answer.url;
  const fresh = new DOMParser().parseFromString(text, "text/html");
  if (!answer.ok) {
    const problem = fresh.getElementById("problem");
    throw new Error(problem ? problem.querySelector("p").textContent : unexpected(answer));
  }
  return fresh;
}

let asked = 0;

// The same, or null if another page was requested since: late answers are not shown.
export async function fetchLatest(address) {
  const mine = ++asked;
  try {
    const fresh = await fetchPage(address);
    return mine === asked ? fresh : null;
  } catch (error) {
    if (mine === asked) throw error;
    return null;
  }
}

// Lets links and forms with `data-go`, and the browser's history, replace the regions of the page; returns
// what shows an address, which the history gets by its method `how`.
export function withoutReload(tell) {
  async function go(address, how = "pushState") {
    if (how) history[how](null, "", address);
    try {
      const fresh = await fetchLatest(location.href);
      if (fresh === null) return;
      swapRegions(fresh);
      document.dispatchEvent(new CustomEvent("drawn"));
    } catch (error) {
      tell(`Not shown: ${error.message}`);
    }
  }
  document.addEventListener("click", (event) => {
    const link = event.target.closest("a[data-go]");
    if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    go(link.href);
  });
  document.addEventListener("submit", (event) => {
    const { action, dataset } = event.target;
    if (dataset.go === undefined) return;
    event.preventDefault();
    go(`${action}?${new URLSearchParams(new FormData(event.target))}`, dataset.go || undefined);
  });
  addEventListener("popstate", () => go(location.href, null));
  return go;
}

// A region with typed input or selected text is not replaced.
function isBusy(region) {
  const active = document.activeElement;
  const marked = document.getSelection();
  const typing = region.contains(active) && active.matches("input:not(.pick), textarea, select");
  return typing || (marked && !marked.isCollapsed && region.contains(marked.anchorNode));
}

// Replaces every region of the page that has changed; focus and open details stay where they were.
export function swapRegions(fresh, selector = "[data-region]") {
  // The title counts the open alarms.
  if (fresh.title) document.title = fresh.title;
  for (const region of document.querySelectorAll(selector)) {
    const next = fresh.getElementById(region.id);
    if (!next || isBusy(region)) continue;
    for (const open of region.querySelectorAll("details[open][id]")) {
      const same = next.querySelector(`#${CSS.escape(open.id)}`);
      if (same) same.open = true;
    }
    keepTyped(region, next);
    if (next.isEqualNode(region)) continue;
    const focused = region.contains(document.activeElement) && placeOf(document.activeElement, region);
    region.replaceWith(document.adoptNode(next));
    if (focused) focused(next)?.focus({ preventScroll: true });
  }
}

// What was typed into a form that asks for another page, and not sent yet, stays in its field.
function keepTyped(region, next) {
  const forms = (part) => [...part.querySelectorAll('form[method="get"]')];
  const fresh = forms(next);
  for (const [index, form] of forms(region).entries()) {
    for (const field of form.querySelectorAll("input:not([type=hidden])[name]")) {
      const same = fresh[index]?.querySelector(`[name="${CSS.escape(field.name)}"]`);
      if (same && field.value !== field.defaultValue) same.value = field.value;
    }
  }
}

// Finds the same element in a fresh region: by its id, its address, or its label.
function placeOf(element, region) {
  if (element.id) return (next) => next.querySelector(`#${CSS.escape(element.id)}`);
  const kind = element.tagName.toLowerCase();
  const name = element.getAttribute("href") ?? element.getAttribute("aria-label");
  const attribute = element.hasAttribute("href") ? "href" : "aria-label";
  if (name === null) return null;
  return (next) => next.querySelector(`${kind}[${attribute}="${CSS.escape(name)}"]`);
}
