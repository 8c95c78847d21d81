"""Location of stars along a line of samples: first moments, the cross-scan, and maxima.

In the cross-scan (report on star images, 7.2 to 7.5), `displacement` is the star's position, with a
plus sign: the first moment over the sum. The report writes the image as Phi(u + a), whose star is
at -a, and drops that minus in 7.4 to 7.6 and 7.17 to 7.22. The telescope must be moved by minus the
displacement.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.vectors import Vector

BREAKDOWN_RATIO = 5.0
"""Least ratio of light to noise at which a ratio of sums has a usable variance (report, 7.30)."""


@dataclass(frozen=True)
class ProfileMoment:
    """The first moment of a line of samples over their sum, in steps from the middle one.

    `variance` is the full law sum (n - d)² sigma_n² / (sum)²; the report's 7.36 is the special case
    of white noise without displacement and photon noise.
    """

    displacement: float
    variance: float
    total: float
    total_variance: float

    @property
    def signal_ratio(self) -> float:
        """The ratio of a line's sum of samples to its own noise (7.30)."""
        return self.total / math.sqrt(self.total_variance) if self.total_variance > 0 else math.inf


def moment(samples: Vector, sample_variance: Vector, level_sigma: float = 0.0) -> ProfileMoment:
    """The normalised first moment of a line of samples; `level_sigma` is their common error."""
    steps = np.arange(len(samples), dtype=np.float64) - (len(samples) - 1) / 2.0
    total = float(samples.sum())
    displacement = float(steps @ samples) / total if total else math.nan
    arm = steps - displacement
    square = float(arm**2 @ sample_variance) + (level_sigma * float(arm.sum())) ** 2
    total_variance = float(sample_variance.sum()) + (level_sigma * len(samples)) ** 2
    variance = square / total**2 if total else math.inf
    return ProfileMoment(displacement, variance, total, total_variance)


@dataclass(frozen=True)
class ScanResult:
    """The displacement of a star along a scan with its sigma; NaN for too little light."""

    displacement: float
    sigma: float
    signal_ratio: float

    @property
    def refused(self) -> bool:
        """True if the scan held too little light for a displacement (7.30)."""
        return math.isnan(self.displacement)


def cross_scan(
    samples: npt.ArrayLike,
    spacing: float,
    noise_sigma: float,
    background: float = 0.0,
    gain: float = math.inf,
) -> ScanResult:
    """The displacement of a star along a scan, from its samples and their spacing (7.21, 7.22).

    `background` is subtracted first; otherwise it would bias displacements towards zero. `gain` in
    photons per unit of Phi adds photon noise.
    """
    light = np.asarray(samples, dtype=np.float64) - background
    variance = np.full(light.shape, noise_sigma**2) + np.maximum(light + background, 0.0) / gain
    found = moment(light, variance)
    if not found.signal_ratio >= BREAKDOWN_RATIO:
        return ScanResult(math.nan, math.nan, found.signal_ratio)
    return ScanResult(
        spacing * found.displacement, spacing * math.sqrt(found.variance), found.signal_ratio
    )


def line_peaks(sums: Vector, threshold: float) -> Vector:
    """Places of the maxima of `sums` above `threshold`, rising, in lines from the first one.

    A parabola through three sums refines each place to about half a line. Maxima in the first and
    last line are excluded.
    """
    padded = np.concatenate([[-np.inf], sums, [-np.inf]])
    before, middle, after = padded[:-2], padded[1:-1], padded[2:]
    at = np.flatnonzero((middle > threshold) & (middle > before) & (middle >= after))
    # Maxima without a deep valley between them belong to one noisy star.
    kept: list[int] = []
    for line in at.tolist():
        if kept and sums[kept[-1] : line + 1].min() > min(sums[kept[-1]], sums[line]) - threshold:
            kept[-1] = max(kept[-1], line, key=lambda each: float(sums[each]))
        else:
            kept.append(line)
    inner = [line for line in kept if 0 < line < len(sums) - 1]
    return np.array([line + _fine(sums, line) for line in inner])


def _fine(sums: Vector, at: int) -> float:
    before, middle, after = sums[at - 1 : at + 2]
    bend = before - 2.0 * middle + after
    return float(0.5 * (before - after) / bend) if bend < 0.0 else 0.0
