"""The definitive attitude as recorded: filtered and smoothed samples of a UTC day.

An innovation is the rotation from the filter's prediction to a measured attitude. A difference is
the rotation from the smoothed attitude to the measurement. The smoother has used the measurement,
so that their errors are correlated and the covariance of the difference is R - P; for an unused
measurement it is R + P. The page of the definitive attitude shows both, and noise is estimated from
them.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any, Literal, Self, TypeVar

import numpy as np
import numpy.typing as npt

from service.times import DAY_S, Utc, bucket_start
from service.vectors import Vector

Integers = npt.NDArray[np.int64]
Grade = Literal["filtered", "smoothed"]
Model = Literal["gyro", "constant_rate"]
GRADES: tuple[Grade, ...] = ("filtered", "smoothed")


class Status(IntEnum):
    """The quality of a definitive attitude.

    NONE: no attitude was measured yet.  STARTING: started, and not yet confirmed by
    further measurements.  GOOD.  DOUBTFUL: the last measurements contradict the
    attitude, and one of both is wrong.  LOST: too long without measurements.
    """

    NONE = 0
    STARTING = 1
    GOOD = 2
    DOUBTFUL = 3
    LOST = 4


class Outcome(IntEnum):
    """The outcome of a measured attitude in the filter.

    UNUSED: a direction measured before there was an attitude. UNDECIDED: the measurement agrees
    both with the attitude and with another that contradicted it, and was not used.
    """

    UNUSED = 0
    ACCEPTED = 1
    REJECTED = 2
    STARTED = 3
    UNDECIDED = 4


@dataclass(frozen=True, eq=False)
class TimedColumns:
    """Columns of equal length, beginning with times."""

    tai_ns: Integers

    def __len__(self) -> int:
        return len(self.tai_ns)

    def taken(self, places: Any) -> Self:
        """The same columns with the rows at given indices only."""
        return type(self)(**{each.name: getattr(self, each.name)[places] for each in fields(self)})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The columns of several tables one after another, in one table."""
        columns = (each.name for each in fields(cls))
        return cls(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in columns})


@dataclass(frozen=True, eq=False)
class MeasuredInnovations(TimedColumns):
    """The innovations of m measured attitudes in order of time; equal times are allowed.

    `tai_ns` (m,) and `outcome` (m,), an `Outcome`. About the body axes in arcsec:
    `innovation_arcsec` (m, 3) with its covariance `predicted_arcsec2` (m, 6), the upper triangle
    11, 12, 13, 22, 23, 33, and `nis` (m,) z^T S^-1 z of three degrees of freedom, which are NaN for
    a measurement without a prediction; `measured_arcsec2` (m, 6) is the covariance of the
    measurement alone; `difference_arcsec` (m, 3) from the smoothed attitude to the measurement, and
    one sigma of that difference (m, 3).
    """

    outcome: Integers
    innovation_arcsec: Vector
    predicted_arcsec2: Vector
    nis: Vector
    measured_arcsec2: Vector
    difference_arcsec: Vector
    difference_sigma_arcsec: Vector

    @property
    def is_used(self) -> npt.NDArray[np.bool_]:
        """True for measurements (m,) that the filter used: accepted, or used for a start."""
        return was_used(self.outcome)

    @property
    def innovation_sigma_arcsec(self) -> Vector:
        """One sigma (m, 3) of each component of the innovations, in arcsec."""
        return np.asarray(np.sqrt(self.predicted_arcsec2[:, [0, 3, 5]]))


def was_used(outcome: Integers) -> npt.NDArray[np.bool_]:
    """True for outcomes (m,) of measurements used by the filter: accepted, or used for a start."""
    return np.asarray((outcome == Outcome.ACCEPTED) | (outcome == Outcome.STARTED))


@dataclass(frozen=True, eq=False)
class DefinitiveSamples(TimedColumns):
    """Attitude samples of one continuous interval and one kind (filtered or smoothed).

    `tai_ns` (n,), `quaternion` (n, 4) inertial to body, `covariance_arcsec2` (n, 6) of the small
    error rotation about the body axes (11, 12, 13, 22, 23, 33), `rate_deg_per_s` (n, 3) of the body
    in the step that ends at the sample, `bias_deg_per_h` (n, 3) of the gyro and
    `bias_sigma_deg_per_h` (n, 3); `status` (n,) is a `Status`. Without a gyro, for the
    constant-rate model, there is no bias, and the sigma is that of the rate.
    """

    quaternion: Vector
    covariance_arcsec2: Vector
    rate_deg_per_s: Vector
    bias_deg_per_h: Vector
    bias_sigma_deg_per_h: Vector
    status: Integers


def day_bounds(day: int) -> tuple[Utc, Utc]:
    """The beginning of a UTC day, numbered as `Utc.bucket`, and of the next day."""
    return bucket_start(day, DAY_S), bucket_start(day + 1, DAY_S)


# Compression of samples and innovations to bytes, and back. Times and quaternions keep every bit,
# other values the seven digits of a float32. Bytes of equal weight are stored together, so that
# signs and exponents, which hardly change, take little room.

Packable = TypeVar("Packable", DefinitiveSamples, MeasuredInnovations)
Fields = tuple[tuple[str, str, int], ...]

LEVEL = 1
"""Compression level of zlib; level 6 takes five times as long for about 3 % less."""
MOST_PACKED = 3_600
"""Largest number of samples in a compressed block: an hour."""
_FIELDS: dict[type, Fields] = {
    DefinitiveSamples: (
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
"""Name, type and number of columns of each stored field, the times first."""
_NUMBERS = {"i": np.int64, "u": np.int64, "f": np.float64}


def packed(samples: DefinitiveSamples | MeasuredInnovations) -> bytes:
    """Compressed bytes of attitude samples or innovations, the reverse of unpacking them."""
    parts = []
    for name, kind, _ in _FIELDS[type(samples)]:
        values = np.asarray(getattr(samples, name)).T
        if kind == "<i8":
            # Time steps are similar, times are not.
            values = np.diff(values, prepend=0)
        each = np.ascontiguousarray(values, kind)
        parts.append(each.view(np.uint8).reshape(-1, each.itemsize).T.tobytes())
    return zlib.compress(b"".join(parts), LEVEL)


def unpacked(data: bytes, samples: int) -> DefinitiveSamples:
    """Unpack `samples` samples, the reverse of `packed`.

    Raises `ValueError` for bytes that are damaged or hold another number of samples.
    """
    return _unpacked(DefinitiveSamples, data, samples)


def unpacked_innovations(data: bytes, measurements: int) -> MeasuredInnovations:
    """Unpack `measurements` innovations from bytes; raises `ValueError` as `unpacked` does."""
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
