"""One block of memory for all arrays of an index, and what compiled code makes of it.

A call from Python pays for every array that it hands over, and a search that
jumps about in ten arrays for every page of memory that it meets anew.  One block
is one argument, and starts where the system can give it large pages.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from service.vectors import read_only

LARGE_PAGE = 2 << 20
LINE = 64
"""Arrays begin with a line of the processor's caches."""
HEAD_WORDS = 64
"""The head of the block, three words an array."""
FIRST, LAST, ROWS = 0, 1, 2
"""Of each array in the head: its first byte, the one past its last, and its rows."""

StoreBytes = npt.NDArray[np.uint8]


def stored(arrays: Sequence[npt.NDArray[Any]]) -> tuple[StoreBytes, list[npt.NDArray[Any]]]:
    """The arrays one after the other in a block, and the same arrays as views of it; locked."""
    head = np.zeros(HEAD_WORDS, np.int64)
    at = head.nbytes
    for k, array in enumerate(arrays):
        head[3 * k : 3 * k + 3] = at, at + array.nbytes, len(array)
        at += -(-array.nbytes // LINE) * LINE
    # What lies before the first large page is never touched, and so never held.
    block = np.empty(at + LARGE_PAGE, np.uint8)
    start = -block.ctypes.data % LARGE_PAGE
    store = block[start : start + at]
    store[: head.nbytes] = head.view(np.uint8)
    views = []
    for k, array in enumerate(arrays):
        first, last = head[3 * k], head[3 * k + 1]
        store[first:last] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        views.append(read_only(store[first:last].view(array.dtype).reshape(array.shape)))
    return read_only(store), views
