"""Lines of telemetry files and of compressed bodies, read in bounded memory."""

import codecs
import gzip
import io
import os
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import IO, Any, BinaryIO, Literal

from service.errors import BadBatch, Fault

Coding = Literal["identity", "gzip", "zstd"]

MAX_UNPACKED_BYTES = 64 << 30
"""More than any archive of telemetry holds: a body that unpacks to more is no telemetry."""
MAX_WINDOW_BYTES = 128 << 20


MAX_RATIO = 200
"""Telemetry packs to a tenth; the same stars in every batch of a simulation to a hundredth."""
FREE_BYTES = 256 << 20
"""May be unpacked whatever the ratio: so much is read in seconds."""


def unpacked_lines(
    file: IO[bytes],
    coding: Coding,
    max_bytes: int,
    require: Callable[[], object] = lambda: None,
) -> Iterator[bytes]:
    """The lines of a file, which is closed after the last one.

    Of a line longer than `max_bytes` only its beginning is given, which is no
    JSON and is reported with its number like any other bad line.  Raises
    `BadBatch` where the packed data are damaged or unpack to too much; the
    lines before that have been given.  `require` is called before each read of
    packed data and each piece of a line, and ends the reading where it raises.
    """
    watched = _Watched(file, require)
    with file, _unpacking(watched, coding) as text:
        passed, most = 0, _most_bytes(file, coding)
        try:
            while line := text.readline(max_bytes):
                yield line
                passed += len(line)
                while len(line) == max_bytes and not line.endswith(b"\n"):
                    require()
                    line = text.readline(max_bytes)
                    passed += len(line)
                    _require_at_most(passed, most)
                _require_at_most(passed, most)
        except (OSError, EOFError, zlib.error, _zstd_error()) as error:
            raise BadBatch(Fault("body", f"the {coding} data are damaged: {error}")) from None


def _most_bytes(file: IO[bytes], coding: Coding) -> tuple[int, str]:
    """How much a file may unpack to, and which bound says so."""
    most, why = MAX_UNPACKED_BYTES, f"{MAX_UNPACKED_BYTES >> 30} GiB"
    if coding != "identity":
        place = file.tell()
        packed = file.seek(0, os.SEEK_END)
        file.seek(place)
        allowed = max(FREE_BYTES, MAX_RATIO * packed)
        if allowed < most:
            most = allowed
            why = (
                f"{allowed} bytes: a packed body may unpack to {MAX_RATIO} times its size, here "
                f"{packed} bytes, or to {FREE_BYTES >> 20} MiB if that is more; send it unpacked "
                "or in parts"
            )
    return most, why


def _require_at_most(passed: int, most: tuple[int, str]) -> None:
    if passed > most[0]:
        raise BadBatch(Fault("body", f"decompresses to more than {most[1]}"))


class _Watched(io.RawIOBase):
    """A file that asks before each read whether reading is to go on.

    Packed data may hold millions of empty members or frames, of which no line
    comes: only here they can be stopped.
    """

    def __init__(self, file: IO[bytes], require: Callable[[], object]) -> None:
        self._file, self._require = file, require

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        self._require()
        return self._file.read(size)

    def readline(self, size: int | None = -1) -> bytes:
        self._require()
        return self._file.readline(-1 if size is None else size)


def _unpacking(file: _Watched, coding: Coding) -> io.RawIOBase | io.BufferedIOBase:
    if coding == "gzip":
        return gzip.GzipFile(fileobj=file, mode="rb")
    if coding == "zstd":
        return io.BufferedReader(_Zstd(file))
    return file


class _Zstd(io.RawIOBase):
    """Frames of zstd as one stream; unlike the library's own reader it tells a file cut short."""

    # A block of four bytes may unpack to 128 KiB: so little at a time keeps what is held in bounds.
    _PIECE_BYTES = 512

    def __init__(self, file: _Watched) -> None:
        import zstandard

        self._file = file
        self._unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
        self._frame = self._unpacker.decompressobj()
        self._begun = False
        # A view: to cut the rest off again and again would copy it each time.
        self._ready = memoryview(b"")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        while not self._ready and self._more():
            pass
        part = self._ready[: len(buffer)]
        self._ready = self._ready[len(part) :]
        buffer[: len(part)] = part
        return len(part)

    def _more(self) -> bool:
        packed = b""
        if self._frame.eof:
            packed = self._frame.unused_data
            self._frame, self._begun = self._unpacker.decompressobj(), False
        packed = packed or self._file.read(self._PIECE_BYTES)
        if not packed:
            if self._begun:
                raise EOFError("they end in the middle of a frame")
            return False
        self._begun = True
        self._ready = memoryview(self._frame.decompress(packed))
        return True


def _zstd_error() -> type[Exception]:
    import zstandard

    return zstandard.ZstdError


MAX_LINE_BYTES = 1 << 20


@dataclass(frozen=True)
class Line:
    """A batch as JSON, or the fault that stands in its place.

    `number` counts lines from one; a batch of a CSV file has that of its first
    row, a fault that of the line where it lies.
    """

    number: int
    body: bytes | None
    fault: Fault | None = None


def physical_lines(stream: BinaryIO, number: int = 0) -> Iterator[Line]:
    """The lines of a stream without their ends, after the first `number` that were read already.

    Blank lines are counted and left out.  A line beyond `MAX_LINE_BYTES` is passed
    over without being held.
    """
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
