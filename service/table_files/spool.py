"""Temporary files for output whose beginning depends on its end."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

IN_MEMORY_BYTES = 4 << 20
"""Size in bytes above which a temporary file is kept on disk instead of in memory."""
PIECE_BYTES = 256 << 10


@contextmanager
def spool() -> Iterator[IO[bytes]]:
    """Context manager of an unnamed temporary file."""
    with tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES) as file:
        yield file


def pieces(file: IO[bytes]) -> Iterator[bytes]:
    """Content of a file from its beginning, in pieces."""
    file.seek(0)
    while piece := file.read(PIECE_BYTES):
        yield piece


@contextmanager
def folder() -> Iterator[str]:
    """Context manager of a temporary folder, removed at the end with its content."""
    place = tempfile.mkdtemp(prefix="acquire-export-")
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
