// Requests to the service; an error says what happened and what to do.

const NO_ANSWER = "the service does not answer; check that it is running and reachable, then try again";

// The prefix of every address where a proxy serves the service below a path.
const root = document.documentElement.dataset.root ?? "";

// A path of the service, or a whole address, as the browser must ask for it.
export function rooted(address) {
  return address.startsWith("/") ? root + address : address;
}

// The answer and its text; throws if there is none, or if it is truncated.
export async function request(address, options) {
  try {
    const answer = await fetch(rooted(address), options);
    return { answer, text: await answer.text() };
  } catch {
    throw new Error(NO_ANSWER);
  }
}

// The answer's JSON; throws an error with the service's message if the request was refused.
export async function requestJson(address, options) {
  const { answer, text } = await request(address, options);
  const content = parsed(text);
  if (!answer.ok) throw new Error(content?.detail ?? unexpected(answer));
  if (content === null && text !== "") throw new Error(unexpected(answer));
  return content;
}

// A proxy may answer in another format.
export function unexpected(answer) {
  return `unexpected answer ${answer.status} of the service; try again in a minute`;
}

// The value of JSON, or null for any other text.
export function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}
