"""Writers of tables in Parquet, and as a FITS binary table (FITS standard 4.0).

Next to each time as text is a column `timestamp` with the time as a number.  It has no leap
seconds: a leap second and the second after it have the same value.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from service.table_files.spool import pieces, spool
from service.table_files.table import Column, Page, Table
from service.times import DAY_S, TT_LESS_TAI_S

ROWS_IN_GROUP = 1 << 14
"""Number of rows in a Parquet row group, held in memory until written."""


def write_parquet(table: Table) -> Iterator[bytes]:
    """Write a table as Parquet, with its description in the file's metadata."""
    import pyarrow as pa
    from pyarrow import parquet

    text = pa.string()
    types = {"number": pa.float64(), "integer": pa.int64(), "flag": pa.bool_()}
    fields = [
        pa.field(c.name, types.get(c.kind, text), metadata=_described(c)) for c in table.columns
    ]
    times = [place for place, c in enumerate(table.columns) if c.kind == "utc"]
    about = {"description": "The same without leap seconds: POSIX time."}
    fields += [pa.field("timestamp", pa.timestamp("ns", "UTC"), metadata=about) for _ in times]
    schema = pa.schema(fields, metadata=dict(table.about))
    sink = _Sink()
    # Numbers are seldom the same: dictionaries of them take memory and time, and save nothing.
    texts = [c.name for c in table.columns if c.kind in ("text", "utc")]
    with parquet.ParquetWriter(sink, schema, use_dictionary=texts or False) as writer:
        group: list[Any] = []
        for page in table.pages:
            pairs = zip([*page, *(_stamps(page[k]) for k in times)], schema, strict=True)
            arrays = [pa.array(values, field.type) for values, field in pairs]
            group.append(pa.record_batch(arrays, schema=schema))
            if sum(map(len, group)) >= ROWS_IN_GROUP:
                writer.write_table(pa.Table.from_batches(group))
                group = []
                yield sink.taken()
        writer.write_table(pa.Table.from_batches(group, schema))
    yield sink.taken()


def _stamps(texts: Sequence[str]) -> npt.NDArray[np.datetime64]:
    """Convert UTC texts to POSIX times; a leap second becomes the second after it."""
    shown = np.array([text.rstrip("Z").replace(":60", ":59") for text in texts], "datetime64[ns]")
    shown[[text[16:19] == ":60" for text in texts]] += np.timedelta64(1, "s")
    return shown


def _described(column: Column) -> dict[str, str]:
    texts = {"unit": column.unit, "frame": column.frame, "description": column.description}
    return {name: text for name, text in texts.items() if text}


class _Sink:
    """Output file whose content is handed on as it is written."""

    closed = False

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._size = 0

    def write(self, data: Any) -> int:
        """Buffer a piece written by pyarrow."""
        self._pieces.append(bytes(data))
        self._size += len(self._pieces[-1])
        return len(self._pieces[-1])

    def taken(self) -> bytes:
        """The bytes that pyarrow wrote since the last call."""
        text = b"".join(self._pieces)
        self._pieces.clear()
        return text

    def tell(self) -> int:
        """Total number of bytes written."""
        return self._size

    def flush(self) -> None:
        """Do nothing: this file holds no data back."""

    def close(self) -> None:
        """Do nothing: this file holds no resource."""


# Tables as a FITS binary table (FITS standard 4.0).
#
# Numbers that are not known are NaN, integers the value of TNULL; the column VALID says of each
# row whether all its values are known.  The column `time`, UTC as text, is named UTC.  A table
# with `tai_ns` gets a column TIME: seconds of Terrestrial Time since the beginning of the day
# (TT) of its first row, MJDREFI and MJDREFF.

BLOCK = 2880
NULL = -(2**63)
_TT_LESS_TAI_NS = round(TT_LESS_TAI_S * 1e9)
_DAY_NS = DAY_S * 10**9
_J2000_MJD = 51_544
_FORMATS = {"number": ("D", ">f8"), "integer": ("K", ">i8"), "flag": ("L", "S1")}
_NAMES = {"time": "UTC"}
"""New names of columns in FITS, which ignores case and reserves the old ones."""
_UNITS = {"ppm": "10**-6", "1": "", "1/h": "h**-1"}
"""FITS notation of units that FITS does not know by name."""
_TIME = Column("TIME", unit="s", description="Terrestrial Time since MJDREFI + MJDREFF.")
_VALID = Column("VALID", "flag", description="Whether every value of the row is known.")


def write_fits(table: Table) -> Iterator[bytes]:
    """Write a table as FITS; rows are kept in a temporary file until their number is known."""
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
    """Format codes of a column in FITS and numpy."""
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
