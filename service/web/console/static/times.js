// Times as the console writes them: UTC with the day of the year.

export const DAY_S = 86400;

// POSIX seconds of recorded UTC text; a leap second counts as the second before it.
export const posix = (text) => Date.parse(text.replace(":60", ":59").replace(/(\.\d{3})\d*/, "$1")) / 1000;

export function twoDigits(value) {
  return String(value).padStart(2, "0");
}

// UTC with the day of the year, as everywhere in the console.
export function utc(seconds, withSeconds = true) {
  const moment = new Date(seconds * 1000);
  const text = moment.toISOString();
  return `${text.slice(0, 10)} (${dayOfYear(moment)}) ${text.slice(11, withSeconds ? 19 : 16)}`;
}

export function dayOfYear(moment) {
  const first = Date.UTC(moment.getUTCFullYear(), 0, 1);
  return String(Math.floor((moment.getTime() - first) / (DAY_S * 1000)) + 1).padStart(3, "0");
}

const FORM = /^(\d{4})[-/.:](?:(\d\d?)[-/.](\d\d?)(?: \(\d{3}\))?|(\d{3}))(?:(?:[T/:.-]|,? )(\d\d?)[:.](\d\d)(?:[:.](\d\d(?:\.\d{1,9})?))? ?(Z|UTC?|GMT|[+-]\d\d(?::?\d\d)?)?)?$/i;

// A typed time as the service reads it; throws what is wrong with it, in words.
export function typedTime(text) {
  const found = FORM.exec(text.trim().replace(/\s+/g, " "));
  if (!found) throw new Error(`must be UTC, such as 2026-11-27, 2026-11-27 18:30 or 2026-331/18:30:00`);
  const [year, month, day, ordinal, hour, minute, second] = found.slice(1, 8).map((part = "0") => part.padStart(2, "0"));
  const date = found[4] ? `${year}-${ordinal}` : `${year}-${month}-${day}`;
  const moment = found[4] ? new Date(Date.UTC(year, 0, Number(ordinal))) : new Date(Date.UTC(year, month - 1, day));
  const exists = found[4] ? Number(ordinal) > 0 && moment.getUTCFullYear() === Number(year) : moment.toISOString().startsWith(date);
  if (!exists) throw new Error(`${date}: there is no such day`);
  if (hour > 23 || minute > 59 || second >= 61) throw new Error(`${hour}:${minute}:${second}: there is no such time of day`);
  return { text: `${date}T${hour}:${minute}:${second}${/^[+-]/.test(found[8]) ? found[8] : "Z"}`, seconds: moment.getTime() / 1000 + hour * 3600 + minute * 60 + Number(second) };
}
