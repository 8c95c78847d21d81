"""Reader of a site's own star catalog in CSV: complete, or refused with every fault named."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from service.csv_cells import original
from service.errors import BadFile, Fault, shown_value

FAULTS_SHOWN = 20
MAX_ID_LENGTH = 64
LEAST_JUDGED = 100
"""Least number of stars by whose range of places a wrong unit is recognised."""
FIRST_EPOCH, LAST_EPOCH = 1800.0, 2100.0
"""Earliest and latest Julian year of a position's epoch."""


@dataclass(frozen=True)
class _NumberColumn:
    """Numeric column of a CSV catalog: its name, allowed range, and value if the cell is empty."""

    column: str
    least: float
    most: float
    absent: float
    whole: bool = False


REQUIRED: Mapping[str, _NumberColumn] = {
    "ra_deg": _NumberColumn("ra_deg", 0.0, 360.0, math.nan),
    "dec_deg": _NumberColumn("dec_deg", -90.0, 90.0, math.nan),
    "magnitude": _NumberColumn("magnitude_v_mag", -5.0, 20.0, math.nan),
}
OPTIONAL: Mapping[str, _NumberColumn] = {
    "pm_ra_mas_per_year": _NumberColumn("pm_ra_mas_per_year", -20_000.0, 20_000.0, 0.0),
    "pm_dec_mas_per_year": _NumberColumn("pm_dec_mas_per_year", -20_000.0, 20_000.0, 0.0),
    "epoch": _NumberColumn("epoch_year", FIRST_EPOCH, LAST_EPOCH, math.nan),
    "parallax_mas": _NumberColumn("parallax_mas", -1000.0, 1000.0, math.nan),
    "color_bv_mag": _NumberColumn("color_bv_mag", -5.0, 10.0, math.nan),
    "variability_mag": _NumberColumn("variability_mag", 0.0, 30.0, math.nan),
    "position_sigma_arcsec": _NumberColumn("position_sigma_arcsec", 0.0, 3600.0, math.nan),
    "hip": _NumberColumn("hip", 1, 2**31 - 1, 0, whole=True),
    "hd": _NumberColumn("hd", 1, 2**31 - 1, 0, whole=True),
    "sao": _NumberColumn("sao", 1, 2**31 - 1, 0, whole=True),
}
"""Optional CSV columns, which may be missing or have empty cells."""
_ALL = {**REQUIRED, **OPTIONAL}


