// Asking the service, with an error that says what happened and what to do where it fails.

const SILENT = "the service does not answer; check that it runs and can be reached, then try again";

// The answer and its text; throws where there is none, or where it ends in the middle.
export async function ask(address, options) {
  try {
    const answer = await fetch(address, options);
    return { answer, text: await answer.text() };
  } catch {
    throw new Error(SILENT);
  }
}

// The answer's JSON; throws with the service's own words where it refused.
export async function askJson(address, options) {
  const { answer, text } = await ask(address, options);
  const told = parsed(text);
  if (!answer.ok) throw new Error(told?.detail ?? unexpected(answer));
  if (told === null && text !== "") throw new Error(unexpected(answer));
  return told;
}

// What stands between, such as a proxy, may answer in its own way.
export function unexpected(answer) {
  return `the service answered ${answer.status}, which was not expected; try again in a minute`;
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}
