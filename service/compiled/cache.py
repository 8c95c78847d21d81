"""The folder of compiled kernels, one for every state of the source.

numba looks only at the file of the kernel it loads, not at those whose code or
constants were compiled into it: after an edit or an update of one of them it
would go on with the old code.
"""

import hashlib
import os
import sys
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
SOURCES = (
    "attitude",
    "compiled",
    "filtering",
    "identify",
    "missions",
    "observations/batch.py",
    "observations/calibrate.py",
    "observations/focal_plane.py",
    "observations/scans",
    "simulate/scenes.py",
    "sky",
    "studies/ptp_2015/rivals",
    "tracks/extending.py",
    "csv_cells.py",
    "errors.py",
    "resources.py",
    "times.py",
    "vectors.py",
)
"""Where every module with compiled code lies, and all that these import: folders and files."""


def keep_kernels_apart() -> None:
    """Give the present state of the source its own folder of compiled kernels.

    numba reads the environment when it is imported; where it was imported first, its
    setting is changed as well.  A folder that the environment names already stays.
    """
    folder = os.environ.get("NUMBA_CACHE_DIR") or str(_folder())
    os.environ["NUMBA_CACHE_DIR"] = folder
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = folder


@cache
def source_digest() -> str:
    """The digest of `SOURCES`, in hexadecimal digits."""
    state = hashlib.sha256()
    for source in SOURCES:
        place = PACKAGE / source
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            state.update(path.relative_to(PACKAGE).as_posix().encode() + path.read_bytes())
    return state.hexdigest()


def _folder() -> Path:
    pycache = PACKAGE / "__pycache__"
    if not os.access(pycache if pycache.exists() else PACKAGE, os.W_OK):
        pycache = Path.home() / ".cache" / "attitude-acquisition"
    return pycache / f"kernels-{source_digest()[:16]}"
