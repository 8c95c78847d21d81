"""Bodies that come compressed: their lines, unpacked as they are read, in bounded memory."""

import gzip
import io
import zlib
from collections.abc import Iterator
from typing import IO, Any, Literal

from service.errors import BadBatch, Fault

Coding = Literal["identity", "gzip", "zstd"]

MAX_UNPACKED_BYTES = 64 << 30
"""Beyond what any archive of telemetry holds: a small body that unpacks to more is no telemetry."""
MAX_WINDOW_BYTES = 128 << 20


def unpacked_lines(file: IO[bytes], coding: Coding, max_bytes: int) -> Iterator[bytes]:
    """The lines of a file, which is closed after the last one.

    Of a line longer than `max_bytes` only its beginning is given, which is no
    JSON and is reported with its number like any other bad line.  Raises
    `BadBatch` where the packed data are damaged or unpack to too much; the
    lines before that have been given.
    """
    with file, _unpacking(file, coding) as text:
        passed = 0
        try:
            while line := text.readline(max_bytes):
                yield line
                passed += len(line)
                while len(line) == max_bytes and not line.endswith(b"\n"):
                    line = text.readline(max_bytes)
                    passed += len(line)
                if passed > MAX_UNPACKED_BYTES:
                    message = f"unpacks to more than {MAX_UNPACKED_BYTES >> 30} GiB"
                    raise BadBatch(Fault("body", message))
        except (OSError, EOFError, zlib.error, _zstd_error()) as error:
            raise BadBatch(Fault("body", f"the {coding} data are damaged: {error}")) from None


def _unpacking(file: IO[bytes], coding: Coding) -> IO[bytes] | io.BufferedIOBase:
    if coding == "gzip":
        return gzip.GzipFile(fileobj=file)
    if coding == "zstd":
        return io.BufferedReader(_Zstd(file))
    return file


class _Zstd(io.RawIOBase):
    """Frames of zstd as one stream; unlike the library's own reader it tells a file cut short."""

    # A block of four bytes may unpack to 128 KiB: so little at a time keeps what is held in bounds.
    _PIECE_BYTES = 512

    def __init__(self, file: IO[bytes]) -> None:
        import zstandard

        self._file = file
        self._unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
        self._frame = self._unpacker.decompressobj()
        self._begun = False
        self._ready = b""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        while not self._ready and self._more():
            pass
        given = self._ready[: len(buffer)]
        self._ready = self._ready[len(given) :]
        buffer[: len(given)] = given
        return len(given)

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
        self._ready = self._frame.decompress(packed)
        return True


def _zstd_error() -> type[Exception]:
    import zstandard

    return zstandard.ZstdError
