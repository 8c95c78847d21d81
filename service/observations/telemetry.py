"""Reader of telemetry files as numbered lines, each with one batch or gyro block as JSON.

The formats of `input_formats` are read in bounded memory. A line that cannot be read is yielded
with its fault, and the next lines follow. A file that is no telemetry at all raises `BadFile`.
"""

import codecs
import io
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from service.errors import BadFile, Fault, shown_value
from service.observations.decompress import Line
from service.observations.input_formats import NDJSON, telemetry_format, telemetry_formats

_LOOKED_AT_BYTES = 1 << 16
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_PACKED = {b"\x1f\x8b": ("gzip", "gunzip"), b"\x28\xb5\x2f\xfd": ("zstd", "unzstd")}


def read_lines(source: Path | BinaryIO, form: str | None = None) -> Iterator[Line]:
    """The batches and gyro blocks in a telemetry file or binary stream, in order.

    The default format is that of the file's name, and NDJSON for a stream; a CSV stream must be
    seekable. Raises `BadFile`, before the first line, for a file that cannot be opened and for a
    CSV file that `CsvTable` refuses.
    """
    form = form or (telemetry_format(source) if isinstance(source, Path) else NDJSON)
    read = telemetry_formats()[form].read
    assert read is not None
    with _opened(source, form) as stream:
        yield from read(stream)


def require_telemetry(path: Path, form: str | None = None, field: str | None = None) -> None:
    """Raise `BadFile` for a file that cannot be opened or that is no telemetry.

    Only the first bytes are looked at, so that single bad lines do not matter. Faults name the
    path, or `field` instead.
    """
    form, field = form or telemetry_format(path), field or str(path)
    with _opened(path, form) as stream:
        start = stream.read(_LOOKED_AT_BYTES).removeprefix(codecs.BOM_UTF8)
    message = _not_telemetry(start, form)
    if message is not None:
        shown = shown_value(start[:40]) if start.strip() else None
        raise BadFile(Fault(field, message, shown))
    if form != NDJSON:
        try:
            next(read_lines(path, form), None)
        except BadFile as error:
            raise BadFile(
                Fault(f"{field}: {each.field}", each.message, each.value) for each in error.faults
            ) from None


def is_utf16(path: Path) -> bool:
    """True if a file begins with a byte order mark of UTF-16."""
    with path.open("rb") as file:
        return file.read(2) in _UTF16


def _not_telemetry(start: bytes, form: str) -> str | None:
    """A description of a file that is no telemetry, by its first bytes; None for telemetry."""
    if not start.strip():
        # More may follow in a longer file.
        return None if len(start) == _LOOKED_AT_BYTES else "is empty: there is no batch in it"
    if not telemetry_formats()[form].is_text:
        return telemetry_formats()[form].refusal(start)
    for magic, (name, unpack) in _PACKED.items():
        if start.startswith(magic):
            return f"is packed with {name}: unpack it first ({unpack})"
    if b"\0" in start and not start.lstrip().startswith(b"{"):
        return "is a binary file; telemetry is NDJSON, one batch a line, or CSV"
    return telemetry_formats()[form].refusal(start)


@contextmanager
def _opened(source: Path | BinaryIO, form: str) -> Iterator[BinaryIO]:
    """Context manager of a telemetry file; seekable UTF-16 text, or CSV with CRs, is converted."""
    if not isinstance(source, Path):
        yield source
        return
    try:
        stream = source.open("rb")
    except OSError as error:
        reason = error.strerror or str(error)
        raise BadFile(Fault(str(source), f"cannot be opened: {reason}")) from None
    with stream:
        if not stream.seekable() or not telemetry_formats()[form].is_text:
            yield stream
            return
        start = stream.read(_LOOKED_AT_BYTES)
        stream.seek(0)
        is_wide = start.startswith(_UTF16)
        if not is_wide and not (form == "csv" and b"\r" in start and b"\n" not in start):
            yield stream
            return
        with tempfile.TemporaryFile() as copy:
            # The default `newline` turns every kind of line end into a line feed.
            text = io.TextIOWrapper(stream, "utf-16" if is_wide else "utf-8", "surrogateescape")
            try:
                while piece := text.read(_LOOKED_AT_BYTES):
                    copy.write(piece.encode("utf-8", "surrogateescape"))
            except UnicodeError as error:
                raise BadFile(Fault(str(source), f"is damaged UTF-16: {error}")) from None
            copy.seek(0)
            yield copy
