"""The error model of a gyro, and its samples as mean rates about the body axes.

The gyro gives w_measured = (I + M) w_true + b + n_v, db/dt = n_u, in body axes
(Farrenkopf's model).  n_v and n_u are white with densities sigma_v^2 and
sigma_u^2; M holds small constant errors of scale (its diagonal) and of alignment.

Times are nanoseconds of TAI as `Utc.tai_ns`.  Constructors raise `BadInput` naming the
fields and values at fault; of samples the field, the row and the value of the first fault.
"""

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault, shown_value
from service.interpolation import QUARTER_TURN_RAD
from service.missions.motion import FIRST_BIAS_RAD_S, LARGEST_RATE_DEG_PER_S, GyroSettings
from service.vectors import ARCSEC_PER_RADIAN, Vector, read_only, rotation_vectors

Times = npt.NDArray[np.int64]
GAP_IN_STEPS = 1.5
"""Step above which an interval is a gap, in median steps, unless the mission sets a limit."""
NS = 1e-9


@dataclass(frozen=True)
class GyroModel:
    """The error model of a gyro: one sigma of each error, the same for its three axes.

    `sigma_v_rad_s0_5` is the angle random walk in rad/s^.5, `sigma_u_rad_s1_5` the random walk of
    the bias in rad/s^1.5, `bias_sigma_rad_s` the initial uncertainty of the bias. `scale` and
    `misalignment_rad` are errors left by calibration: since M is constant, they shift the bias
    where the rate changes, and the filter enlarges the bias uncertainty there.

    An interval between samples longer than `largest_step_s` is a gap: the rate is interpolated from
    the samples on both sides, with a random walk of `coast_rad_s1_5`, and the clock may have
    stepped by `clock_step_s`. Samples beyond `largest_rate_rad_s` are refused.

    Quantisation of the angle is not modelled: it must be small compared with the trackers' noise.
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


@dataclass(frozen=True, eq=False)
class GyroSamples:
    """The samples of a gyro: `rate_rad_s` (n, 3) is the mean rate since the previous sample.

    Rates are about the body axes, times strictly increasing.
    """

    tai_ns: Times
    rate_rad_s: Vector

    def __post_init__(self) -> None:
        set_times(self, "gyro", strictly=True)
        set_values(self, "gyro", "rate_rad_s", (3,))

    def check(self, model: GyroModel) -> None:
        """Raise `BadInput` for rates beyond what the gyro can measure."""
        beyond = np.abs(self.rate_rad_s) > model.largest_rate_rad_s
        refuse_rows(
            "gyro.rate_rad_s",
            beyond.any(axis=1),
            f"must be at most {model.largest_rate_rad_s:g} rad/s in each axis; is it in deg/s?",
            self.rate_rad_s,
        )


def believed(settings: GyroSettings, rates_rad_s: Vector) -> npt.NDArray[np.bool_]:
    """True (n,) for rates (n, 3) about the gyro's axes that are within the mission's largest rate.

    Blocks with larger rates are refused on arrival, but the mission may have changed its limit
    since.
    """
    largest = math.radians(settings.largest_rate_deg_per_s)
    return np.asarray((np.abs(rates_rad_s) <= largest).all(axis=1))


BIAS_SIGMAS = 6.0
"""Multiple of a gyro bias's sigma that no bias exceeds."""


def turns_beside_bias(
    settings: GyroSettings,
    tai_ns: Times,
    quaternion: Vector,
    covariance_rad2: Vector,
    carried_rad_s: Vector | None = None,
) -> npt.NDArray[np.bool_]:
    """True (m - 1,) for the steps between m attitudes in which the body certainly rotated.

    The rotation exceeds what attitude errors and a gyro bias can explain for a body at rest. Where
    the rates (m, 3) sent with batches give more than a quarter turn, they are used instead, since
    attitudes may not show a full turn.
    """
    turn_rad = np.linalg.norm(rotation_vectors(quaternion[:-1], quaternion[1:]), axis=1)
    variance = np.trace(covariance_rad2, axis1=1, axis2=2)
    noise_rad = np.sqrt(variance[1:] + variance[:-1])
    step_s = np.diff(tai_ns) * NS
    if carried_rad_s is not None:
        fastest = np.linalg.norm(carried_rad_s, axis=1)
        told_rad = np.maximum(fastest[1:], fastest[:-1]) * step_s
        turn_rad = np.maximum(turn_rad, np.where(told_rad > QUARTER_TURN_RAD, told_rad, 0.0))
    drift_rad = settings.bias_sigma_rad_s * step_s
    return np.asarray(turn_rad > BIAS_SIGMAS * (noise_rad + drift_rad))


