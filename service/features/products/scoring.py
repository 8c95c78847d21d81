"""Comparison of attitudes with true ones: errors per axis, and a check of the covariances.

An error is the small rotation from the true attitude to the estimated one, in arcseconds about the
body axes: `vectors.attitude_error_arcsec`.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.ephemerides.known import KnownAttitudes
from service.ephemerides.rows import Integers
from service.features.products.attitudes import AttitudeBlock
from service.vectors import ARCSEC_PER_RADIAN, Vector, full_matrices, rotation_vectors

AXES = ("x", "y", "z")
_SHARES = (50.0, 95.0, 99.0)


@dataclass(frozen=True)
class Errors:
    """Attitude errors (n, 3) at times (n,), with their predicted variances (n, 3).

    `normalized` (n,) is e^T P^-1 e, chi-square with three degrees of freedom if the covariances are
    right.  `outside` counts attitudes at times without a true one.
    """

    time_ns: Integers
    error_arcsec: Vector
    variance_arcsec2: Vector
    normalized: Vector
    outside: int

    @property
    def total_arcsec(self) -> Vector:
        """Angles (n,) between estimated and true attitudes, in arcsec."""
        return np.asarray(np.linalg.norm(self.error_arcsec, axis=1))


def errors_of(blocks: Iterable[AttitudeBlock], truth: KnownAttitudes) -> Errors:
    """Errors of attitudes against the true ones of a file, interpolated between its records."""
    parts: list[tuple[Integers, Vector, Vector, Vector]] = []
    outside = 0
    for block in blocks:
        true = truth.at(block.time_ns)
        known = ~np.isnan(true[:, 0])
        outside += int(np.count_nonzero(~known))
        error = rotation_vectors(true[known], block.quaternion[known]) * ARCSEC_PER_RADIAN
        covariance = full_matrices(block.covariance_arcsec2[known])
        # Not every covariance has an inverse: TRIAD's of two stars that nearly coincide.
        weights = np.linalg.pinv(covariance, hermitian=True)
        weighted = np.einsum("nij,nj->ni", weights, error)
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        parts.append((block.time_ns[known], error, variance, np.sum(error * weighted, axis=1)))
    if not parts:
        none = np.empty((0, 3))
        return Errors(np.empty(0, np.int64), none, none, np.empty(0), outside)
    columns: Any = zip(*parts, strict=True)
    time_ns, error, variance, normalized = (np.concatenate(each) for each in columns)
    return Errors(time_ns, error, variance, normalized, outside)


def statistics(errors: Errors) -> dict[str, Any]:
    """Statistics of attitude errors in arcseconds, as plain values; needs at least one error."""
    total = errors.total_arcsec
    return {
        "attitudes": len(total),
        "outside_truth": errors.outside,
        "axes": {
            axis: {
                "mean_arcsec": float(error.mean()),
                "std_arcsec": float(error.std()),
                "rms_arcsec": _rms(error),
                "predicted_rms_arcsec": float(np.sqrt(variance.mean())),
                **_percentiles(np.abs(error)),
            }
            for axis, error, variance in zip(
                AXES, errors.error_arcsec.T, errors.variance_arcsec2.T, strict=True
            )
        },
        "total": {"rms_arcsec": _rms(total), **_percentiles(total)},
        "normalized": {"mean": float(errors.normalized.mean()), "expected": 3.0},
        "histogram": histogram(errors),
    }


def histogram(errors: Errors) -> dict[str, Any]:
    """Histogram of attitude errors by axis, in equal bins up to a limit; larger ones in the end
    bins.

    The limit holds 99 of 100 errors, so that outliers do not compress the rest.
    """
    limit = float(np.percentile(np.abs(errors.error_arcsec), _SHARES[-1])) or 1.0
    edges = np.linspace(-limit, limit, 41)
    clipped = errors.error_arcsec.clip(-limit, limit)
    counts = {
        axis: np.histogram(column, edges)[0].tolist()
        for axis, column in zip(AXES, clipped.T, strict=True)
    }
    return {"edges_arcsec": edges.tolist(), **counts}


def _rms(values: Vector) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _percentiles(values: Vector) -> dict[str, float]:
    found = np.percentile(values, [*_SHARES, 100.0]).tolist()
    names = ("median_arcsec", "p95_arcsec", "p99_arcsec", "max_arcsec")
    return dict(zip(names, found, strict=True))
