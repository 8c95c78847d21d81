"""Database records of filtered and smoothed days: a new revision if the input has changed."""
# Written by `make client` from service/features/definitive/records.py.

from collections.abc import Sequence

from ..base import Model
from ..words import Status


class Innovation(Model, frozen=True, kw_only=True):
    """Difference of a measured attitude from the filter's prediction and the smoothed attitude."""

    time: str
    outcome: str
    """`accepted` and `started` measurements were used; `started`: the filter started from it.
    `undecided`: the measurement agrees with two attitudes that contradict each other."""
    innovation_arcsec: Sequence[float] | None
    """Rotation vector from prediction to measurement, about the body axes; None: no prediction."""
    innovation_sigma_arcsec: Sequence[float] | None
    """One sigma of prediction and measurement together, about each body axis."""
    chi_square: float | None
    """Chi-square of the innovation, with three degrees of freedom: 3 on average."""
    difference_arcsec: Sequence[float]
    """Rotation vector from the smoothed attitude to the measured one, about the body axes."""
    difference_sigma_arcsec: Sequence[float]
    """One sigma of the difference; the smoothed attitude depends on the measured one."""
    model: str
    revision: int
    """Revision of the day."""


class DefinitiveJob(Model, frozen=True, kw_only=True):
    """A job that computes the definitive attitude: filtered and smoothed attitudes of days."""

    id: str
    spacecraft: str
    run: str
    start: str | None
    """None: from the first day with batches."""
    end: str | None
    """None: to the last."""
    who: str
    """`schedule`: the mission asks for it each day."""
    created: str
    ended: str | None
    state: str
    done: int
    """Days that are finished."""
    total: int
    """Days with batches; 0 until they are counted."""
    recorded: int
    """Days that got a new revision; the others had not changed."""
    fault: str | None


class LiveAttitude(Model, frozen=True, kw_only=True):
    """The filtered attitude at the last epoch of live data; use only with `status` good."""

    spacecraft: str
    time: str
    """Time of the last gyro sample or, without a gyro, measurement."""
    quaternion: Sequence[float]
    covariance_arcsec2: Sequence[Sequence[float]]
    rate_deg_per_s: Sequence[float]
    """Rate of the body relative to inertial space, in body axes."""
    bias_deg_per_h: Sequence[float] | None
    """Bias of the gyro, in body axes; None at a constant rate."""
    bias_sigma_deg_per_h: Sequence[float]
    """One sigma of the bias or, at a constant rate, of the rate."""
    status: Status
    """Status of the filtered attitude; `suspect`: contradicted or not confirmed yet."""
    model: str
