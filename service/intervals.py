"""Estimates with 95 % intervals, for values that come in clusters (batches).

Stars of a batch share its attitude and its time, so a thousand pairs of a hundred batches are not a
thousand independent ones.  Every interval here accounts for batches: it is widened by the
correlation within a batch (Kish's design effect, or a sandwich covariance over batches).
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.vectors import Vector

Z95 = 1.959963984540054
"""97.5 % point of the standard normal distribution, for two-sided 95 % intervals."""
HUBER = 1.345
"""Bound of Huber's weight in sigmas, with 95 % efficiency for Gaussian errors."""
ROUNDS = 50

Clusters = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Interval:
    """An estimate with the bounds of its 95 % confidence interval."""

    value: float
    low: float
    high: float

    def scaled(self, factor: float) -> "Interval":
        """Interval of the estimate multiplied by a positive factor."""
        return Interval(self.value * factor, self.low * factor, self.high * factor)

    def moved(self, by: float) -> "Interval":
        """Interval of the estimate plus a constant."""
        return Interval(self.value + by, self.low + by, self.high + by)

    def differs(self, other: "Interval") -> bool:
        """True if the two intervals have no value in common."""
        return self.low > other.high or self.high < other.low

    def holds(self, value: float) -> bool:
        """True if a value lies within the confidence interval."""
        return self.low <= value <= self.high


def wilson(share: float, count: float) -> Interval:
    """Wilson score interval of a share, from `count` independent trials."""
    z2 = Z95 * Z95 / count
    centre = (share + z2 / 2.0) / (1.0 + z2)
    half = Z95 * math.sqrt(share * (1.0 - share) / count + z2 / (4.0 * count)) / (1.0 + z2)
    return Interval(share, max(0.0, centre - half), min(1.0, centre + half))


def effective_count(marks: npt.NDArray[np.bool_], cluster: Clusters) -> float:
    """Effective number of independent trials in clustered boolean values (n,)."""
    excess = np.bincount(cluster, weights=marks - marks.mean()).astype(float)
    return _effective(float(marks.mean()), len(marks), excess, len(np.unique(cluster)))


def _effective(share: float, n: int, excess: Vector, clusters: int) -> float:
    """Effective number of n trials; `excess` is by how much each cluster exceeds the share."""
    if share in (0.0, 1.0):
        return float(n)
    if clusters < 2:
        return 1.0
    variance = float(excess @ excess) * clusters / (clusters - 1) / n**2
    # At most the actual number: a negative correlation within batches is taken as chance.
    return min(float(n), share * (1.0 - share) / variance) if variance > 0 else float(n)


def share_of(marks: npt.NDArray[np.bool_], cluster: Clusters) -> Interval:
    """Share of true values among (n,), with a 95 % interval; clusters (n,) number the batches."""
    return wilson(float(marks.mean()), effective_count(marks, cluster))


def share_of_sums(marked: Vector, whole: Vector) -> Interval:
    """Share with a 95 % interval, from the counts of clusters (n,) of which none is empty."""
    n, share = int(whole.sum()), float(marked.sum() / whole.sum())
    return wilson(share, _effective(share, n, marked - share * whole, len(whole)))


def quantile(values: Vector, cluster: Clusters, share: float) -> Interval:
    """Quantile of clustered values, with Woodruff's interval.

    The bounds are the quantiles at the bounds of the share.  `high` is infinite if the sample is
    too small to bound it.
    """
    at = float(np.quantile(values, share))
    bounds = wilson(share, effective_count(values <= at, cluster))
    # The sample shows nothing of the distribution above its largest values.
    bounded = bounds.high * len(values) <= len(values) - 1
    return Interval(
        at,
        float(np.quantile(values, bounds.low)),
        float(np.quantile(values, bounds.high)) if bounded else math.inf,
    )


def median(values: Vector, confidence: float = 0.95) -> Interval:
    """Median of independent values (n,) with the interval of the sign test, for any distribution.

    The bounds are infinite with too few values for that confidence (95 %: below six).
    """
    # Of `scipy.stats`, which has this quantile of the binomial, the import alone takes seconds.
    from scipy.special import bdtr, bdtrik

    n = len(values)
    ordered = np.sort(values)
    at = float(np.median(values))
    # The true median lies outside the k-th values from either end with at most the rest.
    tail = (1.0 - confidence) / 2.0
    k = math.ceil(bdtrik(tail, n, 0.5)) if n else 0
    if k >= 1 and bdtr(k - 1, n, 0.5) >= tail:
        k -= 1
    if k < 1:
        return Interval(at, -math.inf, math.inf)
    return Interval(at, float(ordered[k - 1]), float(ordered[n - k]))


def robust_fit(design: Vector, values: Vector, cluster: Clusters) -> tuple[Vector, Vector]:
    """Coefficients (p,) of a robust linear fit and their covariance (p, p).

    Huber's M-estimate of values (n,) on the design (n, p) by reweighted least squares; the
    covariance is the sandwich estimate over clusters (n,).
    """
    beta = _least_squares(design, values)
    weight = np.ones(len(values))
    for _ in range(ROUNDS):
        residual = values - design @ beta
        sigma = max(1.4826 * float(np.median(np.abs(residual))), 1e-300)
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(residual) / sigma, 1e-300))
        before, root = beta, np.sqrt(weight)[:, None]
        beta = _least_squares(design * root, values * root[:, 0])
        if np.allclose(beta, before, rtol=1e-10, atol=1e-12 * sigma):
            break
    residual = values - design @ beta
    sigma = max(1.4826 * float(np.median(np.abs(residual))), 1e-300)
    inside = np.abs(residual) <= HUBER * sigma
    bread = np.linalg.inv(design[inside].T @ design[inside])
    scores = design * (weight * residual)[:, None]
    groups = int(cluster.max()) + 1
    sums = np.stack(
        [np.bincount(cluster, weights=column, minlength=groups) for column in scores.T], axis=1
    )
    used = max(len(np.unique(cluster)), 2)
    return beta, np.asarray(bread @ (sums.T @ sums) @ bread * used / (used - 1))


def _least_squares(design: Vector, values: Vector) -> Vector:
    return np.asarray(np.linalg.lstsq(design, values, rcond=None)[0], dtype=np.float64)


def intervals(beta: Vector, covariance: Vector) -> list[Interval]:
    """Coefficients of a fit with their 95 % intervals."""
    half = Z95 * np.sqrt(np.diag(covariance))
    return [Interval(float(b), float(b - h), float(b + h)) for b, h in zip(beta, half, strict=True)]
