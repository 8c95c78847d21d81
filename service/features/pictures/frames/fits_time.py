"""The mid-exposure time and the exposure stated by a FITS header (FITS Standard 4.0, section 9).

A doubtful time is not used: keywords that contradict each other or their comments, dates without a
time of day, local times and unknown time scales give no time, with the reason in words. Clear
statements in comments are read: units, the moment of the exposure, and time zones.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime, timedelta

from erfa import ufunc

from service.errors import BadInput
from service.features.pictures.frames.fits_header import Header
from service.times import DAY_S, TT_LESS_TAI_S, Utc, parse_utc, recorded_utc, shifted

EXPOSURES = ("XPOSURE", "EXPTIME", "EXPOSURE")
EXPOSURE_UNITS = ("EXPUNIT", "EXPUNITS", "EXP_UNIT", "EXPTUNIT")
"""FITS keywords of the unit of exposures, outside the standard."""
OF_TIMEUNIT = ("XPOSURE", "TELAPSE")
"""FITS keywords of durations in the unit of TIMEUNIT (9.7)."""
AVERAGES, STARTS, ENDS = (
    ("DATE-AVG", "MJD-AVG"),
    ("DATE-BEG", "DATE-OBS", "MJD-BEG", "MJD-OBS"),
    ("DATE-END", "MJD-END"),
)
NOTHING_STATED = "the header has none of"
OBSERVED = ("DATE-OBS", "MJD-OBS")
"""FITS keywords of dates whose comments may name the moment: start, middle or end (9.5)."""
TIMES_OF_DAY = ("TIME-OBS", "UT")
"""FITS keywords of a time of day that completes a date without one."""
START_CLOCKS = (*TIMES_OF_DAY, "UTSTART", "UTC-OBS", "UT-OBS", "UTSHUT", "UTOPEN")
"""FITS keywords of a time of day that must agree with a whole date."""
UTC_OFFSETS = ("UTCOFFS", "UTC-OFFS", "UTCOFF", "UTC-OFF", "UTCOFFSE", "UTC_OFFS")
"""FITS keywords of the hours by which a header's local time is ahead of UTC."""
ZONES = (*UTC_OFFSETS, "TIMEZONE", "TZ")
LOCAL_CLOCKS = ("LT", "LT-OBS", "LOCTIME", "LOCALTIM", "LTIME", "DATE-LOC")
"""FITS keywords of the local time at the start of an exposure."""
JULIAN_DATES = ("JD", "JD-OBS", "JD_UTC", "MJD")
"""FITS keywords of a Julian date outside the standard, compared with the date alone."""
JULIAN_SAME_S = 2.0
"""Error in seconds of a Julian date with five decimals."""
STACKED = ("STACKCNT", "NCOMBINE", "SNAPSHOT", "COADDS", "NCOADDS", "NCOADD", "NDIT")
"""FITS keywords of the number of exposures that were combined to a picture."""
LONGEST_EXPOSURE_S = 3600.0
SAME_S = 1.0
"""Largest difference, in seconds, between two times for the same moment of an exposure."""
MOST_RATIO = 100.0
"""Least ratio of two stated exposures from which one must be in another unit."""
MOST_OFFSET_H = 14.0
_UNITS_S = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "msecs", "millisec", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(
        ("us", "µs", "μs", "usec", "usecs", "microsec", "microsecond", "microseconds"), 1e-6
    ),
    **dict.fromkeys(("min", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hour", "hours"), 3600.0),
    **dict.fromkeys(("d", "day", "days"), float(DAY_S)),
}
_LESS_TAI_S = {
    "TAI": 0.0,
    "IAT": 0.0,
    "TT": TT_LESS_TAI_S,
    "TDT": TT_LESS_TAI_S,
    "ET": TT_LESS_TAI_S,
    "TDB": TT_LESS_TAI_S,
    "GPS": -19.0,
}
"""Seconds by which each time scale is ahead of TAI; TDB is taken for TT, at most 2 ms away."""
_UTC = ("UTC", "GMT", "UT")
_DATE = re.compile(r"(\d{4})-(\d\d)-(\d\d)(?:[T ](\S+))?")
_OLD_DATE = re.compile(r"(\d\d)/(\d\d)/(\d\d)")
_CLOCK = re.compile(r"(\d\d):(\d\d):(\d\d)(\.\d*)?\s*(Z|[+-]\d\d:?\d\d|[+-]\d\d)?")
_NUMBER = re.compile(r"\s*([+-]?[0-9.]+(?:[eEdD][+-]?\d+)?)\s*([A-Za-z\u00b5\u03bc]*)\s*")
_BRACKETS = re.compile(r"\[\s*([A-Za-z\u00b5\u03bc]+)\.?\s*\]")
_PARENTHESES = re.compile(r"\(\s*([A-Za-z\u00b5\u03bc]+)\.?\s*\)")
_UNIT_WORDS = re.compile(
    r"(?<!per )\b(milliseconds?|millisec|msecs?|ms|microseconds?|microsec|usecs?|us|"
    r"\u00b5s|\u03bcs|seconds?|secs?|minutes?|hours?)\b|\bin (s|min|h)\b"
)
_ROLES = {
    "start": re.compile(r"\b(start|beg[iau]n|open|commenc)"),
    "middle": re.compile(r"\bmid|\bcent(er|re)\b|\baverage\b|\bmean\b"),
    "end": re.compile(r"\b(end(ed|s|ing)?\b|stop|finish|clos(e|ed|ing)\b|complet(ed|ion)\b)"),
}
_OTHER_MOMENTS = re.compile(r"\b(written|saved|creat\w+|download\w*|readout|read out)\b")
_LOCAL = re.compile(
    r"(?i:\b(locale?|civil|wall.?clock|ortszeit)\b)|"
    r"\b(LT|LST|JST|IST|KST|CET|CEST|MEZ|MESZ|EET|EEST|BST|MSK|AEST|AEDT|"
    r"[ECMP][SD]T|HST|AKST|NZST)\b|\b(Beijing|Moscow|Tokyo) time\b"
)
_NOTED_LOCAL = re.compile(
    r"(?i)\b(times|dates?|clock|timestamps?|date-\w+|time-obs)\b.*\b(is|are|in)\b.*"
    r"(?<!not )\blocal\b(?! (mean |apparent )?(sidereal|oscillator))"
)
_NOTED_UNIT = re.compile(
    r"(?i)\b(exptime|exposure|xposure|exposure times?)\b"
    r"(?: |is|are|given|stated|values?|units?|in|of|[:=(\[])*"
    r"\b(milliseconds?|msec|ms|microseconds?|usec|us|minutes?|hours?)\b"
)
"""Texts of COMMENT and HISTORY cards about the dates and the exposures of a FITS header."""
_IS_UTC = re.compile(r"\b(UTC|UT|GMT|universal)\b", re.IGNORECASE)
_ZONE = re.compile(r"\b(?:UTC|UT|GMT)\s*([+-])\s*(\d{1,2})(?::?([0-5]\d))?(?![\d-])")
_SCALE_WORDS = re.compile(r"\b(TAI|TT|TDT|TDB|GPS)\b")
_OTHER_CENTRE = re.compile(r"(?i)helio|bary|\bend\b|written|saved")
_OTHER_SIGN = re.compile(r"\b(add|added|minus|subtract|to utc|to ut)\b")


@dataclass(frozen=True)
class HeaderTime:
    """The UTC of mid exposure and the exposure by a FITS header, or the reason for no time.

    The sources name the keywords from which time and exposure were taken.
    """

    time: str | None
    exposure_s: float | None
    reason: str = ""
    time_source: str = ""
    exposure_source: str = ""


@dataclass(frozen=True)
class HeaderExposure:
    """The exposure in seconds stated by a FITS header, its keyword, and any problem with it."""

    seconds: float | None
    source: str = ""
    problem: str = ""
    is_contradictory: bool = False


def timing_remarks(timing: HeaderTime) -> list[str]:
    """Remarks that name the FITS keywords from which the time and the exposure of a frame come."""
    remarks = []
    if timing.time is not None:
        remarks.append(f"time_of_file: {timing.time}, mid exposure, from {timing.time_source}")
    if timing.exposure_s is not None:
        remarks.append(
            f"exposure_of_file: {timing.exposure_s:.6g} s, from {timing.exposure_source}"
        )
    return remarks


def time_of_header(header: Header, primary: Header) -> HeaderTime:
    """Time and exposure from an image's FITS header, else from the primary header of the file."""
    own = [header, primary]
    dates = next((each for each in own if _has(each, AVERAGES + STARTS)), header)
    exposed = next((each for each in own if _has(each, EXPOSURES)), header)
    exposure = exposure_of(exposed)
    if exposure.is_contradictory:
        return HeaderTime(None, None, exposure.problem)
    cards = _DateCards(dates, header.behind(primary), exposure)
    try:
        moment, source = cards.middle()
    except _NoTime as error:
        reason, source = str(error), ""
        return HeaderTime(None, exposure.seconds, reason, source, exposure.source)
    return HeaderTime(moment.text, exposure.seconds, "", source, exposure.source)


def exposure_of(header: Header) -> HeaderExposure:
    """The exposure of a FITS header, from the first keyword, unless another contradicts it."""
    found: dict[str, tuple[float, str]] = {}
    problem = ""
    for key in EXPOSURES:
        if header.cards.get(key) is None:
            continue
        try:
            found[key] = _seconds(header, key)
        except _Contradictory as error:
            return HeaderExposure(None, "", str(error), is_contradictory=True)
        except ValueError as error:
            problem = str(error)
    for one, (seconds, _) in found.items():
        for other, (others, _) in found.items():
            least, most = sorted((seconds, others))
            total = {one, other} == {"EXPTIME", "EXPOSURE"} and most - least > 0.01 * most
            if total or most > MOST_RATIO * max(least, 0.0) > 0.0:
                told = f"{one} is {seconds:g} s and {other} {others:g} s"
                message = f"{told}, which contradict each other"
                return HeaderExposure(None, "", message, is_contradictory=True)
    for key, (seconds, source) in found.items():
        if 0.0 < seconds <= LONGEST_EXPOSURE_S:
            return HeaderExposure(seconds, source)
        problem = (
            f"{key} is {seconds:g} s, which must be above 0 and at most {LONGEST_EXPOSURE_S:g} s"
        )
        break
    return HeaderExposure(None, "", problem)


class _Contradictory(Exception):
    """An error: a header's value and its comment contradict each other. The message holds both."""


def _seconds(header: Header, key: str) -> tuple[float, str]:
    """An exposure in seconds, with the unit of its text or its comment, and its source in words.

    Raises `ValueError` for a value or unit that cannot be read.
    """
    value, comment = header.cards[key], header.comments.get(key, "")
    if not _stated_scales(comment, key):
        comment = _noted(header, _NOTED_UNIT) or comment
    match = _NUMBER.fullmatch(value) if isinstance(value, str) else None
    if match is not None:
        number, unit = match[1].upper().replace("D", "E"), match[2]
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        number, unit = repr(value), ""
    else:
        raise ValueError(f"{key} is no number")
    if key in OF_TIMEUNIT:
        common = [str(header.cards.get("TIMEUNIT") or "").strip()]
    else:
        stated_units = (str(header.cards.get(each) or "") for each in EXPOSURE_UNITS)
        common = [each.strip(" [].") for each in stated_units]
        # Cards outside the standard may hold any word.
        common = [each for each in common if each.lower() in _UNITS_S]
    common = [each for each in common if each]
    own = [_scale_of_unit(each, key) for each in (unit, *common) if each]
    stated = _stated_scales(comment, key)
    shown = " ".join([str(value), *common])
    if len(set(own)) > 1:
        raise _Contradictory(f"{key} is {shown}: units that contradict each other")
    if len(stated) > 1 or (own and stated and own[0] not in stated):
        raise _Contradictory(f"{key} is {shown}, and its comment says otherwise: {comment[:60]}")
    time_unit = str(header.cards.get("TIMEUNIT") or "s").strip()
    if not own and not stated and _UNITS_S.get(time_unit.lower(), 1.0) != 1.0:
        raise _Contradictory(f"{key} is {shown} without a unit, and TIMEUNIT is {time_unit[:20]}")
    scale = own[0] if own else next(iter(stated), 1.0)
    seconds = float(number) * scale
    if not own and stated and scale != 1.0:
        return seconds, f"{key} = {value} in the unit of its comment ({comment[:60]})"
    return seconds, key


def _scale_of_unit(unit: str, key: str) -> float:
    scale = _UNITS_S.get(unit if unit in _UNITS_S else unit.lower())
    if scale is None:
        raise ValueError(f"{key} is in {unit[:20]}, which is no known unit of time")
    return scale


def _stated_scales(comment: str, key: str) -> set[float]:
    """The units of time that a comment states, in seconds; a unit in brackets takes precedence."""
    brackets = _BRACKETS.search(comment)
    if brackets is not None:
        return {_scale_of_unit(brackets[1], key)}
    text = comment.lower()
    words = [found[1] or found[2] for found in _UNIT_WORDS.finditer(text)]
    words += [found[1] for found in _PARENTHESES.finditer(text)]
    return {_UNITS_S[word] for word in words if word in _UNITS_S}


def _noted(header: Header, words: re.Pattern[str]) -> str:
    """The first COMMENT or HISTORY of a FITS header that matches, empty if none does."""
    return next((note for note in header.notes if words.search(note)), "")


class _NoTime(Exception):
    """An error: no time follows from a FITS header; the message states the reason."""


@dataclass(frozen=True)
class _DateCards:
    """Date cards of a FITS header, the header with its time scale and zone, and the exposure."""

    header: Header
    common: Header
    exposure: HeaderExposure
    problems: list[str] = field(default_factory=list)

    def middle(self) -> tuple[Utc, str]:
        """UTC of mid exposure from a FITS header and its source; raises `_NoTime` if uncertain."""
        exposure_s = self.exposure.seconds
        roles = {key: self._role(key) for key in OBSERVED if key in self.header.cards}
        meant = {role: [key for key in roles if roles[key] == role] for role in _ROLES}
        averages = self._moments((*AVERAGES, *meant["middle"]))
        starts = self._moments(key for key in STARTS if roles.get(key, "start") == "start")
        ends = self._moments((*ENDS, *meant["end"]))
        middle, start, end = _agreed(averages), _agreed(starts), _agreed(ends)
        if "DATE-OBS" in starts:
            self._require_same_clock()
            self._require_same_dates(starts["DATE-OBS"])
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
            return middle, f"{next(iter(averages))} (middle of the exposure)"
        elapsed_s = self._elapsed_s(lasted_s)
        begun = f"{next(iter(starts), '')} (start of the exposure)"
        ended, lasted = f"{next(iter(ends), '')} (end of the exposure)", self.exposure.source
        if elapsed_s is not None:
            exposure_s, lasted = elapsed_s, "TELAPSE"
        if start is not None and exposure_s is not None:
            return shifted(start, 0.5 * exposure_s), f"{begun} and {lasted}"
        if start is not None and lasted_s is not None:
            return shifted(start, 0.5 * lasted_s), f"{begun} and {ended}"
        if end is not None and exposure_s is not None:
            return shifted(end, -0.5 * exposure_s), f"{ended} and {lasted}"
        raise _NoTime(self._missing(start or end))

    def _require_same_clock(self) -> None:
        """Raise `_NoTime` if a time of day beside a whole date lies outside the exposure.

        Some writers give the day, or midnight, in the date and the time of day in its own card.
        """
        date, cards = self.header.cards.get("DATE-OBS"), self.header.cards
        zone = _CLOCK.search(date) if isinstance(date, str) else None
        if not isinstance(date, str) or zone is None or zone[5] not in (None, "Z"):
            return
        scale = self._scale("DATE-OBS")
        start = _read(date.strip(), None, scale)
        for key in START_CLOCKS:
            clock, comment = cards.get(key), self.header.comments.get(key, "")
            said_otherwise = _LOCAL.search(comment) or _OTHER_MOMENTS.search(comment.lower())
            if not isinstance(clock, str) or said_otherwise:
                continue
            clock = clock.strip()
            other = _read(clock, None, scale) or _read(date.strip()[:10], clock, scale)
            if start is None or other is None:
                continue
            late_s = _seconds_between(start, other)
            if not -SAME_S <= late_s <= (self.exposure.seconds or 0.0) + SAME_S:
                raise _NoTime(f"DATE-OBS is {date.strip()[:30]}, and {key} {clock[:30]}")

    def _require_same_dates(self, start: Utc) -> None:
        """Raise `_NoTime` if a Julian date or the local time contradicts the start of exposure."""
        header, shown = self.header, str(self.header.cards["DATE-OBS"]).strip()[:30]
        for key in JULIAN_DATES:
            value = header.cards.get(key)
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                continue
            days = float(value) - (2_400_000.5 if value > 1e6 else 0.0)
            if not 41317.0 <= days <= 88069.0 or _OTHER_CENTRE.search(header.comments.get(key, "")):
                continue
            other = _converted(2400000.5 + int(days), days - int(days), self._scale("DATE-OBS"))
            late_s = _seconds_between(start, other)
            if not -JULIAN_SAME_S <= late_s <= (self.exposure.seconds or 0.0) + JULIAN_SAME_S:
                raise _NoTime(f"DATE-OBS is {shown}, and {key} {value} is {late_s:.0f} s later")
        zones = [self.common.cards.get(key) for key in ZONES]
        is_apart = any(isinstance(each, (int, float)) and each for each in zones)
        for key in LOCAL_CLOCKS if is_apart else ():
            clock = header.cards.get(key)
            if isinstance(clock, str) and clock.strip()[-8:] == shown[11:19]:
                raise _NoTime(f"DATE-OBS is {shown}, the local time of {key}")

    def _elapsed_s(self, lasted_s: float | None) -> float | None:
        """Seconds from start to end by TELAPSE, where no end is stated and it is the longer one.

        Raises `_NoTime` for a stack of exposures whose end is not stated.
        """
        for key in STACKED if lasted_s is None else ():
            count = self.header.cards.get(key)
            if isinstance(count, (int, float)) and count > 1:
                raise _NoTime(f"it is a stack of {count:g} exposures ({key}) without DATE-END")
        exposure_s = self.exposure.seconds
        if lasted_s is not None or exposure_s is None or self.header.cards.get("TELAPSE") is None:
            return None
        try:
            elapsed_s, _ = _seconds(self.header, "TELAPSE")
        except (ValueError, _Contradictory):
            return None
        # A value of zero is none; pauses of the exposure make it longer.
        if 0.0 < elapsed_s < exposure_s - 2 * SAME_S:
            raise _NoTime(f"TELAPSE is {elapsed_s:g} s, and the exposure is {exposure_s:g} s")
        return elapsed_s if elapsed_s > exposure_s else None

    def _missing(self, moment: Utc | None) -> str:
        problems = "".join(f"; {each}" for each in (*self.problems, self.exposure.problem) if each)
        if moment is not None:
            keys = ", ".join(EXPOSURES)
            return (
                f"the header has a time, but no exposure ({keys}), end or average (DATE-AVG)"
                + problems
            )
        if self.problems:
            return "; ".join(self.problems)
        present = [key for key in AVERAGES + STARTS + ENDS if key in self.header.cards]
        if present:
            return f"{', '.join(present)} cannot be read as a date with a time of day"
        looked = ", ".join(AVERAGES + STARTS)
        return f"{NOTHING_STATED} {looked}"

    def _role(self, key: str) -> str:
        """The moment that a date keyword means: the exposure's start, unless its comment differs.

        Raises `_NoTime` for a comment that names several moments, or one that is none of them.
        """
        comment = self._comment(key)
        named = [role for role, words in _ROLES.items() if words.search(comment.lower())]
        if len(named) > 1 or (not named and _OTHER_MOMENTS.search(comment.lower())):
            raise _NoTime(f"{key} is not clearly start, middle or end: {comment[:60]}")
        return named[0] if named else "start"

    def _comment(self, key: str) -> str:
        """The comment of a date, joined with that of the separate card of its time of day."""
        value, clock = self.header.cards[key], self._clock_key()
        is_whole = not isinstance(value, str) or ":" in value or clock is None
        keys = [key] if is_whole or clock is None else [key, clock]
        return " ".join(self.header.comments.get(each, "") for each in keys).strip()

    def _clock_key(self) -> str | None:
        return next((key for key in TIMES_OF_DAY if key in self.header.cards), None)

    def _moments(self, keys: Iterable[str]) -> dict[str, Utc]:
        found: dict[str, Utc] = {}
        for key in keys:
            if key not in self.header.cards:
                continue
            try:
                moment = self._moment(key)
            except _LocalTime as error:
                self.problems.append(str(error))
                continue
            if moment is not None:
                found[key] = moment
        return found

    def _moment(self, key: str) -> Utc | None:
        """The UTC of a date keyword, None if its value is no date; raises `_LocalTime`."""
        value = self.header.cards[key]
        ahead_h, scale = self._ahead_h(key), self._scale(key)
        if ahead_h is not None and scale != "UTC":
            raise _LocalTime(f"{key} is local time by its comment, and in {scale}")
        moment: Utc | None = None
        if key.startswith("MJD"):
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                return None
            if 41317.0 <= value <= 88069.0:
                day = int(value)
                moment = _converted(2400000.5 + day, float(value) - day, scale)
        elif isinstance(value, str):
            clock = self.header.cards.get(self._clock_key() or "")
            moment = _read(value.strip(), clock if isinstance(clock, str) else None, scale)
        if moment is None or ahead_h is None:
            return moment
        return shifted(moment, -3600.0 * ahead_h)

    def _ahead_h(self, key: str) -> float | None:
        """The hours by which a local time is ahead of UTC; None for a time that is not local.

        Raises `_LocalTime` for a local time with an unknown offset.
        """
        value, comment = self.header.cards[key], self._comment(key)
        comment = f"{comment} {_noted(self.common, _NOTED_LOCAL)}".strip()
        zone = _ZONE.search(comment)
        own = _CLOCK.search(value) if isinstance(value, str) else None
        if zone is None and not _LOCAL.search(comment):
            return None
        if own is not None and own[5] not in (None, "Z"):
            # A zone in the value itself is converted with the value.
            return None
        message = f"{key} is local time by its comment ({comment[:60]})"
        if own is not None and own[5] == "Z":
            raise _LocalTime(f"{message}, and UTC by its Z")
        if zone is not None:
            hours = int(zone[2]) + int(zone[3] or 0) / 60.0
            return -hours if zone[1] == "-" else hours
        if _IS_UTC.search(comment):
            raise _LocalTime(f"{key} is not clearly UTC or local time ({comment[:60]})")
        for offset in UTC_OFFSETS:
            ahead_h = self._offset_h(offset)
            if ahead_h is not None:
                return ahead_h
        raise _LocalTime(f"{message}, and no offset from UTC is known")

    def _offset_h(self, key: str) -> float | None:
        """Hours of local time ahead of UTC in a header keyword; None if it is no such number."""
        value, comment = self.common.cards.get(key), self.common.comments.get(key, "").lower()
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return None
        if abs(value) > MOST_OFFSET_H or _OTHER_SIGN.search(comment):
            return None
        return None if _stated_scales(comment, "EXPTIME") - {3600.0} else float(value)

    def _scale(self, key: str) -> str:
        """The time scale of a date keyword; raises `_NoTime` for an unsupported one."""
        stated = self.common.cards.get("TIMESYS")
        scale = str(stated or "UTC").strip().upper().partition("(")[0].strip()
        comment = self._comment(key)
        word = _SCALE_WORDS.search(comment)
        if word is not None and not _IS_UTC.search(comment) and word[1] != scale:
            if stated is not None or word[1] == "GPS":
                # GPS receivers output UTC too.
                told = "is not given" if stated is None else f"is {scale[:20]}"
                raise _NoTime(f"TIMESYS {told}, and the comment of {key} says {comment[:60]}")
            scale = word[1]
        if scale in _UTC:
            return "UTC"
        if scale not in _LESS_TAI_S:
            raise _NoTime(f"TIMESYS is {scale[:20]}, which is not converted to UTC")
        return scale


class _LocalTime(Exception):
    """An error: a keyword holds a local time with an unknown offset from UTC; see the message."""


def _has(header: Header, keys: Iterable[str]) -> bool:
    return any(key in header.cards for key in keys)


def _agreed(moments: dict[str, Utc]) -> Utc | None:
    """First of several moments that must agree, or None; raises `_NoTime` if another differs."""
    for key, moment in moments.items():
        first = next(iter(moments))
        apart_s = _seconds_between(moments[first], moment)
        if abs(apart_s) > SAME_S:
            raise _NoTime(f"{first} and {key} lie {abs(apart_s):.3f} s apart")
    return next(iter(moments.values()), None)


def _seconds_between(one: Utc, other: Utc) -> float:
    return (other.tai_ns - one.tai_ns) * 1e-9


def _read(text: str, clock: str | None, scale: str) -> Utc | None:
    """The UTC of a date and time of day, from one FITS card or two; None if it cannot be read."""
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
        utc = local - offset if zone[0] == "+" else local + offset
        return parse_utc(f"{utc.isoformat()}{fraction}Z")
    except (BadInput, ValueError, OverflowError):
        return None


def _converted(jd1: float, jd2: float, scale: str) -> Utc:
    """The UTC of a two-part Julian date in a given time scale."""
    if scale != "UTC":
        jd1, jd2, _ = map(float, ufunc.taiutc(jd1, jd2 - _LESS_TAI_S[scale] / DAY_S))
    return recorded_utc(Utc(jd1, jd2).text)
