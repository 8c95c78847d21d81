"""Telemetry files as numbered lines, each holding one batch as JSON.

Two forms are read, both in bounded memory: NDJSON, one batch a line, and CSV,
one star a row (`service.observe.csv_rows`).  A line that cannot be read is
handed on with its fault, and the next lines follow: what to make of it is the
caller's choice.  A file that makes no sense as a whole raises `BadFile`.
"""

import codecs
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

from service.errors import BadFile, Fault

MAX_LINE_BYTES = 1 << 20

Form = Literal["ndjson", "csv"]


@dataclass(frozen=True)
class Line:
    """A batch as JSON, or the fault that stands in its place.

    `number` counts lines from one; a batch of a CSV file has that of its first
    row, a fault that of the line where it lies.
    """

    number: int
    body: bytes | None
    fault: Fault | None = None


def form_of(path: Path) -> Form:
    """The form of a file by its name: `.csv` is CSV, all else NDJSON."""
    return "csv" if path.suffix.lower() == ".csv" else "ndjson"


def read_lines(source: Path | BinaryIO, form: Form | None = None) -> Iterator[Line]:
    """The batches of a file or of a binary stream, in order.

    The form is told by the file's name where it is not given; a stream without
    one is NDJSON.  Raises `BadFile` for a file that cannot be opened and for a
    CSV header with unknown or missing columns.
    """
    with _opened(source) as stream:
        if (form or (form_of(source) if isinstance(source, Path) else "ndjson")) == "csv":
            # Only files of that form need the reader, and it needs this module.
            from service.observe.csv_rows import batches_of_rows

            yield from batches_of_rows(physical_lines(stream))
        else:
            yield from physical_lines(stream)


def physical_lines(stream: BinaryIO) -> Iterator[Line]:
    """The lines of a stream without their ends; blank ones are counted and left out.

    A line beyond `MAX_LINE_BYTES` is passed over without being held.
    """
    number = 0
    while raw := stream.readline(MAX_LINE_BYTES + 1):
        number += 1
        if number == 1:
            raw = raw.removeprefix(codecs.BOM_UTF8)
        if len(raw) > MAX_LINE_BYTES and not raw.endswith(b"\n"):
            length = len(raw)
            while raw and not raw.endswith(b"\n"):
                raw = stream.readline(MAX_LINE_BYTES)
                length += len(raw)
            message = f"is longer than {MAX_LINE_BYTES} bytes"
            yield Line(number, None, Fault(f"line {number}", message, f"{length} bytes"))
        elif raw.strip():
            yield Line(number, raw.rstrip(b"\r\n"))


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
