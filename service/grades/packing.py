"""Graded samples as compressed bytes, and back.

Times and quaternions keep every bit, all else has the seven digits of a float32.  The bytes of
equal weight stand together, so that signs and exponents, which hardly change, take no room.
"""

import zlib
from typing import Any

import numpy as np

from service.grades.day import GradedSamples

LEVEL = 1
"""Of zlib; level 6 takes five times as long for about 3 % less."""
MOST_SAMPLES = 3_600
"""Of a block: an hour."""
_FIELDS: tuple[tuple[str, str, int], ...] = (
    ("tai_ns", "<i8", 1),
    ("quaternion", "<f8", 4),
    ("covariance_arcsec2", "<f4", 6),
    ("rate_deg_per_s", "<f4", 3),
    ("bias_deg_per_h", "<f4", 3),
    ("bias_sigma_deg_per_h", "<f4", 3),
    ("status", "u1", 1),
)
"""Name, type and columns."""
_NUMBERS = {"i": np.int64, "u": np.int64, "f": np.float64}
_BYTES = sum(np.dtype(kind).itemsize * columns for _, kind, columns in _FIELDS)


def packed(samples: GradedSamples) -> bytes:
    """The compressed bytes of samples."""
    parts = []
    for name, kind, _ in _FIELDS:
        values = np.asarray(getattr(samples, name)).T
        if kind == "<i8":
            # Steps are alike, times are not.
            values = np.diff(values, prepend=0)
        each = np.ascontiguousarray(values, kind)
        parts.append(each.view(np.uint8).reshape(-1, each.itemsize).T.tobytes())
    return zlib.compress(b"".join(parts), LEVEL)


def unpacked(data: bytes, samples: int) -> GradedSamples:
    """So many samples that `packed` was given.

    Raises `ValueError` for bytes that are damaged or hold another number of samples.
    """
    try:
        raw = np.frombuffer(zlib.decompress(data), np.uint8)
    except zlib.error as error:
        raise ValueError(f"cannot be decompressed: {error}") from None
    if raw.size != samples * _BYTES:
        raise ValueError(f"{raw.size} bytes are not {samples} samples")
    found: dict[str, Any] = {}
    at = 0
    for name, kind, columns in _FIELDS:
        dtype = np.dtype(kind)
        size = dtype.itemsize * columns * samples
        shuffled = raw[at : at + size].reshape(dtype.itemsize, -1)
        values = np.ascontiguousarray(shuffled.T).view(dtype).reshape(columns, samples).T
        values = np.ascontiguousarray(values, _NUMBERS[dtype.kind])
        found[name] = values if columns > 1 else values[:, 0]
        at += size
    found["tai_ns"] = np.cumsum(found["tai_ns"])
    return GradedSamples(**found)
