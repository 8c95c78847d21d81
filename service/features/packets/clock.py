"""Conversion of packet values to numbers, and of CCSDS times (CDS and CUC, 301.0-B-4) to UTC."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from functools import lru_cache
from typing import Any

from service.errors import BadInput
from service.features.packets.definition import PacketFault, ParameterKind
from service.missions.packets import CdsTime, CucTime, PacketTime
from service.times import DAY_S, FIRST_YEAR, LAST_YEAR, parse_utc, recorded_utc

NS = 1_000_000_000
MS_NS, US_NS = 1_000_000, 1_000
DAY_NS = DAY_S * NS
GPS_LESS_TAI_S = -19
_TAI_ZERO = datetime(2000, 1, 1, 12)
"""Date and time of TAI at which `Utc.tai_ns` is zero."""


@dataclass(frozen=True, slots=True)
class Moment:
    """A time as UTC text, and in nanoseconds as `Utc.tai_ns`."""

    text: str
    tai_ns: int


def moment_of(time: PacketTime, values: Mapping[str, Any]) -> Moment:
    """Read the time of a packet from its values; raises `PacketFault` naming the parameter."""
    return _of_days(time, values) if isinstance(time, CdsTime) else _of_seconds(time, values)


def names_of(time: PacketTime) -> tuple[str, ...]:
    """Names of the packet parameters that a time is read from."""
    if isinstance(time, CdsTime):
        return tuple(filter(None, (time.day, time.millisecond, time.microsecond)))
    return tuple(filter(None, (time.coarse, time.fine)))


_EPOCHS = {
    "TAI": (datetime(1958, 1, 1), "tai"),
    "GPS": (datetime(1980, 1, 6), "gps"),
    "UNIX": (datetime(1970, 1, 1), "utc"),
    "POSIX": (datetime(1970, 1, 1), "utc"),
    "J2000": (datetime(2000, 1, 1, 12), ""),
}
"""Named epochs of XTCE, with the clock that counts from there; J2000 names no clock."""
_EPOCH_S = 70.0
"""Largest difference in seconds between the clocks of one epoch (UTC and TT at J2000: 64.2 s)."""
_UNITS = {"s": 1.0, "sec": 1.0, "second": 1.0, "d": 86400.0, "day": 86400.0, "min": 60.0}
_UNITS |= {"ms": 1e-3, "msec": 1e-3, "millisecond": 1e-3, "ns": 1e-9, "nanosecond": 1e-9}
_UNITS |= {"us": 1e-6, "usec": 1e-6, "microsecond": 1e-6, "minute": 60.0, "hour": 3600.0}
_UNITS |= {"h": 3600.0, "hr": 3600.0, "millisec": 1e-3, "microsec": 1e-6}
_UNITS |= {"µs": 1e-6, "μs": 1e-6}
"""Seconds of a unit of time; units in the plural have an s after it."""


def misfits(time: PacketTime, kinds: Mapping[str, ParameterKind]) -> Iterator[tuple[str, str]]:
    """Parameters whose XTCE type contradicts a time of the mission file, each with the reason."""
    if isinstance(time, CdsTime):
        units = {time.day: 86400.0, time.millisecond: 1e-3, time.microsecond or "": 1e-6}
    else:
        units = {time.coarse: 1.0, time.fine or "": 0.0}
    for name, needed_s in units.items():
        if (kind := kinds.get(name)) is None:
            continue
        word = kind.unit.lower()
        unit_s = _UNITS.get(word) or _UNITS.get(word.removesuffix("s"))
        if kind.time_scale != 1.0:
            yield name, f"has the scale {kind.time_scale:g} in the XTCE file; a count is needed"
        elif unit_s is not None and unit_s != (needed_s or 1.0):
            needed = f"{needed_s:g} s" if needed_s else "2^-fine_bits s"
            yield name, f"is in {kind.unit} by the XTCE file; units of {needed} are needed"
    first = names_of(time)[0]
    if first in kinds and (counted := kinds[first].time_epoch) and _is_other_epoch(time, counted):
        clock = "" if isinstance(time, CdsTime) else f" on the clock {time.scale}"
        message = f"counts from {counted} by the XTCE file, from {time.epoch.isoformat()}{clock}"
        yield first, f"{message} by the mission file: make them agree"


def _is_other_epoch(time: PacketTime, counted: str) -> bool:
    """True if an epoch of XTCE is not that of a time; False for one that cannot be read."""
    try:
        epoch, scale = _EPOCHS.get(counted.upper()) or (datetime.fromisoformat(counted), "")
    except ValueError:
        return False
    if epoch.tzinfo is not None:
        epoch = epoch.astimezone(UTC).replace(tzinfo=None)
    if isinstance(time, CdsTime):
        return epoch.date() != time.epoch
    if scale:
        behind_tai_s = {"gps": -GPS_LESS_TAI_S}
        if (scale == "utc") != (time.scale == "utc"):
            return True
        apart_s = behind_tai_s.get(time.scale, 0) - behind_tai_s.get(scale, 0)
        return time.epoch + timedelta(seconds=apart_s) != epoch
    return abs((epoch - time.epoch).total_seconds()) > _EPOCH_S


@dataclass(frozen=True, slots=True)
class _Day:
    """A UTC day: its date, its start in TAI nanoseconds, and its length."""

    text: str
    tai_ns: int
    length_ns: int


@lru_cache(maxsize=64)
def _day(ordinal: int) -> _Day:
    """UTC day of an ordinal date; raises `BadInput` or `ValueError` beyond supported years."""
    text = date.fromordinal(ordinal).isoformat()
    start_ns = parse_utc(f"{text}T00:00:00Z").tai_ns
    # The day after the last supported one is of no supported year.
    following = recorded_utc(f"{date.fromordinal(ordinal + 1).isoformat()}T00:00:00Z")
    return _Day(text, start_ns, following.tai_ns - start_ns)


def _checked_day(ordinal: int, parameter: str, value: object) -> _Day:
    try:
        return _day(ordinal)
    except (BadInput, ValueError, OverflowError):
        message = f"the day is not in {FIRST_YEAR} to {LAST_YEAR}"
        raise PacketFault(parameter, message, value) from None


def _of_days(time: CdsTime, values: Mapping[str, Any]) -> Moment:
    number = whole(values, time.day)
    day = _checked_day(time.epoch.toordinal() + number, time.day, number)
    milliseconds = whole(values, time.millisecond)
    passed_ns = milliseconds * MS_NS
    if not 0 <= passed_ns < day.length_ns:
        message = f"there is no such millisecond of {day.text}"
        raise PacketFault(time.millisecond, message, milliseconds)
    if time.microsecond is not None:
        microseconds = whole(values, time.microsecond)
        if not 0 <= microseconds < 1000:
            message = "must be microseconds of a millisecond, 0 to 999"
            raise PacketFault(time.microsecond, message, microseconds)
        passed_ns += microseconds * US_NS
    return Moment(_text(day, passed_ns), day.tai_ns + passed_ns)


def _of_seconds(time: CucTime, values: Mapping[str, Any]) -> Moment:
    seconds = whole(values, time.coarse)
    fraction_ns = 0
    if time.fine is not None:
        fine = whole(values, time.fine)
        if not 0 <= fine < 1 << time.fine_bits:
            raise PacketFault(time.fine, f"has more than {time.fine_bits} bits", fine)
        fraction_ns = (fine * NS) >> time.fine_bits
    if time.scale == "utc":
        days, rest_s = divmod(seconds + _seconds_of_day(time.epoch), DAY_S)
        day = _checked_day(time.epoch.toordinal() + days, time.coarse, seconds)
        passed_ns = rest_s * NS + fraction_ns
        return Moment(_text(day, passed_ns), day.tai_ns + passed_ns)
    epoch_s = (time.epoch - _TAI_ZERO) // timedelta(seconds=1)
    if time.scale == "gps":
        epoch_s -= GPS_LESS_TAI_S
    tai_ns = (epoch_s + seconds) * NS + fraction_ns
    # TAI is ahead of UTC by less than a minute: it is this day or the one before.
    ordinal = _TAI_ZERO.toordinal() + (tai_ns + DAY_NS // 2) // DAY_NS
    day = _checked_day(ordinal, time.coarse, seconds)
    if tai_ns < day.tai_ns:
        day = _checked_day(ordinal - 1, time.coarse, seconds)
    return Moment(_text(day, tai_ns - day.tai_ns), tai_ns)


def _seconds_of_day(moment: datetime) -> int:
    start = moment.replace(hour=0, minute=0, second=0, tzinfo=UTC)
    return int((moment.replace(tzinfo=UTC) - start).total_seconds())


def _text(day: _Day, passed_ns: int) -> str:
    """Format UTC as `Utc.text` does; times beyond 24 hours are within the leap second."""
    seconds, nanoseconds = divmod(passed_ns, NS)
    if seconds >= DAY_S:
        hour, minute, second = 23, 59, seconds - DAY_S + 60
    else:
        hour, rest = divmod(seconds, 3600)
        minute, second = divmod(rest, 60)
    decimals = f"{nanoseconds:09d}".rstrip("0").ljust(3, "0") if nanoseconds else "000"
    return f"{day.text}T{hour:02d}:{minute:02d}:{second:02d}.{decimals}Z"


EXACT = 1 << 53
"""Limit up to which whole numbers are exact as a float."""


def number(values: Mapping[str, Any], name: str) -> float:
    """Packet value as a float, NaN and infinity allowed; raises `PacketFault` if not a number."""
    value = _present(values, name)
    if not isinstance(value, int | float):
        raise PacketFault(name, "must be a number", value)
    try:
        return float(value)
    except OverflowError:
        raise PacketFault(name, "is beyond every number of a batch") from None


def flag(values: Mapping[str, Any], name: str, labels: Sequence[str] | None = None) -> bool:
    """True if a flag is not zero; an enumerated flag is judged by its number.

    With `labels`, true if its label or text is among them.
    """
    if labels is not None:
        return text(values, name) in labels
    value = _present(values, name)
    raw = getattr(value, "raw_value", value) if isinstance(value, str) else value
    return bool(number({name: raw}, name))


def finite(values: Mapping[str, Any], name: str) -> float:
    """Packet value as a finite number; raises `PacketFault` otherwise."""
    value = number(values, name)
    if not math.isfinite(value):
        raise PacketFault(name, "must be finite", value)
    return value


def finite_all(values: Mapping[str, Any], names: Sequence[str], scale: float = 1.0) -> list[float]:
    """Several packet values as finite numbers, each times `scale`."""
    return [finite(values, name) * scale for name in names]


def whole(values: Mapping[str, Any], name: str) -> int:
    """Packet value as an integer; a float without a fraction is accepted."""
    value = _present(values, name)
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float) and value.is_integer() and abs(value) <= EXACT:
        return int(value)
    raise PacketFault(name, "must be a whole number", value)


def text(values: Mapping[str, Any], name: str) -> str:
    """Packet value as text: a string without padding, or a whole number in digits."""
    value = _present(values, name)
    if isinstance(value, bytes):
        try:
            value = value.decode("ascii")
        except UnicodeDecodeError:
            raise PacketFault(name, "must be text", value) from None
    if isinstance(value, str):
        return value.rstrip("\0 ").rstrip()
    return str(whole(values, name))


def _present(values: Mapping[str, Any], name: str) -> Any:
    try:
        return values[name]
    except KeyError:
        raise PacketFault(name, "is not in the packet") from None
