"""Lines of plain or compressed telemetry, read in bounded memory."""

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
"""Largest size of a decompressed body, more than any archive of telemetry."""


MAX_RATIO = 200
"""Largest ratio of decompressed to compressed size of a body of telemetry."""
FREE_BYTES = 256 << 20
"""Size in bytes up to which a body may decompress at any ratio, since it is read in seconds."""


def unpacked_lines(
    file: IO[bytes],
    coding: Coding,
    max_bytes: int,
    require: Callable[[], object] = lambda: None,
) -> Iterator[bytes]:
    """The lines of a plain or compressed file, which is closed after the last one.

    A line longer than `max_bytes` is cut there, so that it is no JSON and is reported like any
    other bad line. Raises `BadBatch` where the compressed data are damaged or too large; the lines
    before are yielded. `require` is called before each read of compressed data and each piece of a
    line; an exception from it ends the reading.
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
    """The largest decompressed size of a file, and the bound that gives it in words."""
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
    """A file wrapper that calls a function before each read, which may stop the reading.

    Compressed data may hold millions of empty members or frames without a line; only the reads of
    compressed data can be stopped there.
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
    """The content of several zstd frames as one stream; a truncated file raises an error."""

    # A block of four bytes may decompress to 128 KiB: small pieces bound the memory.
    _PIECE_BYTES = 512

    def __init__(self, file: _Watched) -> None:
        import zstandard

        self._file = file
        self._unpacker = zstandard.ZstdDecompressor(max_window_size=128 << 20)
        self._frame = self._unpacker.decompressobj()
        self._begun = False
        # A view, since repeated slicing of bytes would copy the rest each time.
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
    """A line of telemetry: a batch or gyro block as JSON, or the fault in its place.

    `number` counts lines from one; a batch from a CSV file has the number of its first row, a fault
    the number of its own line.
    """

    number: int
    body: bytes | None
    fault: Fault | None = None


def physical_lines(stream: BinaryIO, number: int = 0) -> Iterator[Line]:
    """The lines of a stream without line ends, counted from `number` already read.

    Blank lines are counted and left out. A line longer than `MAX_LINE_BYTES` is skipped without
    being stored.
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
