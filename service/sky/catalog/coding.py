"""The columns of a star catalog, and their encoding in a catalog file.

A catalog file is a zip of numpy arrays (.npz), one per column. An integer array is a coded column:
its value times the column's step, with one code kept for "unknown". A floating-point array is
stored unchanged, so that a site's own catalog keeps its numbers to the last digit.
"""

import hashlib
import io
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from service.errors import BadFile, Fault

Column = npt.NDArray[Any]

# The earliest date of a zip entry: fixed, so that a rebuild gives the same bytes.
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class ColumnCoding:
    """Coding of one catalog column: value = integer times step; step None for a plain column."""

    meaning: str
    unit: str
    dtype: str
    step: float | None = None
    unknown: int | None = None

    def encode(self, values: Column) -> Column:
        """Column values as integers of the coding's type; NaN becomes the unknown code."""
        if self.step is None:
            return values.astype(self.dtype)
        nothing = np.isnan(values)
        if self.unknown is None and nothing.any():
            raise ValueError(f"{self.meaning}: a value is missing")
        coded = np.rint(np.where(nothing, 0.0, values) / self.step)
        limits = np.iinfo(self.dtype)
        if coded.size and (coded.min() < limits.min or coded.max() > limits.max):
            raise ValueError(f"{self.meaning}: a value does not fit {self.dtype}")
        return np.where(nothing, self.unknown or 0, coded).astype(self.dtype)

    def decode(self, stored: Column) -> Column:
        """Column values from stored integers, within the step; floating-point ones unchanged."""
        if self.step is None:
            return stored.astype(self.dtype)
        if stored.dtype.kind == "f":
            return stored.astype(np.float64)
        # Division by the whole number 1/step gives 4.57 where 457 * 0.01 gives 4.570000000000001.
        values = stored / round(1.0 / self.step) if self.step < 1.0 else stored * self.step
        if self.unknown is not None:
            values[stored == self.unknown] = np.nan
        return np.asarray(values, dtype=np.float64)


_MAS_DEG = 1.0 / 3_600_000.0

COLUMNS: Mapping[str, ColumnCoding] = {
    "ra_deg": ColumnCoding("right ascension", "deg", "int32", _MAS_DEG),
    "dec_deg": ColumnCoding("declination", "deg", "int32", _MAS_DEG),
    "pm_ra_mas_per_year": ColumnCoding(
        "proper motion in right ascension, times cos(declination)", "mas/year", "int32", 0.01
    ),
    "pm_dec_mas_per_year": ColumnCoding("proper motion in declination", "mas/year", "int32", 0.01),
    "parallax_mas": ColumnCoding("parallax", "mas", "int32", 0.01, -(2**31)),
    "magnitude_v_mag": ColumnCoding("V", "mag", "int16", 0.01),
    "color_bv_mag": ColumnCoding("B-V", "mag", "int16", 0.001, -(2**15)),
    "neighbour_arcsec": ColumnCoding(
        "distance of the nearest neighbour", "arcsec", "uint16", 0.1, 2**16 - 1
    ),
    "neighbour_fainter_by_mag": ColumnCoding(
        "that neighbour's V minus the star's", "mag", "int16", 0.01, -(2**15)
    ),
    "rival_arcsec": ColumnCoding(
        "distance of the nearest neighbour not more than 2 mag fainter",
        "arcsec",
        "uint16",
        0.1,
        2**16 - 1,
    ),
    "rival_fainter_by_mag": ColumnCoding(
        "that neighbour's V minus the star's", "mag", "int16", 0.01, -(2**15)
    ),
    "variability_mag": ColumnCoding("amplitude of variability", "mag", "uint16", 0.01, 2**16 - 1),
    "position_sigma_arcsec": ColumnCoding(
        "standard deviation of the position per axis", "arcsec", "uint16", 0.01, 2**16 - 1
    ),
    "components": ColumnCoding("components that Tycho-2 resolves within the star", "", "uint8"),
    "light_elsewhere": ColumnCoding(
        "true: the star's light is counted in a neighbour's magnitude already", "", "bool"
    ),
    "hip": ColumnCoding("Hipparcos number, 0 where there is none", "", "int32"),
    "tyc": ColumnCoding("Tycho identifier as three numbers, 0 where there is none", "", "uint16"),
    "hd": ColumnCoding("Henry Draper number, 0 where there is none", "", "int32"),
    "sao": ColumnCoding("SAO number, 0 where there is none", "", "int32"),
}

