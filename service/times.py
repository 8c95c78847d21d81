"""Conversion between UTC text and two-part Julian dates.

Calendar (`1996-01-10T12:00:00.000Z`) and day-of-year (`1996-010T12:00:00Z`) forms are read, also
with the offset of a time zone (`+01:00`), which is converted; a leap second (`23:59:60`) is a time
like any other; digits below the microsecond are kept (CCSDS 301.0-B, ASCII codes A and B).

ERFA does the arithmetic.  Its bare ufuncs are called because pyerfa's wrappers warn of every year
beyond the leap-second table, and silencing a warning is not safe between threads; the status they
return is read instead.
"""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import MAXYEAR, MINYEAR, UTC, date, datetime, timedelta
from functools import cache, lru_cache
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
from erfa import ufunc

from service.errors import BadInput, Fault, shown_value

FIRST_YEAR, LAST_YEAR = 1972, 2099
HOUR_S, DAY_S = 3600, 86400
J2000_YEAR = 2000.0
UNIX_DAY = 40587
"""Modified Julian Date of 1970-01-01, where POSIX time begins."""

_MJD_ZERO = date(1858, 11, 17).toordinal()
_J2000_MJD = 51544
_J2000_JD = 2451545.0
_DAYS_PER_JULIAN_YEAR = 365.25
_MJD_ZERO_JD = 2400000.5
TT_LESS_TAI_S = 32.184
"""Offset of Terrestrial Time from TAI, in seconds (IAU 1991 resolution A4)."""
_UNIX_J2000_S = 946_728_000
_TEXT = re.compile(
    r"(?P<year>\d{4})-(?:(?P<month>\d{2})-(?P<day>\d{2})|(?P<doy>\d{3}))"
    r"T(?P<hour>\d{2}):(?P<minute>\d{2}):(?P<second>\d{2})(?P<fraction>\.\d{1,9})?"
    r"(?:Z|(?P<zone>[+-])(?P<zone_hour>\d{2})(?::?(?P<zone_minute>\d{2}))?)?",
    re.ASCII,
)
_TWO_DIGITS = [f"{number:02d}" for number in range(61)]
T = TypeVar("T")
_FORMS = "UTC as 1996-01-10T12:00:00.000Z or 1996-010T12:00:00.000Z"


class _Once(Generic[T]):
    """Property computed at the first access; `functools.cached_property` without its lock.

    Until Python 3.12 the lock takes longer than most of these computations.  Two threads may both
    compute a value, and get the same.
    """

    def __init__(self, work_out: Callable[[Any], T]) -> None:
        self._work_out = work_out
        self._name = work_out.__name__
        self.__doc__ = work_out.__doc__

    def __get__(self, owner: Any, kind: type | None = None) -> T:
        value = vars(owner)[self._name] = self._work_out(owner)
        return value


