"""Frames from numpy's own files, and the counts that every reader gives back."""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from service.errors import BadFile
from service.imaging.frames.frame import CountArray, Frame, FrameLimits, bad_frame

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_MAX_HEADER = 4096
COLOURS = 3


def read_npy(file: IO[bytes], limits: FrameLimits, digest: str) -> Frame:
    """A frame from a .npy file of (rows, columns), or of three colours first or last.

    Of colours the counts are the sums.  Raises `BadFile`.
    """
    try:
        version = np.lib.format.read_magic(file)
        if version not in _HEADERS:
            raise bad_frame("is of a .npy version that frames do not need", str(version))
        shape, by_column, dtype = _HEADERS[version](file, max_header_size=_MAX_HEADER)
    except BadFile:
        raise
    except Exception as error:
        # numpy reads its header as an expression of Python, which gives up in many ways.
        raise bad_frame(f"has no readable .npy header: {str(error)[:200]}") from None
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise bad_frame("must hold numbers of up to 64 bits", str(dtype)[:80])
    colours = _colour_axis(shape)
    height_px, width_px = (side for k, side in enumerate(shape) if k != colours)
    limits.require(width_px, height_px)
    count = width_px * height_px * (1 if colours is None else COLOURS)
    data = exactly(file, count * dtype.itemsize)
    order = "F" if by_column else "C"
    values = np.frombuffer(data, dtype).reshape(shape, order=order)  # type: ignore[call-overload]
    full_scale = full_scale_of(values.dtype)
    if colours is not None:
        wide = np.int64 if dtype.kind in "iu" and dtype.itemsize < 8 else np.float64
        values, full_scale = values.sum(axis=colours, dtype=wide), COLOURS * full_scale
    return Frame(as_counts(values), "NPY", digest, full_scale)


def _colour_axis(shape: tuple[int, ...]) -> int | None:
    """The axis of three colours, None without one; raises `BadFile` for another number of axes."""
    if len(shape) == 2:
        return None
    if len(shape) == 3 and COLOURS in (shape[0], shape[2]):
        return 2 if shape[2] == COLOURS else 0
    message = "must have two dimensions, rows and columns, or a third of three colours"
    raise bad_frame(message, str(shape)[:80])


@contextmanager
def decoding(what: str) -> Iterator[None]:
    """Turn whatever a decoder raises into `BadFile`: what it reads is no such file.

    A decoder that stumbles over what it reads does so in many ways.
    """
    try:
        yield
    except BadFile:
        raise
    except Exception as error:
        reason = str(error)[:200] or type(error).__name__
        raise bad_frame(f"cannot be read as {what}: {reason}") from None


def exactly(file: IO[bytes], count: int) -> bytes:
    """The next bytes of a file; raises `BadFile` where it ends before, and reads nothing."""
    start = file.tell()
    left = file.seek(0, os.SEEK_END) - start
    if left < count:
        raise bad_frame("is cut off", f"{max(left, 0)} bytes of data where {count} are declared")
    file.seek(start)
    return file.read(count)


def as_counts(values: npt.NDArray[Any]) -> CountArray:
    """Numbers of any kind as counts: float32 where that is exact, in the machine's own order."""
    exact = values.dtype.itemsize <= 2 or values.dtype.str[1:] == "f4"
    return np.ascontiguousarray(values, dtype=np.float32 if exact else np.float64)


def full_scale_of(dtype: np.dtype[Any]) -> float:
    """The largest number that integers of a kind can hold; infinite for floating ones."""
    return float(np.iinfo(dtype).max) if dtype.kind in "iu" else math.inf