def gyro_samples(
    settings: GyroSettings, tai_ns: Times, rates_rad_s: Vector
) -> tuple[GyroModel, GyroSamples]:
    """Error model of a gyro, and its samples in an interval as mean rates about the body axes.

    `tai_ns` (n,) are sorted, and `rates_rad_s` (n, 3) are as recorded, about the gyro's axes.
    """
    step_s = np.diff(tai_ns) * NS
    largest_step_s = settings.largest_step_s
    if largest_step_s is None:
        largest_step_s = GAP_IN_STEPS * float(np.median(step_s)) if len(step_s) else 1.0
    body = rates_rad_s @ settings.body_from_gyro.T
    if settings.samples == "instant":
        # Across a gap the filter itself takes the mean of both sides.
        between = 0.5 * (body[1:] + body[:-1])
        body = np.vstack([body[:1], np.where(step_s[:, None] > largest_step_s, body[1:], between)])
    widest = float(np.abs(settings.body_from_gyro).sum(axis=1).max())
    model = GyroModel(
        sigma_v_rad_s0_5=settings.sigma_v_rad_s0_5,
        sigma_u_rad_s1_5=settings.sigma_u_rad_s1_5,
        bias_sigma_rad_s=settings.bias_sigma_rad_s,
        scale=settings.scale,
        misalignment_rad=settings.misalignment_arcsec / ARCSEC_PER_RADIAN,
        largest_step_s=largest_step_s,
        # The mission's limit is about each gyro axis, the filter's about each body axis.
        largest_rate_rad_s=math.radians(settings.largest_rate_deg_per_s) * widest * (1.0 + 1e-9),
    )
    return model, GyroSamples(tai_ns, body)


def set_times(record: Any, name: str, strictly: bool = False) -> None:
    """Replace the times of a record by a checked copy, in rising order."""
    times = np.asarray(record.tai_ns)
    field = f"{name}.tai_ns"
    if times.ndim != 1 or times.dtype.kind not in "iu":
        expected = "must be whole nanoseconds in an array of one dimension"
        raise BadInput(Fault(field, expected, f"{times.dtype} of shape {times.shape}"))
    times = times.astype(np.int64)
    steps = np.diff(times)
    wrong = np.append(False, steps <= 0 if strictly else steps < 0)[: len(times)]
    later = "later than" if strictly else "no earlier than"
    refuse_rows(field, wrong, f"must be {later} the one before", times)
    object.__setattr__(record, "tai_ns", read_only(times))


def set_values(record: Any, name: str, field: str, shape: tuple[int, ...]) -> None:
    """Replace an array of a record by a copy with checked shape and finite numbers."""
    shown, expected = f"{name}.{field}", (len(record.tai_ns), *shape)
    try:
        values = np.array(getattr(record, field), dtype=np.float64)
    except (TypeError, ValueError):
        raise BadInput(Fault(shown, "must be an array of numbers")) from None
    if values.shape != expected:
        raise BadInput(Fault(shown, f"must have the shape {expected}", str(values.shape)))
    bad = ~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    refuse_rows(shown, bad, "must be finite numbers", values)
    object.__setattr__(record, field, read_only(values))


def refuse_rows(field: str, wrong: npt.ArrayLike, expected: str, values: npt.NDArray[Any]) -> None:
    """Raise `BadInput` for the first wrong row, with the number of wrong rows."""
    rows = np.flatnonzero(wrong)
    if len(rows):
        more = f"; {len(rows)} rows in all" if len(rows) > 1 else ""
        row = int(rows[0])
        value = shown_value(values[row].tolist())
        raise BadInput(Fault(f"{field}[{row}]", f"{expected}{more}", value))
