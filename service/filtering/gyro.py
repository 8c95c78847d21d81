"""The noise of a gyro, and what the filter assumes where there is none.

The gyro gives w_measured = (I + M) w_true + b + n_v, db/dt = n_u, in body axes
(Farrenkopf's model).  n_v and n_u are white with densities sigma_v^2 and
sigma_u^2; M holds small constant errors of scale (its diagonal) and of alignment.
"""

import math
from dataclasses import dataclass, fields

from service.errors import BadInput, Fault, shown_value
from service.missions.motion import FIRST_BIAS_RAD_S, LARGEST_RATE_DEG_PER_S, RATE_RAD_S


@dataclass(frozen=True)
class GyroModel:
    """One sigma of each error of a gyro, the same for its three axes.

    `sigma_v_rad_s0_5` is the angle random walk in rad/s^.5, `sigma_u_rad_s1_5`
    the walk of the bias in rad/s^1.5, `bias_sigma_rad_s` the bias when nothing is
    known of it.  `scale` and `misalignment_rad` are the errors that calibration
    left: as M is constant, they shift the bias where the rate changes, and the
    filter widens the bias there.

    An interval between samples longer than `largest_step_s` is a gap: the rate is
    taken from the samples on both sides, as a random walk of `coast_rad_s1_5`, and
    the clock may have stepped by `clock_step_s`.  Samples beyond
    `largest_rate_rad_s` are refused.

    Quantisation of the angle is not modelled: it has to be small beside the trackers' noise.
    """

    sigma_v_rad_s0_5: float
    sigma_u_rad_s1_5: float
    bias_sigma_rad_s: float = FIRST_BIAS_RAD_S
    scale: float = 0.0
    misalignment_rad: float = 0.0
    largest_step_s: float = 1.5
    largest_rate_rad_s: float = math.radians(LARGEST_RATE_DEG_PER_S)
    coast_rad_s1_5: float = 1e-4
    clock_step_s: float = 1.0

    def __post_init__(self) -> None:
        faults = [
            Fault(f"gyro.{each.name}", "must be a number from 0 to 1e6", shown_value(value))
            for each in fields(self)
            if not 0.0 <= (value := getattr(self, each.name)) <= 1e6
        ]
        if not faults and self.largest_step_s == 0.0:
            faults.append(Fault("gyro.largest_step_s", "must be more than 0", "0.0"))
        if faults:
            raise BadInput(faults)


@dataclass(frozen=True)
class ConstantRateModel:
    """Motion without a gyro: the rate in body axes is constant but for a random walk.

    `rate_walk_rad_s1_5` is the density of that walk in rad/s^1.5, `rate_sigma_rad_s`
    one sigma of the rate when nothing is known of it.

    The filter then runs with a measured rate of zero, so that **the bias is minus the
    rate**: w_true = 0 - b.
    """

    rate_walk_rad_s1_5: float
    rate_sigma_rad_s: float = RATE_RAD_S

    def as_gyro(self) -> GyroModel:
        """The gyro that always reads zero and whose bias is minus the rate; it has no gaps."""
        return GyroModel(
            sigma_v_rad_s0_5=0.0,
            sigma_u_rad_s1_5=self.rate_walk_rad_s1_5,
            bias_sigma_rad_s=self.rate_sigma_rad_s,
            largest_step_s=1e6,
        )


@dataclass(frozen=True)
class FilterSettings:
    """When the filter rejects a measurement, and what it does when it rejects all of them.

    A measurement is rejected where chi-square passes its innovation with a
    probability below `gate_tail`.  A start is confirmed once the redundancy numbers of the
    measurements accepted since, each of which says how well the filter predicted one, add
    up to `start_redundancy`: about four measurements where the bias is known, six where
    it is not; at a constant rate each counts one.  Until then the gate of attitudes that
    were predicted is `start_gate_tail`, and one that is rejected starts the filter anew.
    `confirmations` accepted measurements in a row end a doubt.  After `reset_after_s` in
    which everything was rejected the filter gives up its own attitude and starts from the
    measurements: the default is longer than the hour for which a tracker may hold on to
    wrong stars.  A young attitude is given up as soon as more reject it in a row than its
    redundancy.  The first measurement accepted after a gap of the gyro multiplies the sum by
    its own redundancy number.
    An attitude with an axis worse than `lost_rad` is lost: the next one measured replaces it.
    """

    gate_tail: float = 1e-4
    start_gate_tail: float = 1e-3
    start_redundancy: float = 2.0
    confirmations: int = 3
    reset_after_s: float = 7200.0
    lost_rad: float = math.radians(17.0)

    def __post_init__(self) -> None:
        limits = {
            "gate_tail": (self.gate_tail, 1e-12, 0.5),
            "start_gate_tail": (self.start_gate_tail, 1e-12, 0.5),
            "start_redundancy": (self.start_redundancy, 0.0, 1000.0),
            "confirmations": (self.confirmations, 1, 1000),
            "reset_after_s": (self.reset_after_s, 0.0, 1e7),
            "lost_rad": (self.lost_rad, 1e-6, 1.0),
        }
        faults = [
            Fault(f"filter.{name}", f"must be from {least:g} to {most:g}", shown_value(value))
            for name, (value, least, most) in limits.items()
            if not least <= value <= most
        ]
        if faults:
            raise BadInput(faults)