@dataclass(frozen=True, order=True)
class Utc:
    """Time in UTC as ERFA's two-part quasi-Julian date."""

    jd1: float
    jd2: float

    def __str__(self) -> str:
        return self.text

    @_Once
    def _fields(self) -> tuple[date, int, int, int, int]:
        """Date, hour, minute, second (0 to 60) and nanoseconds."""
        year, month, day, clock, _ = ufunc.d2dtf(b"UTC", 9, self.jd1, self.jd2)
        h, m, s, f = (int(clock[name]) for name in ("h", "m", "s", "f"))
        return date(int(year), int(month), int(day)), h, m, s, f

    @_Once
    def text(self) -> str:
        """Calendar text with at least three and at most nine decimals, ending in Z."""
        day, hour, minute, second, nanoseconds = self._fields
        decimals = f"{nanoseconds:09d}".rstrip("0").ljust(3, "0") if nanoseconds else "000"
        clock = f"{_TWO_DIGITS[hour]}:{_TWO_DIGITS[minute]}:{_TWO_DIGITS[second]}"
        return f"{day.isoformat()}T{clock}.{decimals}Z"

    @property
    def day_of_year(self) -> int:
        """Day of the year, 1 January being 1."""
        return self._fields[0].timetuple().tm_yday

    @_Once
    def tai_ns(self) -> int:
        """Nanoseconds of TAI since 2000-01-01T12:00:00 TAI: for sorting and differences."""
        day, hour, minute, second, nanoseconds = self._fields
        seconds = (day.toordinal() - _MJD_ZERO - _J2000_MJD) * DAY_S - DAY_S // 2
        seconds += hour * HOUR_S + minute * 60 + second + _tai_less_utc_s(day)
        return seconds * 1_000_000_000 + nanoseconds

    @_Once
    def tt(self) -> tuple[float, float]:
        """Time converted to Terrestrial Time, as a two-part Julian date."""
        day = self._fields[0]
        if self.jd1 == _midnight_jd(day) and _length_s(day) == DAY_S:
            # Same result as `utctai` on a day without a leap second, in less time.
            tai1, tai2 = self.jd1, self.jd2 + _tai_less_utc_s(day) / DAY_S
        else:
            tai1, tai2 = map(float, ufunc.utctai(self.jd1, self.jd2)[:2])
        # `taitt` would add the same constant to the second, smaller part.
        return tai1, tai2 + TT_LESS_TAI_S / DAY_S

    @property
    def julian_year(self) -> float:
        """Time converted to a Julian epoch in years, 2000.0 being J2000."""
        tt1, tt2 = self.tt
        return J2000_YEAR + ((tt1 - _J2000_JD) + tt2) / _DAYS_PER_JULIAN_YEAR

    def bucket(self, width_s: int) -> int:
        """Number of the UTC hour (3600) or day (86400) that contains the time, from MJD 0.

        A leap second belongs to the hour and the day that it ends.
        """
        day, hour = self._fields[:2]
        days = day.toordinal() - _MJD_ZERO
        return days if width_s == DAY_S else days * 24 + hour


@lru_cache(maxsize=1024)
def _tai_less_utc_s(day: date) -> int:
    """Difference TAI - UTC on a day, in seconds."""
    return int(ufunc.dat(day.year, day.month, day.day, 0.0)[0])


def bucket_start(number: int, width_s: int) -> Utc:
    """Time at which the hour or day with a number (see `Utc.bucket`) begins."""
    days, hour = (number, 0) if width_s == DAY_S else divmod(number, 24)
    day = date.fromordinal(days + _MJD_ZERO)
    found = _from_fields(day, hour, 0, 0.0)
    vars(found)["_fields"] = day, hour, 0, 0, 0
    return found


def utc_now() -> Utc:
    """The current UTC time by the machine's clock."""
    return utc_of_unix(time.time())


@cache
def _leap_seconds() -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Times (`tai_ns`) of the changes of the number of leap seconds, and the numbers."""
    counted = {
        int(ufunc.dat(year, month, 1, 0.0)[0]): _from_fields(date(year, month, 1), 0, 0, 0.0).tai_ns
        for year in range(LAST_YEAR, FIRST_YEAR - 1, -1)
        for month in (7, 1)
    }
    numbers = sorted(counted)
    return np.array([counted[number] for number in numbers]), np.array(numbers)


def unix_seconds(tai_ns: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Convert times given as `Utc.tai_ns` to POSIX seconds, which ignore leap seconds.

    A leap second is placed just before the following midnight, and so belongs to the same hour and
    day as in `Utc.bucket`.
    """
    tai = np.asarray(tai_ns, dtype=np.int64)
    begin, number = _leap_seconds()
    place = np.searchsorted(begin, tai, side="right") - 1
    # Whole seconds by themselves: rounding must not move a full second before itself.
    midnight = _UNIX_J2000_S + begin // 10**9 - number
    following = np.append(midnight[1:].astype(float), np.inf)
    whole, rest_ns = np.divmod(tai, 10**9)
    unix_s = (_UNIX_J2000_S + whole - number[place]) + rest_ns * 1e-9
    return np.asarray(np.minimum(unix_s, np.nextafter(following[place], 0.0)))


def utc_of_unix(unix_s: float) -> Utc:
    """Convert a POSIX time to UTC, to the microsecond."""
    moment = datetime.fromtimestamp(unix_s, UTC)
    day, hour, minute = moment.date(), moment.hour, moment.minute
    found = _from_fields(day, hour, minute, moment.second + moment.microsecond / 1e6)
    vars(found)["_fields"] = day, hour, minute, moment.second, moment.microsecond * 1000
    return found


