"""Telemetry files as numbered lines, each holding one batch or one gyro block as JSON.

Two forms are read, both in bounded memory: NDJSON, one of them a line, and CSV, one star or
one gyro sample a row (`csv_rows`, `gyro_rows`).  A line that cannot be read is
handed on with its fault, and the next lines follow: what to make of it is the
caller's choice.  A file that makes no sense as a whole raises `BadFile`.
"""

import codecs
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import BinaryIO, Literal

from service.errors import BadFile, Fault, shown_value
from service.observations.readers.csv_columns import COLUMNS
from service.observations.readers.csv_rows import batches_of_rows
from service.observations.readers.gyro_rows import blocks_of_rows, is_gyro_header
from service.observations.readers.lines import Line, physical_lines

TelemetryFormat = Literal["ndjson", "csv"]

_LOOKED_AT_BYTES, _LOOKED_AT_LINES = 1 << 16, 20
_PACKED = {b"\x1f\x8b": ("gzip", "gunzip"), b"\x28\xb5\x2f\xfd": ("zstd", "unzstd")}
_SHOWN_BYTES = 40


def telemetry_format(path: Path) -> TelemetryFormat:
    """The form of a file by its name: `.csv` is CSV, all else NDJSON."""
    return "csv" if path.suffix.lower() == ".csv" else "ndjson"


def read_lines(source: Path | BinaryIO, form: TelemetryFormat | None = None) -> Iterator[Line]:
    """The batches and gyro blocks of a file or of a binary stream, in order.

    The form is told by the file's name where it is not given; a stream without
    one is NDJSON.  Raises `BadFile` for a file that cannot be opened and for a
    CSV header with unknown or missing columns.
    """
    with _opened(source) as stream:
        if (form or (telemetry_format(source) if isinstance(source, Path) else "ndjson")) == "csv":
            lines = physical_lines(stream)
            first = next(lines, None)
            every = lines if first is None else chain([first], lines)
            yield from blocks_of_rows(every) if is_gyro_header(first) else batches_of_rows(every)
        else:
            yield from physical_lines(stream)


def require_telemetry(path: Path) -> None:
    """Raise `BadFile` for a file that cannot be opened or that is no telemetry at all.

    That is told by its first bytes.  Single bad lines are no matter of this.
    """
    with _opened(path) as stream:
        start = stream.read(_LOOKED_AT_BYTES).removeprefix(codecs.BOM_UTF8)
    form = telemetry_format(path)
    message = _not_telemetry(start, form)
    if message is not None:
        shown = shown_value(start[:_SHOWN_BYTES]) if start.strip() else None
        raise BadFile(Fault(str(path), message, shown))
    if form == "csv":
        try:
            next(read_lines(path), None)
        except BadFile as error:
            raise BadFile(
                Fault(f"{path}: {each.field}", each.message, each.value) for each in error.faults
            ) from None


def _not_telemetry(start: bytes, form: TelemetryFormat) -> str | None:
    """What a file is instead of telemetry, by its beginning; None for telemetry."""
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
    if len(set(lines[0].decode("utf-8", "replace").split(",")) & set(COLUMNS)) > 1:
        return "is no NDJSON but looks like CSV: name it .csv"
    return "is no NDJSON, which has one batch a line as a JSON object"


@contextmanager
def _opened(source: Path | BinaryIO) -> Iterator[BinaryIO]:
    if not isinstance(source, Path):
        yield source
        return
    try:
        stream = source.open("rb")
    except OSError as error:
        reason = error.strerror or str(error)
        raise BadFile(Fault(str(source), f"cannot be opened: {reason}")) from None
    with stream:
        yield stream
