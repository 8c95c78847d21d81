"""The one reader of a frame's file: no place or size that a file states leads out of the file."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any, cast

from service.errors import BadFile
from service.imaging.frames.frame import bad_frame


class BoundedFile(io.RawIOBase):
    """A file read between its first and its last byte, whatever place or size is asked for.

    A place beyond the end is no error until bytes are read there: none are.  So a place of 2**62 in
    a header costs nothing, and a read takes no more memory than the file has bytes left.
    Libraries take it for a file that is open for reading alone.
    """

    mode = "rb"

    def __init__(self, file: IO[bytes]) -> None:
        super().__init__()
        self._file = file
        self.length = file.seek(0, os.SEEK_END)
        self._place = 0

    @property
    def stream(self) -> IO[bytes]:
        """The same under the type that libraries ask for; they only read."""
        return cast("IO[bytes]", self)

    def readable(self) -> bool:
        """True: it is there to be read."""
        return True

    def seekable(self) -> bool:
        """True: every place of it can be read."""
        return True

    def tell(self) -> int:
        """The place of the next byte that is read; it may lie beyond the end."""
        return self._place

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a place, also beyond the end; raises `BadFile` for one before the beginning."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self.length}[whence]
        if start + offset < 0:
            raise bad_frame("states a place before its beginning", str(start + offset)[:40])
        self._place = start + offset
        return self._place

    @property
    def left(self) -> int:
        """The number of bytes from here to the end."""
        return max(self.length - self._place, 0)

    def read(self, size: int | None = -1) -> bytes:
        """The next bytes, at most those that are left."""
        wanted = self.left if size is None or size < 0 else min(size, self.left)
        if wanted == 0:
            return b""
        self._file.seek(self._place)
        data = self._file.read(wanted)
        self._place += len(data)
        return data

    def readall(self) -> bytes:
        """All bytes from here to the end."""
        return self.read()

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer with the next bytes, as far as there are any; returns their number."""
        view = memoryview(buffer).cast("B")
        data = self.read(len(view))
        view[: len(data)] = data
        return len(data)

    def exactly(self, count: int) -> bytes:
        """The next bytes; raises `BadFile` where the file ends before, and reads nothing."""
        if self.left < count:
            message = f"{self.left} bytes of data where {count} are declared"
            raise bad_frame("is cut off", message[:80])
        return self.read(count)


@contextmanager
def decoding(what: str) -> Iterator[None]:
    """Turn whatever a decoder raises into `BadFile`: what it reads is no such file.

    A decoder that stumbles over what it reads does so in many ways.
    """
    try:
        yield
    except BadFile:
        raise
    except Exception as error:
        reason = str(error)[:200] or type(error).__name__
        raise bad_frame(f"cannot be read as {what}: {reason}") from None
