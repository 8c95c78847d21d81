"""Text formats of the console: UTC with day of year, numbers with units, words for states.

A state has a word and a shape, so that no one depends on colour.  An unknown value is a dash, never
a zero.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from markupsafe import Markup

from service.times import Utc, recorded_utc, shifted, utc_now
from service.trends.measures import SmoothedShare
from service.trends.quantities import Quantity, quantity_named

DASH = "–"
THIN = "\N{NARROW NO-BREAK SPACE}"

STATES: Mapping[str, tuple[str, str]] = {
    "good": ("●", "good"),
    "suspect": ("▲", "suspect"),
    "no_attitude": ("○", "no attitude"),
    "no_batches": ("–", "no batches"),
    "silent": ("◌", "silent"),
    "behind": ("◌", "behind"),
    "unique": ("●", "unique"),
    "ambiguous": ("▲", "ambiguous"),
    "unmatched": ("✕", "unmatched"),
    "watch": ("△", "watch"),
    "warning": ("▲", "warning"),
    "critical": ("◆", "critical"),
    "open": ("!", "open"),
    "acknowledged": ("✓", "acknowledged"),
    "shelved": ("‖", "shelved"),
    "cleared": ("○", "cleared"),
    "running": ("▸", "running"),
    "waiting": ("‖", "waits for the service to be ready"),
    "done": ("●", "done"),
    "interrupted": ("‖", "interrupted"),
    "cancelled": ("‖", "cancelled"),
    "failed": ("✕", "failed"),
    "acquiring": ("▲", "acquiring"),
    "tracking": ("●", "tracking"),
    "lost": ("✕", "lost"),
}
"""Shape and word that show a state, by the name of the state."""


_CLOCK = r"(\d\d?)[:.](\d\d)(?:[:.](\d\d(?:\.\d{1,9})?))?"
_DAY = r"(?:(\d{4})[-/.:])?(?:(\d\d?)[-/.](\d\d?)(?: \(\d{3}\))?|(\d{3}))"
_TYPED = re.compile(
    rf"(?:{_DAY}(?:[T/:.-]|,? ))?{_CLOCK} ?(Z|UTC?|GMT|[+-]\d\d(?::?\d\d)?)?|{_DAY}", re.ASCII
)
_MONTHS = ["JAN", "FEB", "MAR", "APR", "MAY", "JUN", "JUL", "AUG", "SEP", "OCT", "NOV", "DEC"]
_MONTH = re.compile(rf"\b({'|'.join(_MONTHS)})[A-Z]*")
_REORDERED = (
    (re.compile(r"(\d\d?)[ -](\d\d)M[ -](\d{4})", re.ASCII), r"\3-\2-\1"),
    (re.compile(r"(\d\d)M (\d\d?),? (\d{4})", re.ASCII), r"\3-\1-\2"),
    (re.compile(r"(\d{4})[ -](\d\d)M[ -](\d\d?)", re.ASCII), r"\1-\2-\3"),
    (re.compile(r"(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)", re.ASCII), r"\1-\2-\3T\4:\5:\6"),
)
"""Orders of a date with a month's name, now a number and M, and ISO 8601's basic form."""


def completed_utc(text: str, near: Utc | None = None) -> str:
    """Complete a typed time to the form that `parse_utc` reads; other text is unchanged.

    Read are calendar days and days of the year with any usual separator or a month's name, as the
    pages write them, too; the seconds, the time of day and the zone may be missing.  The year
    or the whole day may be missing if a time `near` it is given.
    """
    typed = _MONTH.sub(lambda m: f"{1 + _MONTHS.index(m[1]):02d}M", " ".join(text.upper().split()))
    for form, order in _REORDERED:
        typed = form.sub(order, typed, count=1)
    match = _TYPED.fullmatch(typed)
    if match is None:
        return text
    parts = match.groups("")
    hour, minute, second, zone = parts[4:8]
    year, month, day, ordinal = parts[:4] if hour else parts[8:]
    if not year:
        if near is None or not hour:
            return text
        if month or ordinal:
            days = int(ordinal) if ordinal else 30.6 * (int(month) - 1) + int(day)
            # The last such day, but for what the length of months is off.
            year = str(int(near.text[:4]) - (days > near.day_of_year + 3))
        else:
            # The last day on which this time of day is not after the given one, but for a minute.
            last = shifted(near, 60.0 - 60.0 * (60 * int(hour) + int(minute)))
            year, month, day = last.text[:10].split("-")
    date = f"{year}-{ordinal}" if ordinal else f"{year}-{month:0>2}-{day:0>2}"
    zone = zone if zone[:1] in ("+", "-") else "Z"
    return f"{date}T{hour or '00':0>2}:{minute or '00'}:{second or '00'}{zone}"


def present() -> Utc:
    """Current time, to the second."""
    return recorded_utc(utc_now().text[:19])


def second_after(time: str) -> Utc:
    """Whole second after a batch, so that a period that ends there contains the batch."""
    return shifted(recorded_utc(time[:19] + "Z"), 1.0)


def with_day_of_year(moment: Utc | str, seconds: bool = True) -> str:
    """UTC text for readers: date, day of year, time of day."""
    moment = recorded_utc(moment) if isinstance(moment, str) else moment
    day, _, clock = moment.text.partition("T")
    return f"{day} ({moment.day_of_year:03d}) {clock[: 8 if seconds else 5]}"


def utc(moment: Utc | str | None, seconds: bool = True) -> Markup:
    """UTC text as an HTML `time` element; a dash without a time."""
    if moment is None:
        return Markup(DASH)
    moment = recorded_utc(moment) if isinstance(moment, str) else moment
    return Markup('<time datetime="{}">{}</time>').format(
        moment.text, with_day_of_year(moment, seconds)
    )


def utc_short(moment: str) -> Markup:
    """Month, day and time of day for a narrow column; the `time` element has the full time."""
    return Markup('<time datetime="{}" title="{} UTC">{}</time>').format(
        moment, with_day_of_year(moment), f"{moment[5:10]} {moment[11:16]}"
    )


def age(seconds: float | None) -> str:
    """Text of a duration in its two largest units, from a hundred days in days alone."""
    if seconds is None:
        return DASH
    whole = max(0, round(seconds))
    for size, unit, below, smaller in (
        (86400, "d", 3600, "h"),
        (3600, "h", 60, "min"),
        (60, "min", 1, "s"),
    ):
        if whole >= size:
            large, small = whole // size, whole % size // below
            if large >= 100:
                small = 0
            return (
                f"{large}{THIN}{unit} {small}{THIN}{smaller}" if small else f"{large}{THIN}{unit}"
            )
    return f"{whole}{THIN}s"


def share(part: float | None, whole: float | None = 1) -> str:
    """Text of a percentage to two or three digits; a dash without a value or a whole."""
    if part is None or not whole:
        return DASH
    percent = 100 * part / whole
    decimals = 0 if percent >= 99.95 or percent == 0 else 1 if percent >= 9.995 else 2
    return f"{percent:.{decimals}f}{THIN}%"


def number(value: float | None, decimals: int = 2) -> str:
    """Text of a number with fixed decimals and a true minus sign; a dash if not finite."""
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:.{decimals}f}".replace("-", "−")


def level(value: float) -> str:
    """Text of a number to four digits, without an exponent for small values."""
    if value == 0.0:
        return "0"
    return number(value, min(9, max(0, 3 - math.floor(math.log10(abs(value))))))


def arcsec(value: float | None) -> str:
    """Text of an angle in arcseconds to three digits; from 3600 arcseconds in degrees."""
    if value is None or not math.isfinite(value):
        return DASH
    if abs(value) >= 3600:
        return f"{number(value / 3600)}°"
    decimals = 0 if abs(value) >= 99.95 else 1 if abs(value) >= 9.995 else 2
    return f"{number(value, decimals)}″"


def degrees(value: float | None, decimals: int = 3) -> str:
    """Text of an angle in degrees; a dash without a value."""
    return DASH if value is None else f"{number(value, decimals)}°"


def magnitude(value: float | None, decimals: int = 2) -> str:
    """Text of a magnitude with its unit; a dash without a value."""
    return DASH if value is None else f"{number(value, decimals)}{THIN}mag"


def count(value: int | None) -> str:
    """Text of a whole number with digits in groups of three; a dash without a value."""
    return DASH if value is None else f"{value:,}".replace(",", THIN)


def plural(number: int, word: str) -> str:
    """Text of a count with its noun, in the plural unless it is one."""
    return f"{count(number)} {word}{'' if number == 1 else 's'}"


def microseconds(value: float | None) -> str:
    """Text of a duration in microseconds, of a long one in milliseconds."""
    if value is None:
        return DASH
    if value >= 10_000:
        return f"{value / 1000:.1f}{THIN}ms"
    return f"{count(round(value))}{THIN}µs"


def size(value: int) -> str:
    """Text of the size of a file or of memory, with its unit."""
    for least, unit in ((1_000_000_000, "GB"), (1_000_000, "MB"), (1_000, "kB")):
        if value >= least:
            return f"{value / least:.1f}{THIN}{unit}"
    return f"{value}{THIN}B"


def sigmas(covariance_arcsec2: Sequence[Sequence[float]]) -> list[float]:
    """Standard deviations about the body axes, from a covariance matrix of the attitude."""
    return [math.sqrt(max(covariance_arcsec2[k][k], 0.0)) for k in range(3)]


REASONS: Mapping[str, str] = {
    "fewer_than_two_unique_stars": "fewer than two unique stars",
    "degenerate_geometry": "the stars lie too close together, or on one line",
    "fewer_than_three_stars": "fewer than three stars, too few to search the whole sky",
    "no_match": "no attitude explains three of the stars",
    "doubtful_match": "an attitude explains some stars, but chance may as well",
}
"""Explanations why there is no attitude, by reason code."""


def reason(code: str | None) -> str:
    """Readable text for a reason code; a code of another version without its underscores."""
    return REASONS.get(code or "", plain(code))


def warning(text: str) -> tuple[str, str]:
    """Sentence for a warning of a batch, and the code of the warning."""
    code, _, said = text.partition(":")
    said = said.strip()
    if said in REASONS:
        return f"The search of the whole sky gave nothing better: {REASONS[said]}.", code
    return said or plain(code).capitalize(), code


def typed_time(moment: Utc | str | None) -> str:
    """Text of a time for a form field: to the second if no fraction follows."""
    if moment is None or moment == "":
        return ""
    text = moment if isinstance(moment, str) else moment.text
    return re.sub(r"(\.\d*?)0+Z$", r"\1Z", text).replace(".Z", "Z")


def plain(word: str | None) -> str:
    """Readable word for a name of the interface: `no_attitude` without its underscore."""
    return (word or "").replace("_", " ")


def state(name: str | None, words: str | None = None) -> Markup:
    """HTML of a state: its shape, its word or another text, and a class for its colour."""
    name = name or "no_attitude"
    shape, word = STATES[name][0], words or STATES[name][1]
    return Markup('<span class="state {}"><span aria-hidden="true">{}</span> {}</span>').format(
        name, shape, word
    )


UNITS: Mapping[str, Callable[[float], str]] = {
    "arcsec": arcsec,
    "deg": degrees,
    "mag": magnitude,
    "ppm": lambda value: f"{number(value, 0)}{THIN}ppm",
    "s": age,
}


def _in_percent(known: Quantity) -> bool:
    return known.is_share or isinstance(known.source, SmoothedShare)


def quantity(value: float | None, name: str) -> str:
    """Text of the value of a quantity with its unit; a dash without a value."""
    if value is None:
        return DASH
    known = quantity_named(name)
    if _in_percent(known):
        return share(value)
    if (shown := UNITS.get(known.unit)) is not None:
        return shown(value)
    return number(value) if known.unit in ("", "1") else f"{number(value)}{THIN}{known.unit}"


def unit_of(name: str) -> str:
    """Unit in which a quantity is shown and entered; percent for shares."""
    known = quantity_named(name)
    return "%" if _in_percent(known) else ENTERED_UNITS.get(known.unit, known.unit)


def entered(value: float | None, name: str) -> str:
    """Text of a quantity's bound in its `unit_of`, for a form field; empty without one."""
    if value is None:
        return ""
    return f"{100 * value if _in_percent(quantity_named(name)) else value:.6g}"


