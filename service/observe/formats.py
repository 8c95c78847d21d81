"""Telemetry files as numbered lines, each holding one batch as JSON.

Two forms are read, both in bounded memory: NDJSON, one batch a line, and CSV,
one star a row (`service.observe.csv_rows`).  A line that cannot be read is
handed on with its fault, and the next lines follow: what to make of it is the
caller's choice.  A file that makes no sense as a whole raises `BadFile`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Literal

from service.errors import BadFile, Fault
from service.observe.csv_rows import batches_of_rows
from service.observe.lines import Line, physical_lines

Form = Literal["ndjson", "csv"]


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
            yield from batches_of_rows(physical_lines(stream))
        else:
            yield from physical_lines(stream)


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
