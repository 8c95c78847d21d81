"""Reader of two-line element sets (TLE), propagated with SGP4 by the package `sgp4`.

SGP4 gives states in the true equator and mean equinox of date (TEME).  They are rotated to the mean
equator and equinox of J2000 with the matching models of ERFA: precession of 1976 and nutation of
1980.
"""

import codecs
import math
import re
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import IO, Any

import erfa
import numpy as np
from erfa import ufunc

from service.ephemerides.tokens import Source, epoch_ns
from service.extras import require_extra
from service.times import DAY_S, Utc
from service.vectors import Matrix, Vector

LENGTH = 69
MAX_AGE_D = 7.0
"""Greatest difference in days to an element set's epoch: errors grow by 1 to 3 km per day."""
MOST_OFF_AXIS = 0.05
"""Largest difference of a state's semi-major axis from that of its set, as a share of it."""
MOST_SETS = 100_000
MAX_LINE_BYTES = 200
_FIRST_CENTURY_YEAR = 57
"""First two-digit year of an element set that is in the 1900s; smaller ones are in the 2000s."""

_NUMBER, _ANGLE = r" *\d+|[A-HJ-NP-Z]\d{4}", r" *\d+\.\d{4}"
_EXPONENT = r"[ +-]\d{5}[+-]\d"
_FIELDS: dict[int, tuple[tuple[str, int, int, str], ...]] = {
    1: (
        ("satellite number", 2, 7, _NUMBER),
        ("epoch", 18, 32, r"\d\d *\d+\.\d{8}"),
        ("derivative of the mean motion", 33, 43, r"[ +-]\.\d{8}"),
        ("second derivative of the mean motion", 44, 52, _EXPONENT),
        ("drag term", 53, 61, _EXPONENT),
        # Type 4 is SGP4-XP, another model.
        ("ephemeris type", 62, 63, "[ 02]"),
        ("element set number", 64, 68, r" *\d*"),
    ),
    2: (
        ("satellite number", 2, 7, _NUMBER),
        ("inclination", 8, 16, _ANGLE),
        ("right ascension of the node", 17, 25, _ANGLE),
        ("eccentricity", 26, 33, r" *\d+"),
        ("argument of perigee", 34, 42, _ANGLE),
        ("mean anomaly", 43, 51, _ANGLE),
        ("mean motion", 52, 63, r" *\d+\.\d{8}"),
        ("revolution number", 63, 68, r" *\d*"),
    ),
}
"""Fields of each TLE line: name, first column, end column (both from 0), and pattern."""
_SPACES = {1: (1, 8, 17, 32, 43, 52, 61, 63), 2: (1, 7, 16, 25, 33, 42, 51)}
"""Columns of each TLE line, from 0, that must be blank."""


@dataclass(frozen=True)
class ElementSet:
    """An orbital element set with its epoch, `Utc.tai_ns`."""

    epoch_ns: int
    elements: Any


@dataclass(frozen=True)
class TleEphemeris:
    """Element sets of one object, in order of their epochs."""

    object_name: str
    sets: list[ElementSet]

    def at(self, moment: Utc) -> Vector | None:
        """Geocentric state (6,) in EME2000, km and km/s, from the set with the nearest epoch.

        None more than `MAX_AGE_D` from every epoch, if SGP4 finds that the object decayed, and if
        it gives another orbit than the set describes, as far from the epoch of a decaying object.
        """
        after = bisect_left(self.sets, moment.tai_ns, key=attrgetter("epoch_ns"))
        beside = self.sets[max(after - 1, 0) : after + 1]
        nearest = min(beside, key=lambda each: abs(each.epoch_ns - moment.tai_ns))
        since_s = (moment.tai_ns - nearest.epoch_ns) * 1e-9
        if abs(since_s) > MAX_AGE_D * DAY_S:
            return None
        error, position_km, velocity_km_per_s = nearest.elements.sgp4_tsince(since_s / 60.0)
        if error or not _is_of_orbit(nearest.elements, position_km, velocity_km_per_s):
            return None
        rotation = eme2000_from_teme(moment)
        return np.concatenate([rotation @ position_km, rotation @ velocity_km_per_s])


def _is_of_orbit(
    elements: Any, position_km: Sequence[float], velocity_km_per_s: Sequence[float]
) -> bool:
    """True if a state has about the semi-major axis of its set, by the energy of the orbit."""
    inverse_km = (
        2.0 / math.hypot(*position_km) - sum(v * v for v in velocity_km_per_s) / elements.mu
    )
    share = inverse_km * elements.a * elements.radiusearthkm
    return bool(abs(share - 1.0) < MOST_OFF_AXIS)


