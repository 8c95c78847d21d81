"""The time and the exposure that a FITS header tells (FITS Standard 4.0, section 9).

A time that may be wrong is none: keywords that contradict each other, dates without a time of
day and time scales that are not converted lead to no time, with the reason in words.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta

from erfa import ufunc

from service.errors import BadInput
from service.imaging.frames.fits_header import Header
from service.times import DAY_S, Utc, parse_utc, recorded_utc, shifted

EXPOSURES = ("XPOSURE", "EXPTIME", "EXPOSURE")
AVERAGES, STARTS, ENDS = (
    ("DATE-AVG", "MJD-AVG"),
    ("DATE-BEG", "DATE-OBS", "MJD-BEG", "MJD-OBS"),
    ("DATE-END", "MJD-END"),
)
TIMES_OF_DAY = ("TIME-OBS", "UT")
"""Of a date without one."""
LONGEST_EXPOSURE_S = 3600.0
SAME_S = 1.0
"""Moments that are farther apart contradict each other."""
_UNITS_S = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "usec", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("min", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hour", "hours"), 3600.0),
    **dict.fromkeys(("d", "day", "days"), float(DAY_S)),
}
_LESS_TAI_S = {
    "TAI": 0.0,
    "IAT": 0.0,
    "TT": 32.184,
    "TDT": 32.184,
    "ET": 32.184,
    "TDB": 32.184,
    "GPS": -19.0,
}
"""TDB differs from TT by 2 ms at most."""
_UTC = ("UTC", "GMT", "UT")
_DATE = re.compile(r"(\d{4})-(\d\d)-(\d\d)(?:[T ](\S+))?")
_OLD_DATE = re.compile(r"(\d\d)/(\d\d)/(\d\d)")
_CLOCK = re.compile(r"(\d\d):(\d\d):(\d\d)(\.\d*)?\s*(Z|[+-]\d\d:?\d\d|[+-]\d\d)?")
_NUMBER = re.compile(r"\s*([+-]?[0-9.]+(?:[eEdD][+-]?\d+)?)\s*([A-Za-z]*)\s*")


@dataclass(frozen=True)
class HeaderTime:
    """UTC of mid exposure as text, exposure in seconds, and why there is no time."""

    time: str | None
    exposure_s: float | None
    reason: str = ""


def time_of_header(header: Header, primary: Header) -> HeaderTime:
    """The time and exposure of an image's header, else of the primary header of its file."""
    own = [header, primary]
    dates = next((each for each in own if _has(each, AVERAGES + STARTS)), header)
    exposed = next((each for each in own if _has(each, EXPOSURES)), header)
    told = _Told(dates, header.behind(primary))
    exposure_s, problem = exposure_of(exposed)
    if problem:
        return HeaderTime(None, None, problem)
    try:
        moment = told.middle(exposure_s)
    except _NoTime as error:
        return HeaderTime(None, exposure_s, str(error))
    return HeaderTime(moment.text, exposure_s)


def exposure_of(header: Header) -> tuple[float | None, str]:
    """The exposure in seconds, and what is contradictory in it."""
    told = {key: _seconds(header, key) for key in EXPOSURES if key in header.cards}
    known = {key: value for key, value in told.items() if value is not None}
    total, given = known.get("EXPTIME"), known.get("EXPOSURE")
    if total is not None and given is not None and abs(total - given) > 0.01 * max(total, given):
        return None, f"EXPTIME is {total:g} s and EXPOSURE {given:g} s, which contradict each other"
    value = next(iter(known.values()), None)
    return (value if value is not None and 0.0 < value <= LONGEST_EXPOSURE_S else None), ""


class _NoTime(Exception):
    """No time follows from a header; the message says why."""


