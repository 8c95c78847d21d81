"""Reader of attitudes as comma-separated values, such as the service exports.

A row has UTC and the quaternion q1, q2, q3, qc from inertial to body, scalar last.  Body rates in
deg/s and the number of the unbroken interval are read from columns if present; rows with another
status than good are skipped, and so are other columns, unless they say that the attitudes are not
what is read: of another frame, another direction, rates in another unit.  Rows of several
spacecraft or runs are refused.  Without interval numbers a step of more than ten minutes ends an
interval.
"""

import csv
import math
import re
from collections.abc import Iterator
from typing import IO

import numpy as np

from service.ephemerides.known import (
    MOST_RECORDS,
    KnownAttitudes,
    Segment,
    known_attitudes,
    told_rates,
)
from service.ephemerides.tokens import MAX_LINE_BYTES, Source, Token
from service.errors import BadFile, BadInput
from service.observations.schema import NORM_TOLERANCE
from service.times import parse_utc

_QUATERNION, _RATES = ("q1", "q2", "q3", "qc"), ("rate_x", "rate_y", "rate_z")
_HEADER = re.compile(rb"\A[^\n]*\bq1\b[^\n]*,|\A[^\n]*,[^\n]*\bq1\b", re.IGNORECASE)
_ONE_SERIES = ("spacecraft", "object", "object_name", "run", "grade")
"""Columns with the same value in all rows, since a file has one series of attitudes."""
_MEANINGS = {
    "frame": ("EME2000", "J2000", "ICRF", "GCRF"),
    "reference_frame": ("EME2000", "J2000", "ICRF", "GCRF"),
    "ref_frame": ("EME2000", "J2000", "ICRF", "GCRF"),
    "direction": ("INERTIAL_TO_BODY", "A2B"),
    "time_system": ("UTC",),
}
"""Allowed values of columns that describe the attitudes."""
_OTHER_RATES = re.compile(r"(body_|angular_)?(rate|omega|angvel|w)_?[xyz123]?(_|\b).*")
_LONGEST_STEP_NS = 600 * 10**9
_Row = tuple[int, str, list[float], list[float]]


def is_attitude_csv(start: bytes) -> bool:
    """True if the beginning of a file is a CSV header with columns of a quaternion."""
    return _HEADER.search(start) is not None


def read_attitude_csv(name: str, file: IO[bytes]) -> KnownAttitudes:
    """Read attitudes from a CSV file; raises `BadFile` naming file, line and column."""
    source = Source(name)
    segments: list[Segment] = []
    rows: list[_Row] = []
    line = begun = 1
    first: tuple[int, int, list[float]] | None = None
    for line, stretch, time_ns, numbers, rates in _rows(source, file):
        first = first or (line, time_ns, numbers)
        if rows and time_ns <= rows[-1][0]:
            message = "must be later than that of the row before"
            if (time_ns, numbers) == (rows[-1][0], rows[-1][2]):
                message = "repeats the row before it: a row must be there once"
            elif (time_ns, numbers) == first[1:]:
                message = f"repeats line {first[0]}: the file was appended to itself"
            raise source.bad(line, "time", message)
        if rows and (stretch != rows[-1][1] or _is_gap(stretch, time_ns - rows[-1][0])):
            segments.append(_segment(begun, rows))
            rows = []
        begun = begun if rows else line
        rows.append((time_ns, stretch, numbers, rates))
        if line > MOST_RECORDS:
            raise source.bad(line, "rows", f"are more than the {MOST_RECORDS:,} that are read")
    if rows:
        segments.append(_segment(begun, rows))
    return known_attitudes(name, "", segments)


def _is_gap(stretch: str, step_ns: int) -> bool:
    return not stretch and step_ns > _LONGEST_STEP_NS


def _segment(line: int, rows: list[_Row]) -> Segment:
    time_ns = np.array([each[0] for each in rows], dtype=np.int64)
    quaternion = np.array([each[2] for each in rows])
    quaternion /= np.linalg.norm(quaternion, axis=1)[:, None]
    rates = np.radians([each[3] for each in rows])
    rate = None if np.isnan(rates).all() else told_rates(quaternion, rates)
    return Segment(f"line {line}", time_ns, int(time_ns[0]), int(time_ns[-1]), quaternion, rate)


