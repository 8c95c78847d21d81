"""Reader of SKYMAP's SKY2000 Master Catalog, fixed-width records (CDS V/109, sky2kv4.dat).

A table defines the bytes of each field, after the byte-by-byte description that comes with the
catalog (Myers and others 2002). A file with any faulty record is refused with every fault named.
The Skymap number is the star's id.
"""

import gzip
import math
import re
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from service.errors import BadFile, Fault, shown_value
from service.sky.catalog.csv_file import FAULTS_SHOWN

DESIGNATION = b"SKY2000"
RECORD_BYTES = 520
LEAST_BYTES = 243
"""Least length of a record: it may end after its magnitudes if trailing blanks were removed."""
MAX_STARS = 8_000_000
GZIP = b"\x1f\x8b"

_WHOLE = re.compile(r"[+-]?\d+")
_DECIMAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)")


@dataclass(frozen=True)
class RecordField:
    """Numeric field of a catalog record: bytes `first` to `last`, from 1, within bounds, or blank.

    `label` is that of the catalog's description. A field with `must` may not be blank.
    """

    label: str
    first: int
    last: int
    least: float
    most: float
    whole: bool = False
    must: bool = False

    def read(self, record: str) -> float | None:
        """The number in a record's field, None if blank; raises `ValueError` with the fault."""
        # Signs are in the first byte of a field, while the digits may be right-aligned.
        text = record[self.first - 1 : self.last].strip()
        text = re.sub(r"^([+-])\s+", r"\1", text)
        if not text:
            if self.must:
                raise ValueError("must not be blank")
            return None
        if not (_WHOLE if self.whole else _DECIMAL).fullmatch(text):
            raise ValueError("must be a whole number" if self.whole else "must be a number")
        value = float(text)
        if not self.least <= value <= self.most:
            raise ValueError(f"must be between {self.least:g} and {self.most:g}")
        return value


MAX_NUMBER = 99_999_999
FIELDS: Mapping[str, RecordField] = {
    field.label: field
    for field in (
        RecordField("ID", 28, 35, 1, MAX_NUMBER, whole=True, must=True),
        RecordField("HD", 36, 41, 1, 999_999, whole=True),
        RecordField("SAO", 44, 49, 1, 999_999, whole=True),
        RecordField("RAh", 119, 120, 0, 23, whole=True, must=True),
        RecordField("RAm", 121, 122, 0, 59, whole=True, must=True),
        # The catalog has sixty seconds, from rounding.
        RecordField("RAs", 123, 129, 0.0, 60.0, must=True),
        RecordField("DEd", 131, 132, 0, 90, whole=True, must=True),
        RecordField("DEm", 133, 134, 0, 59, whole=True, must=True),
        RecordField("DEs", 135, 140, 0.0, 60.0, must=True),
        RecordField("e_pos", 141, 146, 0.0, 3600.0),
        RecordField("pmRA", 150, 157, -10.0, 10.0),
        RecordField("pmDE", 158, 165, -100.0, 100.0),
        RecordField("Plx", 176, 183, -10.0, 10.0),
        RecordField("Vmag", 233, 238, -5.0, 30.0),
        RecordField("Vder", 239, 243, -5.0, 30.0),
        RecordField("Bmag", 253, 258, -5.0, 30.0),
        RecordField("B-V", 259, 264, -5.0, 10.0),
        RecordField("ID_A", 388, 395, 0, MAX_NUMBER, whole=True),
        RecordField("ID_B", 396, 403, 0, MAX_NUMBER, whole=True),
        RecordField("ID_C", 404, 411, 0, MAX_NUMBER, whole=True),
        RecordField("varAmp", 422, 426, 0.0, 30.0),
    )
}
DECLINATION_SIGN, BLENDED_V = 130, 249
"""Positions in a SKY2000 record of two flags: the declination's sign, and `b` for blended light."""

CatalogRecord = dict[str, float | None]


