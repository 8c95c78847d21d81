"""Temporary files for what must be known whole before its first byte is written."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

IN_MEMORY_BYTES = 4 << 20
"""More than this is kept on the disk."""
PIECE_BYTES = 256 << 10


@contextmanager
def spool() -> Iterator[IO[bytes]]:
    """A file without a name, which is gone at the end."""
    with tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES) as file:
        yield file


def pieces(file: IO[bytes]) -> Iterator[bytes]:
    """All that was written to a file, from its beginning."""
    file.seek(0)
    while piece := file.read(PIECE_BYTES):
        yield piece


@contextmanager
def folder() -> Iterator[str]:
    """A folder, which is removed at the end with all that it holds."""
    place = tempfile.mkdtemp(prefix="acquire-export-")
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
