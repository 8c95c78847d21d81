"""Reader of mean orbital elements (OMM, CCSDS 502.0-B): KVN, XML, and JSON and CSV of catalogs.

The elements are those of a two-line element set without its limit on object numbers, and are
propagated by the same SGP4: see `tle`.
"""

import codecs
import csv
import io
import math
import re
from collections.abc import Iterator, Mapping
from typing import IO, Any

import msgspec

from service.ephemerides import tokens as ccsds
from service.ephemerides.tle import MOST_SETS, ElementSet, TleEphemeris
from service.extras import require_extra
from service.times import DAY_S, parse_utc

_FORM = ccsds.MessageForm(
    kind="OMM", marks=(), before_states=(), parts={}, state="no element is a state"
)
_VERSION = "CCSDS_OMM_VERS"
_IS_OMM = re.compile(rb"<(\w+:)?omm\b|\ACCSDS_OMM_VERS|\A[\[{]|\A[^\n]*\bMEAN_MOTION\b[^\n]*,")
_MOST_BYTES = 64 << 20
_NUMBERS: dict[str, tuple[float, float, float | None]] = {
    "MEAN_MOTION": (1e-3, 20.0, None),
    "ECCENTRICITY": (0.0, 1.0 - 1e-9, None),
    "INCLINATION": (0.0, 180.0, None),
    "RA_OF_ASC_NODE": (-360.0, 360.0, None),
    "ARG_OF_PERICENTER": (-360.0, 360.0, None),
    "MEAN_ANOMALY": (-360.0, 360.0, None),
    "BSTAR": (-10.0, 10.0, None),
    "MEAN_MOTION_DOT": (-10.0, 10.0, 0.0),
    "MEAN_MOTION_DDOT": (-10.0, 10.0, 0.0),
}
"""Range of each mean element, in revolutions per day or degrees, and its default."""
_FIXED = {
    "CENTER_NAME": ("EARTH",),
    "REF_FRAME": ("TEME",),
    "TIME_SYSTEM": ("UTC",),
    "MEAN_ELEMENT_THEORY": ("SGP4", "SGP/SGP4", "SGP", "TLE"),
    "EPHEMERIS_TYPE": ("0", "2"),
}
"""Accepted values of the keywords that define the meaning of the mean elements."""
_JD_OF_1950 = 2433281.5
"""Julian date of day 0 of 1950, from which SGP4 counts days."""
_BEYOND_NS = re.compile(r"(\.\d{9})\d+")
Fields = tuple[int, Mapping[str, str]]


def is_omm(start: bytes) -> bool:
    """True if the beginning of a file is an OMM in any of its notations."""
    return _IS_OMM.search(start) is not None


def read_omm(name: str, file: IO[bytes], field: str) -> TleEphemeris:
    """Read the mean element sets of a file about one object, for SGP4.

    Raises `BadFile` naming file, line and field, and `NotAvailable` without sgp4.
    """
    require_extra("tle", "sgp4", field, name)
    source = ccsds.Source(name)
    sets: list[ElementSet] = []
    about: tuple[str, str] | None = None
    for line, fields in _sets_of_fields(source, file):
        this = fields.get("NORAD_CAT_ID", ""), fields.get("OBJECT_ID", "")
        if about not in (None, this):
            number = this[0] or this[1]
            raise source.bad(line, "NORAD_CAT_ID", "must be the same in every set", number)
        about = this
        sets.append(_set(source, line, fields))
        if len(sets) > MOST_SETS:
            raise source.bad(line, "sets", f"are more than the {MOST_SETS:,} that are read")
    if not sets or about is None:
        raise source.bad(1, "EPOCH", "is missing: the file has no elements")
    sets.sort(key=lambda each: each.epoch_ns)
    return TleEphemeris(fields.get("OBJECT_NAME") or about[0] or about[1], sets)


def _sets_of_fields(source: ccsds.Source, file: IO[bytes]) -> Iterator[Fields]:
    """Keywords and values of each element set in a file, after its line number."""
    start = file.read(256).lstrip(codecs.BOM_UTF8 + b" \t\r\n")
    file.seek(0)
    if start.startswith((b"<", b"CCSDS_")):
        yield from _of_messages(source, file)
        return
    data = file.read(_MOST_BYTES + 1)
    if len(data) > _MOST_BYTES:
        raise source.bad(1, "file", f"has more than {_MOST_BYTES >> 20} MB")
    try:
        text = data.removeprefix(codecs.BOM_UTF8).decode()
    except UnicodeDecodeError:
        raise source.bad(1, "file", "must be UTF-8 text") from None
    if start.startswith((b"[", b"{")):
        yield from _of_json(source, text)
    else:
        yield from _of_csv(source, text)