@dataclass(frozen=True)
class Read:
    """The columns read from a SKY2000 catalog, and the stars without a visual magnitude."""

    columns: dict[str, npt.NDArray[Any]]
    without_magnitude: tuple[str, ...]


def is_sky2000(path: Path) -> bool:
    """True if a file begins like a SKY2000 catalog, compressed or not."""
    try:
        with _opened(path) as file:
            return file.read(len(DESIGNATION)) == DESIGNATION
    except (OSError, EOFError, zlib.error):
        return False


def read_sky2000(path: Path, step: Callable[[], object] = lambda: None) -> Read:
    """The stars of a SKY2000 file as columns, in its order; `step` is called after each record.

    The magnitude is the observed V, or else the derived one; a star with neither is left out and
    listed. Components of a blended star with records of their own are marked as having their light
    elsewhere. Raises BadFile with up to FAULTS_SHOWN faults, each with line, bytes and value.
    """
    faults: list[Fault] = []
    stars: list[CatalogRecord] = []
    blended: list[bool] = []
    without: list[str] = []
    seen: dict[int, int] = {}
    for line, record in _records(path, faults):
        step()
        found = _values(line, record, faults)
        if len(faults) >= FAULTS_SHOWN:
            break
        if found is None:
            continue
        number = int(found["ID"] or 0)
        if number in seen:
            faults.append(_fault(line, FIELDS["ID"], f"is already on line {seen[number]}", record))
            continue
        seen[number] = line
        if found["V"] is None:
            without.append(f"SKYMAP {number}")
            continue
        if len(stars) == MAX_STARS:
            faults.append(Fault(f"line {line}", f"is beyond {MAX_STARS} stars"))
            break
        stars.append(found)
        blended.append(record[BLENDED_V - 1 : BLENDED_V] == "b")
    if faults:
        raise BadFile(faults[:FAULTS_SHOWN])
    if not stars:
        raise BadFile(Fault(path.name, "holds no star"))
    return Read(_columns(stars, blended), tuple(without))


# ---- lines -------------------------------------------------------------------------------------


def _opened(path: Path) -> BufferedIOBase:
    with path.open("rb") as file:
        compressed = file.read(2) == GZIP
    return gzip.open(path, "rb") if compressed else path.open("rb")


def _records(path: Path, faults: list[Fault]) -> Iterator[tuple[int, str]]:
    """Line numbers and texts of a SKY2000 file's well-formed records; faults go to a list."""
    line = 0
    try:
        with _opened(path) as file:
            # Never more than a record at a time, whatever a damaged file contains.
            while raw := file.readline(RECORD_BYTES + 3):
                line += 1
                text = raw.rstrip(b"\r\n")
                if not text.strip():
                    continue
                fault = _line_fault(raw, text)
                if fault is None:
                    yield line, text.decode("ascii").ljust(RECORD_BYTES)
                    continue
                faults.append(Fault(f"line {line}", fault, shown_value(text[:40])))
                if len(text) > RECORD_BYTES or len(faults) >= FAULTS_SHOWN:
                    return
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or error
        raise BadFile(Fault(str(path), f"cannot be read: {reason}")) from error


def _line_fault(raw: bytes, text: bytes) -> str | None:
    if len(text) > RECORD_BYTES:
        return f"must not be longer than {RECORD_BYTES} bytes"
    if len(text) < LEAST_BYTES:
        return f"must be {RECORD_BYTES} bytes long, or up to its magnitudes at least {LEAST_BYTES}"
    if len(text) < RECORD_BYTES and not raw.endswith(b"\n"):
        return "ends within a record, without a line end: the file was cut off"
    if not text.isascii() or not text.decode("ascii").isprintable():
        return "must hold printable ASCII characters only"
    if not text.startswith(DESIGNATION):
        return f"must begin with {DESIGNATION.decode()}"
    return None


