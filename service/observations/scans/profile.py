"""The first moment of a line of samples: where the light of a star lies along it."""

import math
from dataclasses import dataclass

import numpy as np

from service.vectors import Vector

BREAKDOWN_RATIO = 5.0
"""Light over its noise below which a ratio of sums has no usable variance (report, 7.30)."""


@dataclass(frozen=True)
class ProfileMoment:
    """The first moment of one profile over its sum, in steps from its middle sample.

    `variance` is the full law sum (n - d)² sigma_n² / (sum)², of which the report's 7.36
    is the case of white noise without displacement and without photon noise.
    """

    displacement: float
    variance: float
    total: float
    total_variance: float

    @property
    def signal_ratio(self) -> float:
        """The sum over its own noise (7.30)."""
        return self.total / math.sqrt(self.total_variance) if self.total_variance > 0 else math.inf


def moment(samples: Vector, sample_variance: Vector, level_sigma: float = 0.0) -> ProfileMoment:
    """The moment of samples n = -N ... N; `level_sigma` is an error common to all of them."""
    steps = np.arange(len(samples), dtype=np.float64) - (len(samples) - 1) / 2.0
    total = float(samples.sum())
    displacement = float(steps @ samples) / total if total else math.nan
    arm = steps - displacement
    square = float(arm**2 @ sample_variance) + (level_sigma * float(arm.sum())) ** 2
    total_variance = float(sample_variance.sum()) + (level_sigma * len(samples)) ** 2
    variance = square / total**2 if total else math.inf
    return ProfileMoment(displacement, variance, total, total_variance)
