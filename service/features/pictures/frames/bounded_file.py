"""File reader for untrusted frames: no offset or size stated in the file leads out of the file."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any, cast

from service.errors import BadFile
from service.features.pictures.frames.frame import bad_frame


class BoundedFile(io.RawIOBase):
    """A binary file whose reads stay within the file, whatever offset or size is asked for.

    An offset beyond the end is no error until bytes are read there, and none are. So an offset of
    2**62 in a header costs nothing, and a read takes no more memory than the file has bytes left.
    Libraries accept the object as a file open for reading.
    """

    mode = "rb"

    def __init__(self, file: IO[bytes]) -> None:
        super().__init__()
        self._file = file
        self.length = file.seek(0, os.SEEK_END)
        self._place = 0

    @property
    def stream(self) -> IO[bytes]:
        """The bounded file, typed as the binary file object that libraries expect."""
        return cast("IO[bytes]", self)

    def readable(self) -> bool:
        """Always true: the file can be read."""
        return True

    def seekable(self) -> bool:
        """Always true: the file allows random access."""
        return True

    def tell(self) -> int:
        """The offset of the next byte to read, which may lie beyond the end."""
        return self._place

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to an offset, also beyond the end; raises `BadFile` for one before the beginning."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self.length}[whence]
        if start + offset < 0:
            raise bad_frame("states a place before its beginning", str(start + offset)[:40])
        self._place = start + offset
        return self._place

    @property
    def left(self) -> int:
        """The number of bytes from the present offset to the end of the file."""
        return max(self.length - self._place, 0)

    def read(self, size: int | None = -1) -> bytes:
        """The next bytes of the file, at most as many as are left."""
        wanted = self.left if size is None or size < 0 else min(size, self.left)
        if wanted == 0:
            return b""
        self._file.seek(self._place)
        data = self._file.read(wanted)
        self._place += len(data)
        return data

    def readall(self) -> bytes:
        """All bytes from the present offset to the end of the file."""
        return self.read()

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer with the next bytes of the file; returns the number of bytes read."""
        view = memoryview(buffer).cast("B")
        data = self.read(len(view))
        view[: len(data)] = data
        return len(data)

    def exactly(self, count: int) -> bytes:
        """Exactly `count` bytes; raises `BadFile`, without reading, where the file ends earlier."""
        if self.left < count:
            message = f"{self.left} bytes of data where {count} are declared"
            raise bad_frame("is cut off", message[:80])
        return self.read(count)


@contextmanager
def decoding(what: str) -> Iterator[None]:
    """A context manager that turns any exception of a decoder into `BadFile`.

    Decoders raise many kinds of exceptions for damaged files.
    """
    try:
        yield
    except BadFile:
        raise
    except Exception as error:
        reason = str(error)[:200] or type(error).__name__
        raise bad_frame(f"cannot be read as {what}: {reason}") from None
