"""One block of memory for all arrays of an index, and what compiled code makes of it.

A call from Python pays for every array that it hands over; one block is one argument.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from service.vectors import read_only

LINE = 64
"""Arrays begin with a line of the processor's caches."""
HEAD_WORDS = 64
"""The head of the block, three words an array."""
FIRST, LAST, ROWS = 0, 1, 2
"""Of each array in the head: its first byte, the one past its last, and its rows."""

StoreBytes = npt.NDArray[np.uint8]
Form = tuple[str, Sequence[int]]
"""Type and shape of an array."""


def stored(arrays: Sequence[npt.NDArray[Any]]) -> tuple[StoreBytes, list[npt.NDArray[Any]]]:
    """The arrays one after the other in a block, and the same arrays as views of it; locked."""
    head = np.zeros(HEAD_WORDS, np.int64)
    at = head.nbytes
    for k, array in enumerate(arrays):
        head[3 * k : 3 * k + 3] = at, at + array.nbytes, len(array)
        at += -(-array.nbytes // LINE) * LINE
    store = np.zeros(at, np.uint8)
    store[: head.nbytes] = head.view(np.uint8)
    for k, array in enumerate(arrays):
        store[head[3 * k + FIRST] : head[3 * k + LAST]] = (
            np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        )
    return read_only(store), views_of(store, [(each.dtype.str, each.shape) for each in arrays])


def views_of(store: StoreBytes, forms: Sequence[Form]) -> list[npt.NDArray[Any]]:
    """The arrays in a block, of these types and shapes, as views of it; locked."""
    head = store[: 8 * HEAD_WORDS].view(np.int64)
    return [
        read_only(store[head[3 * k + FIRST] : head[3 * k + LAST]].view(dtype).reshape(shape))
        for k, (dtype, shape) in enumerate(forms)
    ]