@dataclass(frozen=True)
class _Told:
    """The header with the dates, and the one with what holds for all of them."""

    header: Header
    common: Header

    def middle(self, exposure_s: float | None) -> Utc:
        """The moment of mid exposure; raises `_NoTime` where none can be relied on."""
        role = self._role_of_date_obs()
        averages = self._moments((*AVERAGES, *(["DATE-OBS"] if role == "middle" else [])))
        starts = self._moments(key for key in STARTS if key != "DATE-OBS" or role == "start")
        ends = self._moments((*ENDS, *(["DATE-OBS"] if role == "end" else [])))
        middle, start, end = _agreed(averages), _agreed(starts), _agreed(ends)
        lasted_s = None if start is None or end is None else _seconds_between(start, end)
        if lasted_s is not None and not -0.001 <= lasted_s <= LONGEST_EXPOSURE_S:
            raise _NoTime(f"start and end of the exposure lie {lasted_s:.3f} s apart")
        if (
            lasted_s is not None
            and exposure_s is not None
            and abs(lasted_s - exposure_s) > 2 * SAME_S
        ):
            raise _NoTime(
                f"start and end lie {lasted_s:.3f} s apart, and the exposure is {exposure_s:g} s"
            )
        if middle is not None:
            late = start is not None and _seconds_between(start, middle) < -SAME_S
            if start is not None and end is None and exposure_s is not None:
                end = shifted(start, exposure_s)
            early = end is not None and _seconds_between(middle, end) < -SAME_S
            if late or early:
                raise _NoTime("the average time is not between start and end")
            return middle
        if start is not None and exposure_s is not None:
            return shifted(start, 0.5 * exposure_s)
        if start is not None and lasted_s is not None:
            return shifted(start, 0.5 * lasted_s)
        if end is not None and exposure_s is not None:
            return shifted(end, -0.5 * exposure_s)
        raise _NoTime(self._missing(start or end))

    def _missing(self, moment: Utc | None) -> str:
        if moment is not None:
            keys = ", ".join(EXPOSURES)
            return f"the header has a time, but no exposure ({keys}), end or average (DATE-AVG)"
        present = [key for key in AVERAGES + STARTS + ENDS if key in self.header.cards]
        if present:
            return f"{', '.join(present)} cannot be read as a date with a time of day"
        looked = ", ".join(AVERAGES + STARTS)
        return f"the header has none of {looked}"

    def _role_of_date_obs(self) -> str:
        """What DATE-OBS is: the start, unless its comment says otherwise (9.5)."""
        comment = self.header.comments.get("DATE-OBS", "").lower()
        if re.search(r"\b(start|begin|beginning)\b", comment):
            return "start"
        if re.search(r"\bmid|\bcent(er|re)\b|\baverage\b", comment):
            return "middle"
        return "end" if re.search(r"\bend\b", comment) else "start"

    def _moments(self, keys: Iterable[str]) -> dict[str, Utc]:
        found = {key: self._moment(key) for key in keys if key in self.header.cards}
        return {key: moment for key, moment in found.items() if moment is not None}

    def _moment(self, key: str) -> Utc | None:
        value = self.header.cards[key]
        scale = self._scale()
        if key.startswith("MJD"):
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not is_number or not 41317.0 <= float(value) <= 88069.0:  # type: ignore[arg-type]
                return None
            day = int(float(value))  # type: ignore[arg-type]
            return _converted(2400000.5 + day, float(value) - day, scale)  # type: ignore[arg-type]
        if not isinstance(value, str):
            return None
        clock = next((self.header.cards[k] for k in TIMES_OF_DAY if k in self.header.cards), None)
        return _read(value.strip(), clock if isinstance(clock, str) else None, scale)

    def _scale(self) -> str:
        """The time scale; raises `_NoTime` for one that is not converted."""
        scale = str(self.common.cards.get("TIMESYS") or "UTC").strip().upper()
        scale = scale.partition("(")[0].strip()
        if scale in _UTC:
            return "UTC"
        if scale not in _LESS_TAI_S:
            raise _NoTime(f"TIMESYS is {scale[:20]}, which is not converted to UTC")
        return scale


def _has(header: Header, keys: Iterable[str]) -> bool:
    return any(key in header.cards for key in keys)


def _seconds(header: Header, key: str) -> float | None:
    """An exposure in seconds, by the unit of its text or its comment; None for another unit."""
    value = header.cards[key]
    match = _NUMBER.fullmatch(value) if isinstance(value, str) else None
    if match is not None:
        number, unit = match[1].upper().replace("D", "E"), match[2]
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        number, unit = repr(value), ""
    else:
        return None
    stated = re.search(r"[\[(]\s*([A-Za-z]+)\.?\s*[\])]", header.comments.get(key, ""))
    common = header.cards.get("TIMEUNIT", "s") if key == "XPOSURE" else "s"
    unit = unit or (stated[1] if stated else str(common).strip())
    scale = _UNITS_S.get(unit if unit in _UNITS_S else unit.lower())
    try:
        return None if scale is None else float(number) * scale
    except ValueError:
        return None


def _agreed(moments: dict[str, Utc]) -> Utc | None:
    """The first of some moments; raises `_NoTime` if another one contradicts it."""
    for key, moment in moments.items():
        first = next(iter(moments))
        apart_s = _seconds_between(moments[first], moment)
        if abs(apart_s) > SAME_S:
            raise _NoTime(f"{first} and {key} lie {abs(apart_s):.3f} s apart")
    return next(iter(moments.values()), None)


def _seconds_between(one: Utc, other: Utc) -> float:
    return (other.tai_ns - one.tai_ns) * 1e-9


def _read(text: str, clock: str | None, scale: str) -> Utc | None:
    """The moment of a date with its time of day, which may be another card's."""
    old, date = _OLD_DATE.fullmatch(text), _DATE.fullmatch(text)
    if old is not None:
        year, month, day = 1900 + int(old[3]), int(old[2]), int(old[1])
        of_day = clock
    elif date is not None:
        year, month, day = int(date[1]), int(date[2]), int(date[3])
        of_day = date[4] or clock
    else:
        return None
    match = _CLOCK.fullmatch((of_day or "").strip())
    if match is None:
        return None
    hour, minute, second = (int(match[k]) for k in (1, 2, 3))
    fraction, zone = (match[4] or "").rstrip(".")[:10], match[5]
    try:
        if scale != "UTC":
            if zone is not None:
                return None
            moment = datetime(year, month, day, hour, minute, second)
            days = moment.toordinal() - datetime(1858, 11, 17).toordinal()
            share = (3600 * hour + 60 * minute + second + float(fraction or 0.0)) / DAY_S
            return _converted(2400000.5 + days, share, scale)
        moment_utc = parse_utc(
            f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}:{second:02d}{fraction}Z"
        )
        if zone in (None, "Z"):
            return moment_utc
        digits = zone[1:].replace(":", "").ljust(4, "0")
        offset = timedelta(hours=int(digits[:2]), minutes=int(digits[2:]))
        local = datetime(year, month, day, hour, minute, second)
        there = local - offset if zone[0] == "+" else local + offset
        return parse_utc(f"{there.isoformat()}{fraction}Z")
    except (BadInput, ValueError, OverflowError):
        return None


def _converted(jd1: float, jd2: float, scale: str) -> Utc:
    """UTC of a two-part Julian date in a scale."""
    if scale != "UTC":
        jd1, jd2, _ = map(float, ufunc.taiutc(jd1, jd2 - _LESS_TAI_S[scale] / DAY_S))
    return recorded_utc(Utc(jd1, jd2).text)
