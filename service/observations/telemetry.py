"""Telemetry files as numbered lines, each holding one batch or one gyro block as JSON.

Two forms are read, both in bounded memory: NDJSON, one of them a line, and CSV, one star or
one gyro sample a row (`csv_table`, `csv_rows`).  A line that cannot be read is
handed on with its fault, and the next lines follow: what to make of it is the
caller's choice.  A file that makes no sense as a whole raises `BadFile`.
"""

import codecs
import io
import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Literal

from service.errors import BadFile, BadInput, Fault, shown_value
from service.observations import csv_rows
from service.observations.csv_table import SEPARATORS, CsvRow, CsvTable, RowKind
from service.observations.decompress import Line, physical_lines
from service.times import parse_utc

TelemetryFormat = Literal["ndjson", "csv"]
TelemetryForm = Literal["lines", "csv", "packets"]
"""The forms of an upload: NDJSON, CSV, or an archive of space packets."""

_LOOKED_AT_BYTES, _LOOKED_AT_LINES = 1 << 16, 20
_PACKED = {b"\x1f\x8b": ("gzip", "gunzip"), b"\x28\xb5\x2f\xfd": ("zstd", "unzstd")}
_SHOWN_BYTES = 40


def telemetry_format(path: Path) -> TelemetryFormat:
    """The form of a file by its name: `.csv` and `.tsv` are CSV, all else NDJSON."""
    return "csv" if path.suffix.lower() in (".csv", ".tsv") else "ndjson"


def read_lines(source: Path | BinaryIO, form: TelemetryFormat | None = None) -> Iterator[Line]:
    """The batches and gyro blocks of a file or of a binary stream, in order.

    The form is told by the file's name where it is not given; a stream without
    one is NDJSON, and one with CSV is seekable.  Raises `BadFile` for a file that cannot be
    opened, and for a CSV file that `CsvTable` refuses, before the first of them.
    """
    form = form or (telemetry_format(source) if isinstance(source, Path) else "ndjson")
    with _opened(source, form) as stream:
        if form == "csv":
            table = CsvTable(stream, (csv_rows.BATCH_ROWS, GYRO_ROWS))
            kind = BlockRows if table.kind is GYRO_ROWS else csv_rows.BatchRows
            yield from csv_rows.joined_lines(table.rows(), kind)
        else:
            yield from physical_lines(stream)


def require_telemetry(
    path: Path, form: TelemetryFormat | None = None, field: str | None = None
) -> None:
    """Raise `BadFile` for a file that cannot be opened or that is no telemetry at all.

    That is told by its first bytes.  Single bad lines are no matter of this.  Faults name the
    path, or `field` in its place.
    """
    form, field = form or telemetry_format(path), field or str(path)
    with _opened(path, form) as stream:
        start = stream.read(_LOOKED_AT_BYTES).removeprefix(codecs.BOM_UTF8)
    message = _not_telemetry(start, form)
    if message is not None:
        shown = shown_value(start[:_SHOWN_BYTES]) if start.strip() else None
        raise BadFile(Fault(field, message, shown))
    if form == "csv":
        try:
            next(read_lines(path, form), None)
        except BadFile as error:
            raise BadFile(
                Fault(f"{field}: {each.field}", each.message, each.value) for each in error.faults
            ) from None


def _not_telemetry(start: bytes, form: TelemetryFormat) -> str | None:
    """The kind of a file that is no telemetry, by its beginning; None for telemetry."""
    lines = [line.strip() for line in start.split(b"\n") if line.strip()][:_LOOKED_AT_LINES]
    if not lines:
        # Of a longer file more may follow.
        return None if len(start) == _LOOKED_AT_BYTES else "is empty: there is no batch in it"
    for magic, (name, unpack) in _PACKED.items():
        if start.startswith(magic):
            return f"is packed with {name}: unpack it first ({unpack})"
    is_object = lines[0].startswith(b"{")
    if not is_object and b"\0" in start:
        return "is a binary file; telemetry is NDJSON, one batch a line, or CSV"
    if form == "csv":
        return "is no CSV but looks like NDJSON: name it .ndjson" if is_object else None
    if lines[0] == b"{" or lines[0].startswith(b"["):
        return "is JSON, but not NDJSON, which has one batch a line and nothing around them"
    if any(line.startswith(b"{") for line in lines):
        return None
    names = re.split('[{}"]+'.format("".join(SEPARATORS)), lines[0].decode("utf-8", "replace"))
    if len({name.strip().lower() for name in names} & {*csv_rows.COLUMNS, *GYRO_ROWS.columns}) > 1:
        return "is no NDJSON but looks like CSV: name it .csv"
    return "is no NDJSON, which has one batch a line as a JSON object"