def shifted(moment: Utc, seconds: float) -> Utc:
    """Time that is `seconds` of TAI later, leap seconds counted, to the nanosecond.

    It is read again from its text: times compare equal and in order only if the two parts of the
    Julian date are split alike.
    """
    tai1, tai2, _ = ufunc.utctai(moment.jd1, moment.jd2)
    jd1, jd2, _ = ufunc.taiutc(tai1, tai2 + seconds / DAY_S)
    return recorded_utc(Utc(float(jd1), float(jd2)).text)


def parse_utc(text: object, field: str = "time") -> Utc:
    """Read UTC text, calendar or day-of-year.

    Raises `BadInput` naming `field` for another form, a day or second that
    does not exist, and years outside those supported.
    """
    try:
        if not isinstance(text, str):
            raise ValueError(f"must be {_FORMS}")
        return _read(text, FIRST_YEAR, LAST_YEAR)
    except ValueError as error:
        raise BadInput(Fault(field, str(error), shown_value(text))) from None


def recorded_utc(text: str) -> Utc:
    """Read UTC text that the service itself wrote, whatever the year.

    A machine's clock may have been years off when a record was made.
    """
    return _read(text, MINYEAR, MAXYEAR)


@lru_cache(maxsize=4096)
def _read(text: str, first_year: int, last_year: int) -> Utc:
    """Parse UTC text, cached for the repeated texts of a batch; raises `ValueError`."""
    match = _TEXT.fullmatch(text)
    if match is None:
        raise ValueError(f"must be {_FORMS}")
    years, months, days, days_of_year, hours, minutes, seconds, fraction, *zone = match.groups("")
    year, hour, minute, second = int(years), int(hours), int(minutes), int(seconds)
    if not first_year <= year <= last_year:
        raise ValueError(f"the year must be from {first_year} to {last_year}")
    is_end_of_day = hour == 24 and not (minute or second or float(fraction or 0.0))
    if (hour > 23 and not is_end_of_day) or minute > 59 or second > 60:
        raise ValueError("there is no such time of day")
    try:
        if days_of_year:
            day = date(year, 1, 1) + timedelta(days=int(days_of_year) - 1)
        else:
            day = date(year, int(months), int(days))
    except ValueError:
        raise ValueError("there is no such day") from None
    if day.year != year:
        raise ValueError("there is no such day of the year")
    if is_end_of_day:
        # The end of a day is the beginning of the next one (ISO 8601).
        if day == date(last_year, 12, 31):
            raise ValueError(f"the year must be from {first_year} to {last_year}")
        day, hour = day + timedelta(days=1), 0
    if zone[0]:
        day, hour, minute = _in_utc(day, hour, minute, *zone)
    if second == 60 and not ((hour, minute) == (23, 59) and _length_s(day) > DAY_S):
        raise ValueError("there is no leap second at that time")
    moment = _from_fields(day, hour, minute, second + float(fraction or 0.0))
    # Keep the parsed fields: the Julian date, exact to 1e-11 s, would give the same ones.
    nanoseconds = int(fraction[1:].ljust(9, "0"))
    vars(moment)["_fields"] = day, hour, minute, second, nanoseconds
    return moment


def _in_utc(
    day: date, hour: int, minute: int, sign: str, zone_hours: str, zone_minutes: str
) -> tuple[date, int, int]:
    """Convert day, hour and minute from a time zone to UTC; raises `ValueError`."""
    ahead_min = 60 * int(zone_hours) + int(zone_minutes or 0)
    if int(zone_hours) > 23 or int(zone_minutes or 0) > 59:
        raise ValueError("there is no such time zone")
    days, minutes = divmod(60 * hour + minute + (-ahead_min if sign == "+" else ahead_min), 24 * 60)
    try:
        return day + timedelta(days=days), *divmod(minutes, 60)
    except OverflowError:
        raise ValueError("there is no such day") from None


@lru_cache(maxsize=1024)
def _length_s(day: date) -> int:
    """Length of a UTC day in seconds."""
    return DAY_S + _tai_less_utc_s(day + timedelta(days=1)) - _tai_less_utc_s(day)


def _midnight_jd(day: date) -> float:
    return _MJD_ZERO_JD + (day.toordinal() - _MJD_ZERO)


def _from_fields(day: date, hour: int, minute: int, second: float) -> Utc:
    # The fraction of the day as ERFA's `dtf2d` defines it: a leap second lengthens the day.
    return Utc(_midnight_jd(day), (60.0 * (60 * hour + minute) + second) / _length_s(day))
