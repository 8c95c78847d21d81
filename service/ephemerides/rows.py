"""Table of attitudes of batches or of a filter, in order of time."""

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from service.vectors import Vector

Integers = npt.NDArray[np.int64]
Texts = npt.NDArray[np.object_]

SAME_MOMENT_NS = 1_000
"""Nanoseconds within which two attitudes count as simultaneous: kernels' clocks have 1 us."""


@dataclass(frozen=True)
class AttitudeRows:
    """Attitude results in order of time as columns, one row per batch or sample.

    `status` is None and the numbers are NaN for a batch without attitude; `rate_deg_per_s` is NaN
    for a batch without rates.  `time_ns` is `Utc.tai_ns`.

    For filtered and smoothed attitudes a row is a sample: `id` is that of its day's revision,
    `batch` and the residuals are missing, and `stars` are zero.  Only these rows have a `model`, a
    `revision`, and the gyro's bias with its sigma, (n, 3); otherwise None, 0 and NaN.
    """

    time_ns: Integers
    time: Texts
    id: Texts
    batch: Texts
    status: Texts
    method: Texts
    quaternion: Vector
    covariance_arcsec2: Vector
    """Upper triangles of the covariances (n, 6): 11, 12, 13, 22, 23, 33."""
    rate_deg_per_s: Vector
    residual_rms_arcsec: Vector
    predicted_rms_arcsec: Vector
    stars: Integers
    """Counts of stars (n, 4): observed, unique, ambiguous, unmatched."""
    model: Texts
    revision: Integers
    bias_deg_per_h: Vector
    bias_sigma_deg_per_h: Vector

    def __len__(self) -> int:
        return len(self.time_ns)

    def taken(self, places: Any) -> Self:
        """Table of the rows at given indices, or in a mask."""
        return replace(self, **{f.name: getattr(self, f.name)[places] for f in fields(self)})

    def followed_by(self, other: Self) -> Self:
        """Table with the rows of another one after its own."""
        pairs = {f.name: (getattr(self, f.name), getattr(other, f.name)) for f in fields(self)}
        return replace(self, **{name: np.concatenate(pair) for name, pair in pairs.items()})
