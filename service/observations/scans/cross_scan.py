"""The cross-scan (report on star images, 7.2 to 7.5): a star's place from samples along a line.

`displacement` is where the star stands, plus the first moment over the sum.  The report
writes the image as Phi(u + a), whose star is at -a, and drops that minus in 7.4 to 7.6
and 7.17 to 7.22.  What the telescope must be moved by is minus the displacement.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.observations.scans.profile import BREAKDOWN_RATIO, moment


@dataclass(frozen=True)
class ScanResult:
    """A displacement with its sigma; no number where the light is below the breakdown ratio."""

    displacement: float
    sigma: float
    signal_ratio: float

    @property
    def refused(self) -> bool:
        """Whether the scan held too little light to have a variance at all (7.30)."""
        return math.isnan(self.displacement)


def cross_scan(
    samples: npt.ArrayLike,
    spacing: float,
    noise_sigma: float,
    background: float = 0.0,
    gain: float = math.inf,
) -> ScanResult:
    """D = T sum n Phi_n / sum Phi_n of samples n = -N ... N at steps of T (7.21, 7.22).

    `background` is taken off first; left in, it pulls every displacement towards zero.
    `gain` in photons per unit of Phi adds photon noise.
    """
    light = np.asarray(samples, dtype=np.float64) - background
    variance = np.full(light.shape, noise_sigma**2) + np.maximum(light + background, 0.0) / gain
    found = moment(light, variance)
    if not found.signal_ratio >= BREAKDOWN_RATIO:
        return ScanResult(math.nan, math.nan, found.signal_ratio)
    return ScanResult(
        spacing * found.displacement, spacing * math.sqrt(found.variance), found.signal_ratio
    )


def mean_of_scans(scans: npt.ArrayLike, spacing: float, noise_sigma: float) -> ScanResult:
    """M scans (M, samples) of one place: the mean of their displacements, 1/M of the variance.

    Each must hold enough light by itself, as in the report; where they do not, add the
    samples first.
    """
    each = [cross_scan(scan, spacing, noise_sigma) for scan in np.atleast_2d(scans)]
    m = len(each)
    return ScanResult(
        float(np.mean([one.displacement for one in each])),
        math.sqrt(sum(one.sigma**2 for one in each)) / m,
        float(min(one.signal_ratio for one in each)),
    )
