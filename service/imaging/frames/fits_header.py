"""Headers of FITS files (FITS Standard 4.0): cards, images, and the time and exposure they tell."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import IO

from erfa import ufunc

from service.errors import BadInput
from service.imaging.frames.bounded_file import BoundedFile
from service.imaging.frames.frame import bad_frame
from service.times import DAY_S, Utc, parse_utc, recorded_utc, shifted

BLOCK, CARD = 2880, 80
MAX_HEADER_BLOCKS = 128
MAX_UNITS = 256

TYPES = {8: ">u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}

Value = bool | int | float | str | None


@dataclass(frozen=True)
class Header:
    """The cards of one header, by keyword: values, and comments that are not empty."""

    cards: dict[str, Value]
    comments: dict[str, str] = field(default_factory=dict)

    def whole(self, key: str, default: int | None = None, least: int = 0) -> int:
        """A whole number of the header; raises `BadFile` for anything else."""
        value = self._value(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value < 1 << 40:
            raise bad_frame(f"has a FITS header with an impossible {key}", str(value)[:40])
        return value

    def number(self, key: str, default: float) -> float:
        """A finite number of the header."""
        value = self._value(key, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise bad_frame(f"has a FITS header with an impossible {key}", str(value)[:40])
        if not abs(value) < 1e30:
            raise bad_frame(f"has a FITS header with an impossible {key}", str(value)[:40])
        return float(value)

    def _value(self, key: str, default: Value) -> Value:
        # A card without a value says nothing (FITS 4.0, 4.1.2.3).
        value = self.cards.get(key)
        return default if value is None else value

    def behind(self, primary: "Header") -> "Header":
        """The header with what it does not say itself from the primary one."""
        return Header(primary.cards | self.cards, primary.comments | self.comments)

    @property
    def is_compressed(self) -> bool:
        """True for a table that holds an image in compressed tiles."""
        return self.cards.get("ZIMAGE") is True

    @property
    def axes(self) -> list[int]:
        """The lengths of its axes, the fastest first."""
        return self._axes("NAXIS")

    @property
    def image_axes(self) -> list[int]:
        """The lengths of the axes of its image, without those of length one at the end."""
        axes = self._axes("ZNAXIS" if self.is_compressed else "NAXIS")
        while len(axes) > 2 and axes[-1] == 1:
            axes.pop()
        return axes

    def _axes(self, key: str) -> list[int]:
        count = self.whole(key)
        if count > 999:
            raise bad_frame(f"has a FITS header with an impossible {key}", str(count))
        return [self.whole(f"{key}{k + 1}") for k in range(count)]

    @property
    def bitpix(self) -> int:
        """Bits of a number of the image, negative for floating ones."""
        value = self.whole("ZBITPIX" if self.is_compressed else "BITPIX", least=-64)
        if value not in TYPES:
            known = ", ".join(str(each) for each in TYPES)
            raise bad_frame(f"has a FITS header whose BITPIX is none of {known}", str(value))
        return value

    @property
    def is_image(self) -> bool:
        """True for an image of two dimensions or more, compressed or not."""
        kind = self.cards.get("XTENSION", "IMAGE")
        if not self.is_compressed and (kind != "IMAGE" or self.cards.get("GROUPS") is True):
            return False
        return len(self.image_axes) >= 2 and 0 not in self.image_axes

    @property
    def name(self) -> str:
        """The name of the unit, in capitals; empty without one."""
        return str(self.cards.get("EXTNAME") or "").strip().upper()

    @property
    def data_bytes(self) -> int:
        """The length of its data (4.4.1.1)."""
        axes = self.axes
        if not axes:
            return 0
        numbers = 1
        for length in axes:
            # A product of absurd lengths need not be exact to be beyond the file.
            numbers = min(numbers * length, 1 << 60)
        numbers = self.whole("GCOUNT", 1) * (self.whole("PCOUNT", 0) + numbers)
        bits = self.whole("BITPIX", least=-64)
        return min(abs(bits) // 8 * numbers, 1 << 62)


@dataclass(frozen=True)
class Unit:
    """One header and data unit of a file: its number from 0, its header, where its data begin."""

    number: int
    header: Header
    start: int


def units_of(file: BoundedFile) -> Iterator[Unit]:
    """The units of a file one after another; raises `BadFile` for a broken header."""
    at = 0
    for number in range(MAX_UNITS):
        file.seek(at)
        # What follows the last unit is none (3.5).
        if not file.left or (number and file.read(8) != b"XTENSION"):
            return
        file.seek(at)
        header = read_header(file)
        unit = Unit(number, header, file.tell())
        yield unit
        at = unit.start + -(-header.data_bytes // BLOCK) * BLOCK


def read_header(file: BoundedFile) -> Header:
    """The header that begins here; the first of equal keywords counts."""
    header = Header({})
    for _ in range(MAX_HEADER_BLOCKS):
        block = file.read(BLOCK)
        if len(block) < BLOCK:
            raise bad_frame("is cut off in its FITS header")
        for at in range(0, BLOCK, CARD):
            card = block[at : at + CARD].decode("latin-1")
            key = card[:8].rstrip()
            if key == "END":
                return header
            if card[8:10] == "= " and key not in header.cards:
                header.cards[key], comment = _value(card[10:])
                if comment:
                    header.comments[key] = comment
    raise bad_frame(f"has a FITS header without END in its first {MAX_HEADER_BLOCKS} blocks")


def _value(text: str) -> tuple[Value, str]:
    """The value of a card, None for what is no value, and its comment."""
    text = text.strip()
    if text.startswith("'"):
        inner, at = "", 1
        while at < len(text):
            if text[at] == "'":
                if text[at + 1 : at + 2] != "'":
                    break
                at += 1
            inner, at = inner + text[at], at + 1
        return inner.rstrip(), text[at + 1 :].partition("/")[2].strip()
    word, _, comment = (part.strip() for part in text.partition("/"))
    if word in ("T", "F"):
        return word == "T", comment
    try:
        return int(word), comment
    except ValueError:
        pass
    try:
        return float(word.upper().replace("D", "E")), comment
    except ValueError:
        return None, comment


def write_header(file: IO[bytes], cards: Mapping[str, bool | int | float | str]) -> None:
    """Write a header of these cards, in whole blocks."""
    text = "".join(_card(key, value) for key, value in cards.items()) + "END".ljust(CARD)
    file.write(text.encode("latin-1").ljust(-(-len(text) // BLOCK) * BLOCK))


def _card(key: str, value: bool | int | float | str) -> str:
    if isinstance(value, bool):
        shown = f"{'T' if value else 'F':>20}"
    elif isinstance(value, str):
        shown = "'" + value.replace("'", "''").ljust(8) + "'"
    else:
        shown = f"{value!r:>20}".upper()
    return f"{key:<8}= {shown}".ljust(CARD)[:CARD]


# The time and the exposure that a FITS header tells (FITS Standard 4.0, section 9).
#
# A time that may be wrong is none: keywords that contradict each other, dates without a time of
# day and time scales that are not converted lead to no time, with the reason in words.

EXPOSURES = ("XPOSURE", "EXPTIME", "EXPOSURE")
AVERAGES, STARTS, ENDS = (
    ("DATE-AVG", "MJD-AVG"),
    ("DATE-BEG", "DATE-OBS", "MJD-BEG", "MJD-OBS"),
    ("DATE-END", "MJD-END"),
)
TIMES_OF_DAY = ("TIME-OBS", "UT")
"""The keywords of the time of day of a date without one."""
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
    date_cards = _DateCards(dates, header.behind(primary))
    exposure_s, problem = exposure_of(exposed)
    if problem:
        return HeaderTime(None, None, problem)
    try:
        moment = date_cards.middle(exposure_s)
    except _NoTime as error:
        return HeaderTime(None, exposure_s, str(error))
    return HeaderTime(moment.text, exposure_s)


def exposure_of(header: Header) -> tuple[float | None, str]:
    """The exposure in seconds, and what is contradictory in it."""
    seconds = {key: _seconds(header, key) for key in EXPOSURES if key in header.cards}
    known = {key: value for key, value in seconds.items() if value is not None}
    total, exposure = known.get("EXPTIME"), known.get("EXPOSURE")
    if (
        total is not None
        and exposure is not None
        and abs(total - exposure) > 0.01 * max(total, exposure)
    ):
        return (
            None,
            f"EXPTIME is {total:g} s and EXPOSURE {exposure:g} s, which contradict each other",
        )
    value = next(iter(known.values()), None)
    return (value if value is not None and 0.0 < value <= LONGEST_EXPOSURE_S else None), ""


class _NoTime(Exception):
    """No time follows from a header; the message says why."""


@dataclass(frozen=True)
class _DateCards:
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
        """The role of DATE-OBS: the start, unless its comment says otherwise (9.5)."""
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
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                return None
            if not 41317.0 <= value <= 88069.0:
                return None
            day = int(value)
            return _converted(2400000.5 + day, float(value) - day, scale)
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
        utc = local - offset if zone[0] == "+" else local + offset
        return parse_utc(f"{utc.isoformat()}{fraction}Z")
    except (BadInput, ValueError, OverflowError):
        return None


def _converted(jd1: float, jd2: float, scale: str) -> Utc:
    """UTC of a two-part Julian date in a scale."""
    if scale != "UTC":
        jd1, jd2, _ = map(float, ufunc.taiutc(jd1, jd2 - _LESS_TAI_S[scale] / DAY_S))
    return recorded_utc(Utc(jd1, jd2).text)