ALWAYS_KNOWN = (
    "ra_deg",
    "dec_deg",
    "pm_ra_mas_per_year",
    "pm_dec_mas_per_year",
    "magnitude_v_mag",
)

LABEL = "label"
"""The name of an optional column with the identifiers of a site's own catalog, as text."""


def file_digest(data: bytes) -> str:
    """The SHA-256 digest of a file's bytes as text, with the prefix "sha256:"."""
    return "sha256:" + hashlib.sha256(data).hexdigest()


MAX_UNPACKED_BYTES = 1 << 30
"""Largest decompressed size of a catalog, about eight million stars."""


def pack(columns: Mapping[str, Column]) -> bytes:
    """A catalog file as bytes; the same columns always give the same bytes."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, column in columns.items():
            one = io.BytesIO()
            np.lib.format.write_array(one, np.ascontiguousarray(column), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", _ZIP_TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, one.getvalue(), compresslevel=9)
    return out.getvalue()


def _require_what_is_claimed(data: bytes) -> None:
    """Raise `ValueError` for columns that claim to be larger than their stored data.

    numpy's reader allocates the claimed size of a column before it reads any data.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
        if sum(entry.file_size for entry in entries) > MAX_UNPACKED_BYTES:
            raise ValueError(f"holds more than {MAX_UNPACKED_BYTES} bytes")
        for entry in entries:
            with archive.open(entry) as column:
                version = np.lib.format.read_magic(column)
                header = (
                    np.lib.format.read_array_header_1_0
                    if version == (1, 0)
                    else np.lib.format.read_array_header_2_0
                )
                shape, _, kind = header(column)
            if math.prod(shape) * kind.itemsize > entry.file_size:
                raise ValueError(f"{entry.filename} claims a shape of {shape}")


def unpack(data: bytes, path: Path) -> dict[str, Column]:
    """The decoded columns of a catalog file's bytes; `path` is for error messages.

    Raises BadFile naming a column that is missing or of a wrong length or type.
    """
    try:
        _require_what_is_claimed(data)
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            stored = {name: archive[name] for name in archive.files}
    except Exception as error:
        # The readers fail on damaged files in many ways, with many kinds of exceptions.
        raise BadFile(Fault(str(path), f"not a star catalog file: {error!r}")) from error
    missing = [name for name in COLUMNS if name not in stored]
    if missing:
        raise BadFile(Fault(str(path), f"columns missing: {', '.join(missing)}"))
    rows = len(stored["ra_deg"]) if stored["ra_deg"].ndim else 0
    faults = []
    columns = {}
    for name in (*COLUMNS, *([LABEL] if LABEL in stored else [])):
        shape = (rows, 3) if name == "tyc" else (rows,)
        kinds = "U" if name == LABEL else "iufb"
        if stored[name].shape != shape or stored[name].dtype.kind not in kinds:
            shown = f"{stored[name].dtype} {stored[name].shape}"
            faults.append(Fault(f"{path}, column {name}", f"must hold {shape} numbers", shown))
        else:
            columns[name] = stored[name] if name == LABEL else COLUMNS[name].decode(stored[name])
    if not faults and rows == 0:
        faults = [Fault(str(path), "holds no star")]
    if not faults:
        faults = [
            Fault(f"{path}, column {name}", "must hold finite numbers only")
            for name in ALWAYS_KNOWN
            if not np.isfinite(columns[name]).all()
        ]
    if not faults and np.any(np.diff(columns["magnitude_v_mag"]) < 0.0):
        faults = [Fault(f"{path}, column magnitude_v_mag", "must be sorted, brightest first")]
    if faults:
        raise BadFile(faults)
    return columns
