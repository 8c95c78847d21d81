"""Frames from numpy's own files, and the counts that every reader gives back."""

import math
import os
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


def read_npy(file: IO[bytes], limits: FrameLimits, digest: str) -> Frame:
    """A frame from a .npy file of two dimensions, (rows, columns); raises `BadFile`."""
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
    if len(shape) != 2:
        raise bad_frame("must have two dimensions, rows and columns", str(shape)[:80])
    height_px, width_px = shape
    limits.require(width_px, height_px)
    data = exactly(file, width_px * height_px * dtype.itemsize)
    order = "F" if by_column else "C"
    values = np.frombuffer(data, dtype).reshape((height_px, width_px), order=order)  # type: ignore[call-overload]
    return Frame(as_counts(values), "NPY", digest, full_scale_of(values.dtype))


def exactly(file: IO[bytes], count: int) -> bytes:
    """The next bytes of a file; raises `BadFile` where it ends before, and reads nothing."""
    here = file.tell()
    left = file.seek(0, os.SEEK_END) - here
    if left < count:
        raise bad_frame("is cut off", f"{max(left, 0)} bytes of data where {count} are declared")
    file.seek(here)
    return file.read(count)


def as_counts(values: npt.NDArray[Any]) -> CountArray:
    """Numbers of any kind as counts: float32 where that is exact, in the machine's own order."""
    exact = values.dtype.itemsize <= 2 or values.dtype.str[1:] == "f4"
    return np.ascontiguousarray(values, dtype=np.float32 if exact else np.float64)


def full_scale_of(dtype: np.dtype[Any]) -> float:
    """The largest number that integers of a kind can hold; infinite for floating ones."""
    return float(np.iinfo(dtype).max) if dtype.kind in "iu" else math.inf
