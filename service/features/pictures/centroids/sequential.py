"""Linear estimation, one measurement at a time (report, part VI).

A measurement is r = c . A + k: a row c, a constant state A, noise k. This module has the report's
estimators for that model; the rows for a star's image are in
`studies.star_image_report.measurements`.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.features.pictures.centroids.window import Array


@dataclass(frozen=True)
class StateEstimate:
    """Estimate of a constant state (m,), its covariance (m, m), and its number of measurements."""

    state: Array
    covariance: Array
    measurements: int = 0

    @property
    def sigma(self) -> Array:
        """One standard deviation of each component of the state."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def updated(self, row: Array, value: float, variance: float) -> "StateEstimate":
        """The estimate of a state after one more scalar measurement (6.20, 6.26).

        Only a scalar is inverted. The report concludes that the covariance goes to zero because the
        matrices of 6.26 are positive definite; the subtracted one has rank one, and repeating one
        measurement teaches one direction only. The covariance goes to zero where the rows, summed
        as c^T c, grow without bound in every direction.
        """
        gain = self.covariance @ row
        spread = variance + float(row @ gain)
        gain_over = gain / spread
        state = self.state + gain_over * (value - float(row @ self.state))
        covariance = self.covariance - np.outer(gain_over, gain)
        return StateEstimate(state, 0.5 * (covariance + covariance.T), self.measurements + 1)

    def replayed(self, rows: Array, values: Array, variances: npt.ArrayLike) -> "StateEstimate":
        """The estimate of a state after many scalar measurements in sequence; rows (n, m)."""
        estimate = self
        for row, value, variance in zip(
            rows, values, np.broadcast_to(variances, values.shape), strict=True
        ):
            estimate = estimate.updated(row, float(value), float(variance))
        return estimate


def diffuse(sigmas: Iterable[float]) -> StateEstimate:
    """An initial estimate of a zero state with large prior sigmas, one per component."""
    spread = np.asarray(tuple(sigmas), dtype=np.float64)
    return StateEstimate(np.zeros(len(spread)), np.diag(spread**2))


def batch(rows: Array, values: Array, variances: npt.ArrayLike) -> StateEstimate:
    """Least-squares estimate from all measurements: (C^T Q C)^-1 C^T Q R, Q of 1/variance (6.13).

    Raises `numpy.linalg.LinAlgError` where the rows leave a direction unknown.
    """
    root = 1.0 / np.sqrt(np.broadcast_to(variances, values.shape))
    weighted = rows * root[:, None]
    if np.linalg.matrix_rank(weighted) < rows.shape[1]:
        raise np.linalg.LinAlgError(
            f"{rows.shape[1]} unknowns, but the measurements tell only "
            f"{np.linalg.matrix_rank(weighted)} of them apart"
        )
    covariance = np.linalg.inv(weighted.T @ weighted)
    return StateEstimate(covariance @ weighted.T @ (values * root), covariance, len(values))
