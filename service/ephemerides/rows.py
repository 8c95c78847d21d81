"""Attitudes of batches or of a filter by columns, in order of time."""

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from service.vectors import Vector

Integers = npt.NDArray[np.int64]
Texts = npt.NDArray[np.object_]

SAME_MOMENT_NS = 1_000
"""The last of attitudes closer than this counts: clocks of kernels have 1 us."""


@dataclass(frozen=True)
class AttitudeRows:
    """Results of batches in order of time, a row each, as they are recorded.

    `status` is None and the numbers are NaN where a batch has no attitude; `rate_deg_per_s`
    is NaN where the batch came without one.  `time_ns` is `Utc.tai_ns`.

    Of filtered and smoothed attitudes a row is a sample: `id` is that of its day's revision,
    `batch` and the residuals there are none, and `stars` are zero.  They alone have a `model`,
    a `revision`, and the bias of the gyro with its sigma, (n, 3); of others these are None, 0 and
    NaN.
    """

    time_ns: Integers
    time: Texts
    id: Texts
    batch: Texts
    status: Texts
    method: Texts
    quaternion: Vector
    covariance_arcsec2: Vector
    """Covariances (n, 6): 11, 12, 13, 22, 23, 33."""
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
        """The rows at some places, or where a mask is true."""
        return replace(self, **{f.name: getattr(self, f.name)[places] for f in fields(self)})

    def followed_by(self, other: Self) -> Self:
        """These rows and then others."""
        pairs = {f.name: (getattr(self, f.name), getattr(other, f.name)) for f in fields(self)}
        return replace(self, **{name: np.concatenate(pair) for name, pair in pairs.items()})
