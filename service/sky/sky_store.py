"""One block of memory for all arrays of an index, and what compiled code makes of it.

A call from Python pays for every array that it hands over, and a search that
jumps about in ten arrays for every page of memory that it meets anew.  One block
is one argument, and starts where the system can give it large pages.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import types
from numba.core.typing.templates import signature
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array

from service.vectors import read_only

LARGE_PAGE = 2 << 20
LINE = 64
"""Arrays begin with a line of the processor's caches."""
HEAD_WORDS = 64
"""At the beginning: for every array its first byte, the one past its last, and its rows."""

Store = npt.NDArray[np.uint8]


def stored(arrays: Sequence[npt.NDArray[Any]]) -> tuple[Store, list[npt.NDArray[Any]]]:
    """The arrays one after the other in a block, and the same arrays as views of it; locked."""
    head = np.zeros(HEAD_WORDS, np.int64)
    at = head.nbytes
    for k, array in enumerate(arrays):
        head[3 * k : 3 * k + 3] = at, at + array.nbytes, len(array)
        at += -(-array.nbytes // LINE) * LINE
    # What lies before the first large page is never touched, and so never held.
    room = np.empty(at + LARGE_PAGE, np.uint8)
    start = -room.ctypes.data % LARGE_PAGE
    store = room[start : start + at]
    store[: head.nbytes] = head.view(np.uint8)
    views = []
    for k, array in enumerate(arrays):
        first, last = head[3 * k], head[3 * k + 1]
        store[first:last] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        views.append(read_only(store[first:last].view(array.dtype).reshape(array.shape)))
    return read_only(store), views


def _lent(_: Any, block: Any, first_byte: Any, shape: Any, dtype: Any) -> Any:
    kind = types.Array(dtype.dtype, len(shape), "C", readonly=not block.mutable)

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        held, at, sizes, _ = arguments
        base = context.make_array(block)(context, builder, held).data
        at = context.cast(builder, at, first_byte, types.intp)
        extents = [
            context.cast(builder, builder.extract_value(sizes, axis), size, types.intp)
            for axis, size in enumerate(shape)
        ]
        item = context.get_constant(
            types.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype))
        )
        strides = [item]
        for extent in reversed(extents[1:]):
            strides.insert(0, builder.mul(strides[0], extent))
        byte = builder.bitcast(base, context.get_data_type(types.uint8).as_pointer())
        array = context.make_array(kind)(context, builder)
        populate_array(  # type: ignore[no-untyped-call]
            array,
            data=builder.bitcast(builder.gep(byte, [at]), array.data.type),
            shape=extents,
            strides=strides,
            itemsize=item,
            meminfo=None,
        )
        return array._getvalue()

    return signature(kind, block, first_byte, shape, dtype), generate  # type: ignore[no-untyped-call]


lent: Any = intrinsic(_lent)
"""`lent(block, first_byte, shape, dtype)`: an array within a block, without an owner.

Its caller holds the block for as long as it runs.  Free of charge, where a slice, a view
and a shape of it are three calls.
"""
