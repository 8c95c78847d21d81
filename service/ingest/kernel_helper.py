"""A second process that compiles kernels from the other end, while the first build runs.

Both leave what they compile in the same cache on disk, where the other finds it.  The build
goes through everything and alone decides when it is over; the helper only shortens it.
"""

import multiprocessing
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from service.acquire.kernel_build import end_with_parent
from service.acquire.prewarm import prewarm_kernels
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import Mission
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel

_CONTEXT = multiprocessing.get_context("spawn")
_LEAST_PROCESSORS = 2


@contextmanager
def compiling_beside(missions: Mapping[str, Mission]) -> Iterator[None]:
    """While the block compiles kernels, let another process compile those that it comes to last.

    Without a second processor there is none.  It is ended with the block: numba writes what it
    has compiled beside the cache and then renames it, so that no file is left in part.
    """
    if len(os.sched_getaffinity(0)) < _LEAST_PROCESSORS:
        yield
        return
    helper = _CONTEXT.Process(target=_compile_the_rest, args=(dict(missions),), daemon=True)
    helper.start()
    try:
        yield
    finally:
        helper.kill()
        helper.join()


def _compile_the_rest(missions: Mapping[str, Mission]) -> None:
    end_with_parent()
    # The order of this process's registry alone: what shares the least with zones comes first.
    entries = sorted(
        IDENTIFIERS.items(), key=lambda item: (item[1].searches_zone, item[0] != "ptp")
    )
    IDENTIFIERS.clear()
    IDENTIFIERS.update(entries)
    prewarm_kernels(SkyModel(load_embedded(), LruCache(64 << 20)), missions)
