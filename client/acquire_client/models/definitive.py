"""Days of grades in the records: a new revision where the facts have changed, none otherwise."""
# Written by `make client` from service/features/definitive/records.py.

from collections.abc import Sequence

from ..base import Model
from ..words import Status


class Innovation(Model, frozen=True, kw_only=True):
    """How a measured attitude met the filter, and how it differs from the smoothed attitude."""

    time: str
    outcome: str
    """`accepted` and `started` measurements are used; `started`: with it the filter began.
    `undecided`: it agrees with two attitudes that contradict each other."""
    innovation_arcsec: Sequence[float] | None
    """From prediction to measurement, about the body axes; None: nothing was predicted."""
    innovation_sigma_arcsec: Sequence[float] | None
    """One sigma of prediction and measurement together."""
    chi_square: float | None
    """Chi-square of the innovation, with three degrees of freedom: 3 on average."""
    difference_arcsec: Sequence[float]
    """From the smoothed attitude to the measured one, about the body axes."""
    difference_sigma_arcsec: Sequence[float]
    """One sigma; the smoothed attitude is partly made of the measured one."""
    model: str
    revision: int
    """Revision of the day."""


class DefinitiveJob(Model, frozen=True, kw_only=True):
    """The making of a definitive attitude: filtered and smoothed attitudes of recorded days."""

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
    """The filtered attitude at the last epoch of live data; use it only where `status` is good."""

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
    """`suspect`: measurements contradict it, or have not confirmed it yet."""
    model: str