@contextmanager
def _opened(source: Path | BinaryIO, form: TelemetryFormat) -> Iterator[BinaryIO]:
    """The file as UTF-8 with line feeds; one that has others is copied to a temporary file."""
    if not isinstance(source, Path):
        yield source
        return
    try:
        stream = source.open("rb")
    except OSError as error:
        reason = error.strerror or str(error)
        raise BadFile(Fault(str(source), f"cannot be opened: {reason}")) from None
    with stream:
        if not stream.seekable():
            yield stream
            return
        start = stream.read(_LOOKED_AT_BYTES)
        stream.seek(0)
        is_utf16 = start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        if not is_utf16 and not (form == "csv" and b"\r" in start and b"\n" not in start):
            yield stream
            return
        with tempfile.TemporaryFile() as copy:
            # Without `newline` every kind of line end becomes a line feed.
            text = io.TextIOWrapper(stream, "utf-16" if is_utf16 else "utf-8", "surrogateescape")
            try:
                while piece := text.read(_LOOKED_AT_BYTES):
                    copy.write(piece.encode("utf-8", "surrogateescape"))
            except UnicodeError as error:
                raise BadFile(Fault(str(source), f"is damaged UTF-16: {error}")) from None
            copy.seek(0)
            yield copy


# Gyro blocks as rows of comma-separated values, one sample a row.
#
# The rows of one (spacecraft, run, block) form a block; `CsvTable` gives them together.  What the
# rows give is the same JSON as that of an NDJSON file, so that the same checks hold for it.

KEY = ("spacecraft", "run", "block")
RATES = ("rate_1_rad_per_s", "rate_2_rad_per_s", "rate_3_rad_per_s")
REQUIRED = ("spacecraft", "block", "time", *RATES)
GYRO_COLUMNS = (*KEY, "time", *RATES)
MAX_ROWS = 10_000


class BlockRows(csv_rows.JoinedRows):
    """The rows of one gyro block, a sample a row."""

    key_columns = KEY
    may_lack = "the block may lack a sample"
    refuses_faulty_rows = False

    def __init__(self, number: int, key: tuple[str, ...]) -> None:
        super().__init__(number, key)
        self.start, self.start_ns = "", 0
        self.times_s: list[float] = []
        self.rates: list[list[float]] = []
        self._taken: set[tuple[float, ...]] = set()

    def take(self, row: CsvRow) -> None:
        """Take the cells of a row; raises `BadCell`."""
        if len(self.rates) == MAX_ROWS:
            raise csv_rows.BadCell("block", f"has more than {MAX_ROWS} rows", self.key[-1])
        try:
            time = parse_utc(row["time"])
        except BadInput as error:
            raise csv_rows.BadCell("time", error.faults[0].message, row["time"]) from None
        if not self.rates:
            self.start, self.start_ns = time.text, time.tai_ns
        time_s = (time.tai_ns - self.start_ns) * 1e-9
        rates = [csv_rows.number_cell(row, column) for column in RATES]
        if (row_of := (time_s, *rates)) in self._taken:
            # The row was written twice, or the file to its own end.
            return
        self._taken.add(row_of)
        self.times_s.append(time_s)
        self.rates.append(rates)

    def body(self) -> Mapping[str, Any]:
        """The JSON object of the block."""
        named = {name: value for name, value in zip(KEY, self.key, strict=True) if value}
        times = {"start": self.start, "times_s": self.times_s}
        return {**named, **times, "rates_rad_per_s": self.rates}


def _check_header(names: list[str], where: str) -> None:
    """Raise `BadFile` for a column that is unknown, missing or there twice."""
    there_are = f"there is no such column; there are {', '.join(GYRO_COLUMNS)}"
    faults = [
        Fault(f"{where}, column {name or '(empty)'}", there_are)
        for name in names
        if name not in GYRO_COLUMNS
    ]
    faults += [
        Fault(f"{where}, column {name}", "occurs twice")
        for name in sorted({name for name in names if names.count(name) > 1})
    ]
    faults += [
        Fault(f"{where}, column {name}", "is missing") for name in REQUIRED if name not in names
    ]
    if faults:
        raise BadFile(faults)


GYRO_ROWS = RowKind(
    "block",
    KEY,
    GYRO_COLUMNS,
    texts=frozenset((*KEY, "time")),
    verbatim=frozenset(),
    check_header=_check_header,
    ordered_by_time=True,
)