def eme2000_from_teme(moment: Utc) -> Matrix:
    """Rotation matrix (3, 3) from TEME at a time to EME2000 (J2000)."""
    tt = moment.tt
    nutation_in_longitude, _ = ufunc.nut80(*tt)
    equinoxes = float(nutation_in_longitude) * math.cos(float(ufunc.obl80(*tt)))
    cosine, sine = math.cos(equinoxes), math.sin(equinoxes)
    true_from_teme = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(erfa.pnm80(*tt).T @ true_from_teme)


def read_tle(name: str, file: IO[bytes], field: str) -> TleEphemeris:
    """Read the two-line element sets of a file, with or without lines of names.

    Raises `BadFile` naming file, line and field, and `NotAvailable` without sgp4.
    """
    require_extra("tle", "sgp4", field, name)
    source = Source(name)
    sets: list[ElementSet] = []
    first: tuple[int, str] | None = None
    number, title = "", ""
    for line, text in _lines(source, file):
        if first is None and not text.startswith("1 "):
            if text.startswith("2 "):
                raise source.bad(line, "line 2", "must follow line 1 of its set", text)
            # After the first set, the line belongs to another set, or ends a bulletin.
            title = title if sets else text.removeprefix("0 ").strip()
            continue
        _check(source, line, text, 1 if first is None else 2)
        if text[2:7] != (number or text[2:7]):
            message = f"must be {number}, as above: a file is of one object"
            raise source.bad(line, "satellite number", message, text[2:7])
        number = text[2:7]
        if first is None:
            first = line, text
            continue
        sets.append(_set(source, *first, text))
        first = None
        if len(sets) > MOST_SETS:
            raise source.bad(line, "sets", f"are more than the {MOST_SETS:,} that are read")
    if first is not None:
        raise source.bad(first[0], "line 2", "is missing: the file was cut short")
    if not sets:
        raise source.bad(1, "line 1", "is missing: the file is neither an OEM nor a TLE")
    sets.sort(key=lambda each: each.epoch_ns)
    return TleEphemeris(title or number.strip(), sets)


def _lines(source: Source, file: IO[bytes]) -> Any:
    """Lines of a TLE file that are not empty, each after its number; raises `BadFile`."""
    number = 0
    while data := file.readline(MAX_LINE_BYTES + 1):
        number += 1
        if number == 1:
            data = data.removeprefix(codecs.BOM_UTF8)
        if len(data) > MAX_LINE_BYTES:
            raise source.bad(number, "line", f"must have at most {MAX_LINE_BYTES} bytes")
        try:
            text = data.decode("ascii").rstrip()
        except UnicodeDecodeError:
            raise source.bad(number, "line", "must be ASCII text", data[:20]) from None
        if not text.isprintable():
            raise source.bad(number, "line", "must have no control character", text)
        if text:
            yield number, text


def _check(source: Source, line: int, text: str, which: int) -> None:
    """Raise `BadFile` unless a text is a valid first or second line of a two-line set."""
    if not text.startswith(f"{which} "):
        raise source.bad(line, f"line {which}", f"must begin with {which} and a space", text)
    if len(text) != LENGTH:
        message = f"must have {LENGTH} characters; it has {len(text)}"
        raise source.bad(line, f"line {which}", message, text)
    digits = sum(int(each) if each.isdigit() else each == "-" for each in text[:-1])
    if text[-1] != str(digits % 10):
        raise source.bad(line, "checksum", f"must be {digits % 10}", text[-1])
    for column in _SPACES[which]:
        if text[column] != " ":
            message = f"must have a space in column {column + 1}"
            raise source.bad(line, f"line {which}", message, text)
    for name, begin, end, form in _FIELDS[which]:
        if re.fullmatch(form, text[begin:end], re.ASCII) is None:
            message = f"is not as columns {begin + 1} to {end} of line {which} have it"
            raise source.bad(line, name, message, text[begin:end])


def _set(source: Source, line: int, first: str, second: str) -> ElementSet:
    from sgp4.api import SGP4_ERRORS, Satrec

    year, day = int(first[18:20]), float(first[20:32])
    century = 1900 if year >= _FIRST_CENTURY_YEAR else 2000
    whole = math.floor(day)
    try:
        midnight_ns = epoch_ns(f"{century + year}-{whole:03d}T00:00:00", "UTC")
    except ValueError as error:
        raise source.bad(line, "epoch", str(error), first[18:32]) from None
    if float(second[52:63]) <= 0.0:
        raise source.bad(line + 1, "mean motion", "must be above 0", second[52:63])
    elements = Satrec.twoline2rv(first, second)
    if elements.error:
        reason = SGP4_ERRORS.get(elements.error, f"error {elements.error}")
        raise source.bad(line, "elements", f"are refused by SGP4: {reason}")
    return ElementSet(midnight_ns + round((day - whole) * DAY_S * 1e9), elements)
