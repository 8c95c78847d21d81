"""Where commands write files: a path, or the standard output."""

import sys
from collections.abc import Iterator
from pathlib import Path


def written_to(file: Path | None, content: Iterator[bytes]) -> None:
    """Write content to a file, or to the standard output where there is none.

    The file appears when it is whole: it is written under another name beside its place.
    """
    if file is None:
        for piece in content:
            sys.stdout.buffer.write(piece)
        sys.stdout.buffer.flush()
        return
    beside = file.with_name(f"{file.name}.part")
    try:
        with beside.open("wb") as part:
            for piece in content:
                part.write(piece)
        beside.replace(file)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
