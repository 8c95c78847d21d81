"""Star identification and attitude: from a batch of observed stars to a recorded attitude."""

import hashlib
import os
from pathlib import Path

__version__ = "0.1.0"


KERNELS = (
    "attitude",
    "identify",
    "observe/correct.py",
    "sky",
    "simulate/ptp/rivals",
    "uncounted.py",
)
"""Where compiled code and what it takes in stands: folders, whole, and files."""


def _keep_kernels_apart() -> None:
    """Give every state of the source its own folder of compiled kernels.

    numba looks only at the file of the kernel it loads, not at those that it
    took in from other files: after an edit or an update of one of them it would
    go on with the old code.
    """
    package = Path(__file__).parent
    state = hashlib.sha256()
    for place in KERNELS:
        room = package / place
        for path in sorted(room.rglob("*.py")) if room.is_dir() else [room]:
            state.update(path.name.encode() + path.read_bytes())
    folder = package / "__pycache__"
    if not os.access(folder if folder.exists() else package, os.W_OK):
        folder = Path.home() / ".cache" / "attitude-acquisition"
    os.environ["NUMBA_CACHE_DIR"] = str(folder / f"kernels-{state.hexdigest()[:16]}")


if "NUMBA_CACHE_DIR" not in os.environ:
    _keep_kernels_apart()