def _of_messages(source: ccsds.Source, file: IO[bytes]) -> Iterator[Fields]:
    tokens = ccsds.tokens_of(source, file, _FORM)
    first = next(tokens, None)
    ccsds.read_version(source, first, _FORM, ("1.0", "2.0", "3.0"))
    line, fields = 1, dict[str, str]()
    for token in tokens:
        if token.name == _VERSION:
            ccsds.read_version(source, token, _FORM, ("1.0", "2.0", "3.0"))
            yield line, fields
            fields = {}
        elif token.name in fields and token.name in (*_NUMBERS, *_FIXED, "EPOCH"):
            raise source.bad_token(token, "is there already")
        fields[token.name] = token.value
        line = token.line
    yield line, fields


def _of_json(source: ccsds.Source, text: str) -> Iterator[Fields]:
    try:
        found = msgspec.json.decode(text, type=list[dict[str, Any]] | dict[str, Any])
        sets = [
            {key: _text(value) for key, value in each.items() if value is not None}
            for each in (found if isinstance(found, list) else [found])
        ]
    except (msgspec.MsgspecError, RecursionError) as error:
        raise source.bad(
            1, "JSON", f"must be a set of elements, or a list of some: {error}"
        ) from None
    for each in sets:
        yield 1, each


def _text(value: Any) -> str:
    return value if isinstance(value, str) else repr(value)


def _of_csv(source: ccsds.Source, text: str) -> Iterator[Fields]:
    try:
        rows = csv.DictReader(io.StringIO(text), strict=True)
        for row in rows:
            if None in row or None in row.values():
                raise source.bad(rows.line_num, "row", "must have as many cells as the header")
            yield rows.line_num, row
    except csv.Error as error:
        raise source.bad(rows.line_num, "row", f"is no CSV: {error}") from None


def _set(source: ccsds.Source, line: int, fields: Mapping[str, str]) -> ElementSet:
    from sgp4.api import SGP4_ERRORS, WGS72, Satrec

    for name, known in _FIXED.items():
        # A catalog may have empty cells.
        value = fields.get(name) or known[0]
        if value.upper() not in known:
            raise source.bad(line, name, f"must be {' or '.join(known)}", value)
    number = {name: _number(source, line, name, fields) for name in _NUMBERS}
    if "EPOCH" not in fields:
        raise source.bad(line, "EPOCH", "is missing")
    # Older answers of Space-Track have a space between date and time.
    epoch = fields["EPOCH"].replace(" ", "T", 1)
    try:
        epoch_ns = ccsds.epoch_ns(epoch, "UTC")
    except ValueError as error:
        raise source.bad(line, "EPOCH", str(error), fields["EPOCH"]) from None
    utc = parse_utc(_BEYOND_NS.sub(r"\1", epoch))
    per_min = math.tau / (DAY_S / 60.0)
    elements = Satrec()
    elements.sgp4init(
        WGS72,
        "i",
        # The object's number has no effect on the motion, and SGP4 accepts none beyond 339,999.
        0,
        utc.jd1 - _JD_OF_1950 + utc.jd2,
        number["BSTAR"],
        number["MEAN_MOTION_DOT"] * per_min / 1440.0,
        number["MEAN_MOTION_DDOT"] * per_min / 1440.0**2,
        number["ECCENTRICITY"],
        *(math.radians(number[f"{name}"]) for name in ("ARG_OF_PERICENTER", "INCLINATION")),
        math.radians(number["MEAN_ANOMALY"]),
        number["MEAN_MOTION"] * per_min,
        math.radians(number["RA_OF_ASC_NODE"]),
    )
    if elements.error:
        reason = SGP4_ERRORS.get(elements.error, f"error {elements.error}")
        raise source.bad(line, "elements", f"are refused by SGP4: {reason}")
    return ElementSet(epoch_ns, elements)


def _number(source: ccsds.Source, line: int, name: str, fields: Mapping[str, str]) -> float:
    least, most, default = _NUMBERS[name]
    word = fields.get(name, "")
    if not word and default is not None:
        return default
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not least <= value <= most or "_" in word:
        raise source.bad(line, name, f"must be a number from {least:g} to {most:g}", word)
    return value