def _fault(line: int, field: RecordField, message: str, record: str) -> Fault:
    where = f"line {line}, bytes {field.first}-{field.last} ({field.label})"
    return Fault(where, message, shown_value(record[field.first - 1 : field.last]))


def _values(line: int, record: str, faults: list[Fault]) -> CatalogRecord | None:
    """The numbers of a record with its position in degrees; None if any is faulty."""
    before = len(faults)
    found: CatalogRecord = {}
    for label, field in FIELDS.items():
        try:
            found[label] = field.read(record)
        except ValueError as error:
            faults.append(_fault(line, field, str(error), record))
    sign = record[DECLINATION_SIGN - 1]
    if sign not in "+- ":
        where = f"line {line}, byte {DECLINATION_SIGN} (DE-)"
        faults.append(Fault(where, "must be + or -", shown_value(sign)))
    if len(faults) > before:
        return None
    hours, degrees = (
        (found[f"{a}{b[0]}"] or 0.0)
        + (found[f"{a}m"] or 0.0) / 60.0
        + (found[f"{a}s"] or 0.0) / 3600.0
        for a, b in (("RA", "hms"), ("DE", "dms"))
    )
    found["ra_deg"] = 15.0 * hours % 360.0
    found["dec_deg"] = -degrees if sign == "-" else degrees
    if degrees > 90.0:
        faults.append(_fault(line, FIELDS["DEd"], "is beyond the pole with its minutes", record))
        return None
    found["V"] = found["Vmag"] if found["Vmag"] is not None else found["Vder"]
    return found


# ---- columns -----------------------------------------------------------------------------------


def _columns(stars: list[CatalogRecord], blended: list[bool]) -> dict[str, npt.NDArray[Any]]:
    count = len(stars)

    def column(label: str, absent: float = math.nan) -> npt.NDArray[np.float64]:
        return np.array([absent if (v := star[label]) is None else v for star in stars], float)

    number = column("ID").astype(np.int64)
    color = column("B-V")
    from_b = column("Bmag") - column("Vmag")
    dec_deg = column("dec_deg")
    return {
        "label": np.array([f"SKYMAP {each}" for each in number.tolist()]),
        "ra_deg": column("ra_deg"),
        "dec_deg": dec_deg,
        # Seconds of time per year at the star's declination, and seconds of arc.
        "pm_ra_mas_per_year": 15_000.0 * column("pmRA", 0.0) * np.cos(np.radians(dec_deg)),
        "pm_dec_mas_per_year": 1000.0 * column("pmDE", 0.0),
        "parallax_mas": 1000.0 * column("Plx"),
        "magnitude_v_mag": column("V"),
        "color_bv_mag": np.where(np.isnan(color), from_b, color),
        "variability_mag": column("varAmp"),
        "position_sigma_arcsec": column("e_pos"),
        "components": np.ones(count, np.uint8),
        "light_elsewhere": _elsewhere(stars, number, blended),
        "hip": np.zeros(count, np.int32),
        "tyc": np.zeros((count, 3), np.uint16),
        "hd": column("HD", 0.0).astype(np.int32),
        "sao": column("SAO", 0.0).astype(np.int32),
    }


def _elsewhere(
    stars: list[CatalogRecord], number: npt.NDArray[np.int64], blended: list[bool]
) -> npt.NDArray[np.bool_]:
    """True for stars whose light is in the blended magnitude of another: its fainter components."""
    row_of = {int(each): row for row, each in enumerate(number)}
    elsewhere = np.zeros(len(stars), np.bool_)
    for row, star in enumerate(stars):
        if not blended[row]:
            continue
        own = (star["V"], row)
        for label in ("ID_A", "ID_B", "ID_C"):
            other = row_of.get(int(star[label] or 0))
            # Of two records with the same blended light the first keeps the light.
            if other is not None and (stars[other]["V"], other) > own:
                elsewhere[other] = True
    return elsewhere