def bounds(settings: Mapping[str, Any], name: str) -> str:
    """Text on the limits of a quantity: bounds, hysteresis, number of batches and duration."""
    if not settings["enabled"]:
        return "off"
    parts = [
        f"{severity} {word} {quantity(settings[severity][bound], name)}"
        for severity in ("watch", "warning", "critical")
        for bound, word in (("low", "below"), ("high", "above"))
        if settings[severity][bound] is not None
    ]
    if not parts:
        return "no bounds, so it raises no alarm"
    held = f"hysteresis {quantity(settings['hysteresis'], name)}"
    count = f"mean of {settings['minimum_count']} batches"
    return f"{', '.join(parts)}; {held}, {count}, for {age(settings['duration_s'])}"


ENTERED_UNITS: Mapping[str, str] = {"1": "", "arcsec": "″", "deg": "°"}

_INVISIBLE = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u00ad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180b-\u180f\u200b-\u200f"
    r"\u2028-\u202e\u2060-\u206f\u2800\u3164\ufe00-\ufe0f\ufeff\uffa0\ufff0-\ufffb"
    r"\U000e0000-\U000e0fff]"
)
"""Pattern of invisible characters, and of those that change the direction of text."""


def name(text: str) -> str:
    """Name with the codes of its invisible characters, so that no two names look alike."""
    if text.isspace() or text != text.strip():
        text = re.sub(r"^\s+|\s+$", lambda found: "".join(map(_code, found[0])), text)
    return _INVISIBLE.sub(lambda found: _code(found[0]), text)


def _code(character: str) -> str:
    return f"\u2039U+{ord(character):04X}\u203a"


FILTERS: Mapping[str, Callable[..., Any]] = {
    "name": name,
    "utc": utc,
    "utc_short": utc_short,
    "age": age,
    "share": share,
    "num": number,
    "level": level,
    "arcsec": arcsec,
    "deg": degrees,
    "mag": magnitude,
    "cnt": count,
    "us": microseconds,
    "size": size,
    "sigmas": sigmas,
    "plain": plain,
    "reason": reason,
    "warning": warning,
    "typed": typed_time,
    "state": state,
    "quantity": quantity,
    "unit_of": unit_of,
    "entered": entered,
    "bounds": bounds,
    "called": lambda name: quantity_named(name).label,
}