def read_csv_catalog(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The columns of a CSV catalog, by their names in a `Catalog`, in the order of the file.

    `ra_deg` is in [0, 360), 360 itself being read as 0. `epoch_year` is the Julian year of a star's
    position, NaN if missing. Raises BadFile with up to FAULTS_SHOWN faults, each with line, column
    and value.
    """
    lines = _lines(path)
    header = [name.strip() for name in lines[0][1]]
    faults = _header_faults(header)
    if faults:
        raise BadFile(faults)
    numbers = {name: rule for name, rule in _ALL.items() if name in header}
    labels: list[str] = []
    seen: dict[str, int] = {}
    values: dict[str, list[float]] = {name: [] for name in numbers}
    for line, cells in lines[1:]:
        if len(faults) >= FAULTS_SHOWN:
            break
        if len(cells) != len(header):
            expected = f"must have {len(header)} columns"
            faults.append(Fault(f"line {line}", expected, str(len(cells))))
            continue
        row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
        label = " ".join(original(row["id"]).split())
        fault = _label_fault(label, seen)
        if fault:
            faults.append(Fault(f"line {line}, column id", fault, shown_value(row["id"])))
        seen.setdefault(label, line)
        labels.append(label)
        for name, rule in numbers.items():
            value = _number(row[name], rule, required=name in REQUIRED)
            if isinstance(value, str):
                faults.append(Fault(f"line {line}, column {name}", value, shown_value(row[name])))
            else:
                values[name].append(value)
    if faults:
        raise BadFile(faults[:FAULTS_SHOWN])
    if not labels:
        raise BadFile(Fault(path.name, "holds a header and no star"))
    _require_degrees(values)
    return _columns(labels, values)


def _require_degrees(values: Mapping[str, Sequence[float]]) -> None:
    """Raise `BadFile` if the places of many stars look like hours or radians by their ranges."""
    ra, dec = np.array(values["ra_deg"]), np.array(values["dec_deg"])
    if len(ra) < LEAST_JUDGED:
        return
    last = float(ra.max())
    if last < 24.0 and np.ptp(dec) > 90.0:
        message = "must be degrees; stars far apart in declination end before 24, as hours do"
        raise BadFile(Fault("column ra_deg", message, f"{last:g}"))
    farthest = float(np.abs(dec).max())
    if 0.9 * math.tau < last < math.tau and 0.45 * math.pi < farthest <= 0.5 * math.pi:
        message = "must be degrees; places end before 2 pi and half of pi, as radians do"
        raise BadFile(Fault("columns ra_deg, dec_deg", message, f"{last:g}, {farthest:g}"))


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """The line numbers and cells of all lines that are not blank, beginning with the header."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadFile(Fault(str(path), f"cannot be read: {error.strerror}")) from error
    found = []
    for line, raw in enumerate(data.removeprefix(b"\xef\xbb\xbf").splitlines(), start=1):
        if b"\0" in raw:
            raise BadFile(Fault(f"line {line}", "holds a NUL byte", shown_value(raw)))
        try:
            text = raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise BadFile(
                Fault(
                    f"line {line}, byte {error.start + 1}",
                    "is not UTF-8",
                    shown_value(raw[error.start : error.end]),
                )
            ) from error
        try:
            cells = next(csv.reader([text], strict=True), [])
        except csv.Error as error:
            fault = Fault(f"line {line}", f"is not CSV: {error}", shown_value(text))
            raise BadFile(fault) from error
        if any(cell.strip() for cell in cells):
            found.append((line, cells))
    if not found:
        raise BadFile(Fault(path.name, "is empty: a header with id, ra_deg, dec_deg, magnitude"))
    return found


def _header_faults(header: Sequence[str]) -> list[Fault]:
    known = ("id", *_ALL)
    faults = [
        Fault("header", f"column {name} is missing", ",".join(header))
        for name in ("id", *REQUIRED)
        if name not in header
    ]
    for place, name in enumerate(header, start=1):
        if name not in known:
            allowed = f"unknown; columns are {', '.join(known)}"
            faults.append(Fault(f"header, column {place}", allowed, shown_value(name)))
        elif name in header[: place - 1]:
            faults.append(Fault(f"header, column {place}", "is there twice", shown_value(name)))
    return faults[:FAULTS_SHOWN]


def _label_fault(label: str, seen: Mapping[str, int]) -> str | None:
    if not label:
        return "must not be empty"
    if len(label) > MAX_ID_LENGTH:
        return f"must not be longer than {MAX_ID_LENGTH} characters"
    if not label.isprintable():
        return "must hold printable characters only"
    if label in seen:
        return f"is already on line {seen[label]}"
    return None


def _number(text: str, rule: _NumberColumn, *, required: bool) -> float | str:
    """The number in a CSV cell, or a text that names its fault."""
    if not text and not required:
        return rule.absent
    try:
        value: float = int(text) if rule.whole else float(text)
    except ValueError:
        return "must be a whole number" if rule.whole else "must be a number"
    # The comparison is also false for NaN.
    if not rule.least <= value <= rule.most:
        return f"must be between {rule.least:g} and {rule.most:g}"
    return value


def _columns(
    labels: Sequence[str], values: Mapping[str, Sequence[float]]
) -> dict[str, npt.NDArray[Any]]:
    columns: dict[str, npt.NDArray[Any]] = {"label": np.array(labels)}
    for name, rule in _ALL.items():
        kind = np.int32 if rule.whole else np.float64
        column = values.get(name)
        columns[rule.column] = (
            np.full(len(labels), rule.absent, dtype=kind)
            if column is None
            else np.array(column, dtype=kind)
        )
    columns["ra_deg"] = np.where(columns["ra_deg"] == 360.0, 0.0, columns["ra_deg"])
    columns["components"] = np.ones(len(labels), dtype=np.uint8)
    columns["light_elsewhere"] = np.zeros(len(labels), dtype=np.bool_)
    columns["tyc"] = np.zeros((len(labels), 3), dtype=np.uint16)
    return columns
