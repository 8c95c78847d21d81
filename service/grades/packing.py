"""Graded samples and innovations as compressed bytes, and back.

Times and quaternions keep every bit, all else has the seven digits of a float32.  The bytes of
equal weight stand together, so that signs and exponents, which hardly change, take no room.
"""

import zlib
from typing import Any, TypeVar

import numpy as np

from service.grades.day import GradedSamples
from service.grades.innovations import MeasuredInnovations

Packable = TypeVar("Packable", GradedSamples, MeasuredInnovations)
Fields = tuple[tuple[str, str, int], ...]

LEVEL = 1
"""Of zlib; level 6 takes five times as long for about 3 % less."""
MOST_SAMPLES = 3_600
"""Of a block: an hour."""
_FIELDS: dict[type, Fields] = {
    GradedSamples: (
        ("tai_ns", "<i8", 1),
        ("quaternion", "<f8", 4),
        ("covariance_arcsec2", "<f4", 6),
        ("rate_deg_per_s", "<f4", 3),
        ("bias_deg_per_h", "<f4", 3),
        ("bias_sigma_deg_per_h", "<f4", 3),
        ("status", "u1", 1),
    ),
    MeasuredInnovations: (
        ("tai_ns", "<i8", 1),
        ("outcome", "u1", 1),
        ("innovation_arcsec", "<f4", 3),
        ("predicted_arcsec2", "<f4", 6),
        ("nis", "<f4", 1),
        ("measured_arcsec2", "<f4", 6),
        ("difference_arcsec", "<f4", 3),
        ("difference_sigma_arcsec", "<f4", 3),
    ),
}
"""Name, type and columns of each field; the times come first."""
_NUMBERS = {"i": np.int64, "u": np.int64, "f": np.float64}


def packed(samples: GradedSamples | MeasuredInnovations) -> bytes:
    """The compressed bytes of samples."""
    parts = []
    for name, kind, _ in _FIELDS[type(samples)]:
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
    return _unpacked(GradedSamples, data, samples)


def unpacked_innovations(data: bytes, measurements: int) -> MeasuredInnovations:
    """So many measurements that `packed` was given; raises `ValueError` as `unpacked`."""
    return _unpacked(MeasuredInnovations, data, measurements)


def _unpacked(of: type[Packable], data: bytes, samples: int) -> Packable:
    try:
        raw = np.frombuffer(zlib.decompress(data), np.uint8)
    except zlib.error as error:
        raise ValueError(f"cannot be decompressed: {error}") from None
    each = sum(np.dtype(kind).itemsize * columns for _, kind, columns in _FIELDS[of])
    if raw.size != samples * each:
        raise ValueError(f"{raw.size} bytes are not {samples} samples")
    found: dict[str, Any] = {}
    at = 0
    for name, kind, columns in _FIELDS[of]:
        dtype = np.dtype(kind)
        size = dtype.itemsize * columns * samples
        shuffled = raw[at : at + size].reshape(dtype.itemsize, -1)
        values = np.ascontiguousarray(shuffled.T).view(dtype).reshape(columns, samples).T
        values = np.ascontiguousarray(values, _NUMBERS[dtype.kind])
        found[name] = values if columns > 1 else values[:, 0]
        at += size
    found["tai_ns"] = np.cumsum(found["tai_ns"])
    return of(**found)
