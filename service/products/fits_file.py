"""Tables as a FITS binary table (FITS standard 4.0).

Numbers that are not known are NaN, integers the value of TNULL; the column VALID says of each
row whether all its values are known.  The column `time`, UTC as text, is named UTC.  A table
with `tai_ns` gets a column TIME: seconds of Terrestrial Time since the beginning of the day
(TT) of its first row, MJDREFI and MJDREFF.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from service.products.spool import pieces, spool
from service.products.tables import Column, Page, Table
from service.times import DAY_S

BLOCK = 2880
NULL = -(2**63)
_TT_LESS_TAI_NS = 32_184_000_000
_DAY_NS = DAY_S * 10**9
_J2000_MJD = 51_544
_FORMATS = {"number": ("D", ">f8"), "integer": ("K", ">i8"), "flag": ("L", "S1")}
_NAMES = {"time": "UTC"}
"""Names of columns that FITS, which does not tell capitals apart, has another use for."""
_UNITS = {"ppm": "10**-6", "1": "", "1/h": "h**-1"}
"""Units that FITS does not know by their name."""
_TIME = Column("TIME", unit="s", description="Terrestrial Time since MJDREFI + MJDREFF.")
_VALID = Column("VALID", "flag", description="Whether every value of the row is known.")


def write_fits(table: Table) -> Iterator[bytes]:
    """Write a table, which is kept in a temporary file until its number of rows is known."""
    has_time = "tai_ns" in table.names
    columns = [*([_TIME] if has_time else []), *table.columns, _VALID]
    dtype = np.dtype([(each.name, _format_of(each)[1]) for each in columns])
    count, day = 0, None
    with spool() as file:
        for page in table.pages:
            rows = _rows(table.columns, page, dtype)
            if has_time and len(rows):
                since_noon_ns = rows["tai_ns"].astype(np.int64) + _TT_LESS_TAI_NS + _DAY_NS // 2
                day = int(since_noon_ns[0] // _DAY_NS) if day is None else day
                rows["TIME"] = (since_noon_ns - day * _DAY_NS) * 1e-9
            file.write(rows.tobytes())
            count += len(rows)
        yield _headers(table, columns, count, _J2000_MJD + (day or 0) if has_time else None)
        yield from pieces(file)
    yield bytes(-count * dtype.itemsize % BLOCK)


def _format_of(column: Column) -> tuple[str, str]:
    """The format of a column in FITS, and in numpy."""
    if column.kind in ("text", "utc"):
        return f"{column.width}A", f"S{column.width}"
    return _FORMATS[column.kind]


def _rows(columns: Sequence[Column], page: Page, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    rows = np.zeros(len(page[0]), dtype)
    is_known = np.ones(len(rows), dtype=bool)
    for column, values in zip(columns, page, strict=True):
        known = np.array([value is not None for value in values], dtype=bool)
        is_known &= known
        if column.kind == "integer":
            rows[column.name] = [NULL if value is None else value for value in values]
        elif column.kind == "flag":
            rows[column.name] = [b"T" if value else b"F" for value in values]
        elif column.kind in ("text", "utc"):
            rows[column.name] = [_ascii(value) for value in values]
        else:
            rows[column.name] = np.array(values, dtype=np.float64)
    rows[_VALID.name] = np.where(is_known, b"T", b"F")
    return rows


def _ascii(value: object) -> bytes:
    return b"" if value is None else str(value).encode("ascii", "replace")


def _headers(table: Table, columns: Sequence[Column], count: int, mjd: int | None) -> bytes:
    from astropy.io import fits

    first = fits.PrimaryHDU().header
    first["EXTEND"] = True
    for name, text in table.about.items():
        first["COMMENT"] = f"{name}: {_ascii(text).decode()}"
    described = [
        fits.Column(
            _NAMES.get(each.name, each.name),
            _format_of(each)[0],
            unit=_UNITS.get(each.unit, each.unit) or None,
            null=NULL if each.kind == "integer" else None,
        )
        for each in columns
    ]
    header = fits.BinTableHDU.from_columns(described, nrows=0).header
    header["NAXIS2"] = count
    header["EXTNAME"] = table.about.get("product", "table").upper()
    for number, each in enumerate(columns, 1):
        header[f"TCOMM{number}"] = ". ".join(
            part.rstrip(".") for part in (each.description, each.frame) if part
        )
    if mjd is not None:
        header["TIMESYS"] = ("TT", "time scale of TIME")
        header["MJDREFI"] = (mjd, "[d] epoch of TIME, whole days")
        header["MJDREFF"] = (0.0, "[d] epoch of TIME, the rest")
        header["TIMEUNIT"] = "s"
    written: str = first.tostring() + header.tostring()
    return written.encode("ascii")
