"""Epochs of CCSDS messages in their time systems, as nanoseconds of TAI."""

import re
from datetime import datetime

from service.errors import BadInput
from service.times import FIRST_YEAR, LAST_YEAR, parse_utc

_LESS_TAI_NS = {"TAI": 0, "GPS": -19 * 10**9, "TT": 32_184_000_000}
"""Uniform time systems, by what they are ahead of TAI."""
TIME_SYSTEMS = ("UTC", *_LESS_TAI_NS)
_J2000 = datetime(2000, 1, 1, 12)
_DECIMALS = re.compile(r"(.*T\d\d:\d\d:\d\d)(\.\d+)?Z?", re.ASCII)


def epoch_ns(text: str, time_system: str) -> int:
    """An epoch as `Utc.tai_ns`; raises `ValueError` with what is expected.

    Digits beyond the nanosecond are cut off.
    """
    found = _DECIMALS.fullmatch(text)
    if found is None:
        raise ValueError("must be a time as 1996-01-10T12:00:00.000 or 1996-010T12:00:00.000")
    whole, fraction = found[1], (found[2] or ".0")[:10]
    if time_system == "UTC":
        try:
            return parse_utc(whole + fraction).tai_ns
        except BadInput as error:
            raise ValueError(error.faults[0].message) from None
    try:
        form = "%Y-%jT%H:%M:%S" if len(whole) == 17 else "%Y-%m-%dT%H:%M:%S"
        moment = datetime.strptime(whole, form)
    except ValueError:
        raise ValueError("there is no such time") from None
    if not FIRST_YEAR <= moment.year <= LAST_YEAR:
        raise ValueError(f"the year must be from {FIRST_YEAR} to {LAST_YEAR}")
    since = moment - _J2000
    seconds = since.days * 86_400 + since.seconds
    return seconds * 10**9 + int(fraction[1:].ljust(9, "0")) - _LESS_TAI_NS[time_system]
