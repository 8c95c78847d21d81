"""How the measured attitudes of a stretch met the filter, and how they differ from the smoother.

Both are what a page of grades shows and what noise is estimated from.  An innovation is the
rotation from the filter's prediction to the measurement.  A difference is that from the smoothed
attitude to the measurement: the smoother has used it, so their errors are correlated, and
the covariance of the difference is R - P; of a measurement that was not used it is R + P.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from service.filtering.inputs import AttitudeMeasurements
from service.filtering.result import AttitudeHistory, FilterResult, Integers, Outcome
from service.filtering.updates import ATTITUDE
from service.vectors import ARCSEC_PER_RADIAN, Vector, rotation_vectors

UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
"""Rows and columns of a symmetric (3, 3) as it is recorded: 11, 12, 13, 22, 23, 33."""


def full_matrices(upper: Vector) -> Vector:
    """Symmetric matrices (..., 3, 3) of their upper triangles (..., 6) in the order of `UPPER`."""
    full = upper[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]]
    return np.asarray(full.reshape(*upper.shape[:-1], 3, 3))


@dataclass(frozen=True, eq=False)
class TimedColumns:
    """Columns of equal length, the first of which are times."""

    tai_ns: Integers

    def __len__(self) -> int:
        return len(self.tai_ns)

    def taken(self, places: Any) -> Self:
        """The rows at some places."""
        return type(self)(**{each.name: getattr(self, each.name)[places] for each in fields(self)})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The rows of parts, one after the other."""
        columns = (each.name for each in fields(cls))
        return cls(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in columns})


@dataclass(frozen=True, eq=False)
class MeasuredInnovations(TimedColumns):
    """The innovations of m measured attitudes, in order of time; equal times are allowed.

    `tai_ns` (m,) and `outcome` (m,), a `filtering.result.Outcome`.  About the body axes in
    arcsec: `innovation_arcsec` (m, 3) with its covariance `predicted_arcsec2` (m, 6), the upper
    triangle 11, 12, 13, 22, 23, 33, and `nis` (m,) z^T S^-1 z of three degrees of freedom, which
    are NaN of a measurement that met no prediction; `measured_arcsec2` (m, 6) of the
    measurement alone; `difference_arcsec` (m, 3) from the smoothed attitude to the
    measurement, and one sigma of it (m, 3).
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
        """The measurements (m,) that the filter took: it was accepted, or began with it."""
        return _used(self.outcome)

    @property
    def innovation_sigma_arcsec(self) -> Vector:
        """One sigma (m, 3) of each component of the innovation."""
        return np.asarray(np.sqrt(self.predicted_arcsec2[:, [0, 3, 5]]))


def innovations_of(
    attitudes: AttitudeMeasurements,
    result: FilterResult,
    smoothed: AttitudeHistory,
    start_ns: int,
    end_ns: int,
) -> MeasuredInnovations:
    """The innovations of the measured attitudes of a stretch from `start_ns` to before `end_ns`.

    `attitudes` are those that the filter was given; single directions are left out.
    """
    met = result.innovations
    chosen = np.flatnonzero(
        (met.kind == ATTITUDE) & (met.tai_ns >= start_ns) & (met.tai_ns < end_ns)
    )
    row, outcome = met.row[chosen], met.outcome[chosen]
    # Every measurement is an epoch.
    epoch = np.searchsorted(smoothed.tai_ns, met.tai_ns[chosen])
    measured = attitudes.covariance_rad2[row]
    own = smoothed.model_covariance[epoch, :3, :3]
    used = _used(outcome)
    axes = np.arange(3)
    apart = measured[:, axes, axes] + np.where(used, -1.0, 1.0)[:, None] * own[:, axes, axes]
    apart += smoothed.doubt_rad[epoch, None] ** 2
    turned = rotation_vectors(smoothed.quaternion[epoch], attitudes.quaternion[row])
    return MeasuredInnovations(
        met.tai_ns[chosen],
        outcome,
        met.innovation_rad[chosen] * ARCSEC_PER_RADIAN,
        met.covariance_rad2[chosen][:, *UPPER] * ARCSEC_PER_RADIAN**2,
        met.nis[chosen],
        measured[:, *UPPER] * ARCSEC_PER_RADIAN**2,
        turned * ARCSEC_PER_RADIAN,
        np.sqrt(np.maximum(apart, 0.0)) * ARCSEC_PER_RADIAN,
    )


def _used(outcome: Integers) -> npt.NDArray[np.bool_]:
    return np.asarray((outcome == Outcome.ACCEPTED) | (outcome == Outcome.STARTED))
