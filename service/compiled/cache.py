"""The folder of compiled kernels, one for every state of the source code.

numba checks only the file of a kernel, not the files whose code or constants were compiled into it:
after a change of one of these it would use outdated code.
"""

import hashlib
import os
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
SOURCES = (
    "service/attitude",
    "service/compiled",
    "service/features/*/kernels*",
    "service/gyro/samples.py",
    "service/identify",
    "service/missions",
    "service/observations/batch.py",
    "service/observations/calibrate.py",
    "service/observations/columns.py",
    "service/observations/focal_plane.py",
    "service/observations/scans",
    "service/sky",
    "service/csv_cells.py",
    "service/errors.py",
    "service/interpolation.py",
    "service/resources.py",
    "service/times.py",
    "service/vectors.py",
    "studies/ptp_2015/rivals",
    "studies/scenes.py",
)
"""Patterns of all source files with compiled code, and of the files that they import."""


def keep_kernels_apart() -> None:
    """Select the kernel cache folder that belongs to the present state of the source code.

    numba reads the environment when it is imported; if it was imported before, its setting is
    changed too. A folder set in the environment is kept.
    """
    folder = os.environ.get("NUMBA_CACHE_DIR") or str(_folder())
    os.environ["NUMBA_CACHE_DIR"] = folder
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = folder


@cache
def source_digest() -> str:
    """The SHA-256 digest of all files in `SOURCES`, in hexadecimal."""
    state = hashlib.sha256()
    for path in sorted(path for source in SOURCES for path in source_files(source)):
        state.update(path.relative_to(PACKAGE.parent).as_posix().encode() + path.read_bytes())
    return state.hexdigest()


def source_files(pattern: str) -> Iterator[Path]:
    """The Python files that match a pattern of `SOURCES`."""
    for place in PACKAGE.parent.glob(pattern):
        yield from place.rglob("*.py") if place.is_dir() else [place]


def _folder() -> Path:
    pycache = PACKAGE / "__pycache__"
    if not os.access(pycache if pycache.exists() else PACKAGE, os.W_OK):
        pycache = Path.home() / ".cache" / "attitude-acquisition"
    return pycache / f"kernels-{source_digest()[:16]}"