def _rows(
    source: Source, file: IO[bytes]
) -> Iterator[tuple[int, str, int, list[float], list[float]]]:
    """Line, interval, time, quaternion and rates (NaN if missing) of each good row."""
    names: list[str] = []
    series: dict[str, str] = {}
    for line, cells in _cells(source, file):
        if not names:
            names = [each.strip().lower() for each in cells]
            for column in ("time", *_QUATERNION):
                if names.count(column) != 1:
                    message = "must be there once: times of UTC, and quaternions with qc the scalar"
                    raise source.bad(line, f"column {column}", message, ",".join(names))
            missing = [each for each in _RATES if each not in names]
            for column in names:
                if len(missing) == len(_RATES) and _OTHER_RATES.fullmatch(column):
                    message = "is no column of rates: they are rate_x, rate_y, rate_z in deg/s"
                    raise source.bad(line, f"column {column}", message)
            if 0 < len(missing) < len(_RATES):
                raise source.bad(line, f"column {missing[0]}", "must be there beside other rates")
            continue
        if [each.strip().lower() for each in cells] == names:
            message = "repeats the header: the file was appended to itself or to another"
            raise source.bad(line, "row", message)
        if len(cells) != len(names):
            message = f"must have {len(names)} cells, as the header has"
            raise source.bad(line, "row", message, ",".join(cells))
        row = dict(zip(names, (each.strip() for each in cells), strict=True))
        if (row.get("status") or "good").lower() != "good":
            continue
        _require_meaning(source, line, row)
        for column in _ONE_SERIES:
            if column in row and series.setdefault(column, row[column]) != row[column]:
                message = f"must be {series[column]}, as above: a file is of one series"
                raise source.bad(line, f"column {column}", message, row[column])
        try:
            time_ns = parse_utc(row["time"]).tai_ns
        except BadInput as error:
            raise source.bad(line, "time", error.faults[0].message, row["time"]) from None
        numbers = [_number(source, line, row, each) for each in _QUATERNION]
        norm = math.hypot(*numbers)
        if not abs(norm - 1.0) <= NORM_TOLERANCE:
            message = f"must have norm 1 within {NORM_TOLERANCE}; its norm is {norm:.6g}"
            raise source.bad(line, "quaternion", message, numbers)
        rates = [_number(source, line, row, each) if row.get(each) else math.nan for each in _RATES]
        yield line, row.get("stretch", ""), time_ns, numbers, rates


def _require_meaning(source: Source, line: int, row: dict[str, str]) -> None:
    """Raise `BadFile` for a row of another frame, direction or time system."""
    for column, allowed in _MEANINGS.items():
        if (cell := row.get(column, "")) and cell.upper().replace(" ", "_") not in allowed:
            message = f"must be {' or '.join(allowed)}"
            raise source.bad(line, f"column {column}", message, cell)


def _number(source: Source, line: int, row: dict[str, str], column: str) -> float:
    return source.number(Token(line, "state", f"column {column}"), row[column])


def _cells(source: Source, file: IO[bytes]) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of each line of a CSV file that is not empty."""
    number = 0
    while data := file.readline(MAX_LINE_BYTES + 1):
        number += 1
        if len(data) > MAX_LINE_BYTES:
            raise source.bad(number, "line", f"must have at most {MAX_LINE_BYTES} bytes")
        try:
            text = data.decode("utf-8-sig" if number == 1 else "utf-8").strip()
            cells = next(csv.reader([text], strict=True), [])
        except (UnicodeDecodeError, csv.Error) as error:
            raise _bad_line(source, number, data, error) from None
        if cells:
            yield number, cells


def _bad_line(source: Source, number: int, data: bytes, error: Exception) -> BadFile:
    return source.bad(number, "line", f"is no row of comma-separated values: {error}", data[:40])
