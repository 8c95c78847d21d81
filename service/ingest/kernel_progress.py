"""How far the compiling of the kernels is, seen from the files that it leaves in the cache.

The size of machine code grows evenly with the time that its compiling takes.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from logging import Logger
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numba

KERNEL_BYTES = 6_090_000
"""Of the machine code of all kernels, about; other processors have a tenth more or less."""
MOST_SHARE = 0.99
"""Until it is over, since the size is not known to the last byte."""
LEAST_SHARE = 0.02
"""Before this the time that is left cannot be told."""
STEPS = {
    "geometry": "zones and pairs",
    "sky": "zones and pairs",
    "observations": "reading batches",
    "voting": "votes",
    "hypotheses": "verified identification",
    "identify": "verified identification",
    "attitude": "attitude",
    "whole_sky": "index of the whole sky",
    "lost_in_space": "search of the whole sky",
    "triangles": "triangles",
    "tracks": "links of points",
    "filtering": "attitude over time",
}
"""What the kernels of a folder are for; the cache has a folder for each of them."""
EVERY_S = 10.0


@dataclass(frozen=True)
class KernelProgress:
    """How far the compiling is: the step it is in, and the share that is done (0 to 1)."""

    step: str
    share: float

    def line(self, passed_s: float) -> str:
        """Step, share and time left, after so many seconds."""
        text = f"compiling kernels, {self.step}: {100.0 * self.share:.0f} %"
        if self.share < LEAST_SHARE:
            return text
        return f"{text}, about {passed_s * (1.0 / self.share - 1.0):.0f} s left"


def kernel_progress() -> KernelProgress:
    """How far the compiling into this process's folder of kernels is."""
    config: Any = numba.config
    files = []
    for path in Path(config.CACHE_DIR).glob("*/*.nbc"):
        try:
            state = path.stat()
        except FileNotFoundError:
            continue  # numba writes beside and renames
        files.append((state.st_mtime, state.st_size, path.parent.name))
    if not files:
        return KernelProgress(next(iter(STEPS.values())), 0.0)
    folder = max(files)[2].rpartition("_")[0]
    share = sum(size for _, size, _ in files) / KERNEL_BYTES
    return KernelProgress(STEPS.get(folder, folder), min(share, MOST_SHARE))


@contextmanager
def progress_logged(log: Logger) -> Iterator[None]:
    """While the block compiles kernels: a line in the log every ten seconds."""
    ended, start = Event(), time.monotonic()

    def tell() -> None:
        while not ended.wait(EVERY_S):
            log.info("%s", kernel_progress().line(time.monotonic() - start))

    teller = Thread(target=tell, name="kernel-progress", daemon=True)
    teller.start()
    try:
        yield
    finally:
        ended.set()
        teller.join()
