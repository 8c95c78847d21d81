"""The input of the filter: recorded measurements and gyro samples, in unbroken stretches."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from service.attitude.prediction import NS
from service.features.definitive.kernels.inputs import (
    LARGEST_SIGMA_RAD,
    AttitudeMeasurements,
    ConstantRateModel,
    DirectionMeasurements,
    FilterSettings,
)
from service.gyro.blocks import Nanoseconds
from service.gyro.samples import GyroModel, GyroSamples, believed, gyro_samples, turns_beside_bias
from service.interpolation import QUARTER_TURN_RAD
from service.missions.mission import Mission
from service.missions.motion import GyroSettings, MotionSettings
from service.vectors import ARCSEC_PER_RADIAN, Vector, full_matrices

LONGEST_GAP_S = 600.0
"""A longer gap ends a stretch; what an attitude is worth is gone by then."""
_LONGEST_GAP_NS = int(LONGEST_GAP_S) * 10**9


@dataclass(frozen=True, eq=False)
class Stretch:
    """The filter's input of an unbroken stretch.

    At a constant rate `gyro` is None, or the rates that the batches of a spinning body carried.
    """

    model: GyroModel | ConstantRateModel
    gyro: GyroSamples | None
    attitudes: AttitudeMeasurements
    directions: DirectionMeasurements

    @property
    def begin_ns(self) -> int:
        """The first moment."""
        times = [] if self.gyro is None else [self.gyro.tai_ns]
        times += [self.attitudes.tai_ns, self.directions.tai_ns]
        return min(int(each[0]) for each in times if len(each))


@dataclass(frozen=True, eq=False)
class Cut:
    """The stretches of a window in order of time, and what is in none of them.

    `beyond_largest` counts gyro samples beyond the mission's largest rate, `not_given` samples of
    zeros while the body turned, `alone` the measurements that are too few to confirm an attitude
    at a constant rate.
    """

    stretches: list[Stretch]
    beyond_largest: int
    not_given: int
    alone: int


Mask = npt.NDArray[np.bool_]
LEAST_RATIO = 1e-10
"""The least ratio of smallest to largest variance: a covariance below it is as good as singular."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """Gyro samples and measurements of a window, each in order of time.

    `gyro_ns` (n,) and `rates_rad_s` (n, 3) are as recorded, about the gyro's axes.  Of m
    attitudes those are left out whose covariance says nothing, and counted in `unusable`.
    `carried_rad_s` (m, 3) are the rates about the body axes that the batches of the attitudes
    carried, zeros where none; None where none carried any.
    """

    gyro_ns: Nanoseconds
    rates_rad_s: Vector
    attitudes: AttitudeMeasurements
    directions: DirectionMeasurements
    unusable: int = 0
    carried_rad_s: Vector | None = None


RATE_SIGMAS = 3.0
"""A body that turns faster than so many of the mission's sigmas is not found by its attitudes."""


def rates_of_use(model: ConstantRateModel, tai_ns: Nanoseconds, carried_rad_s: Vector) -> bool:
    """True if the attitudes of a body at times (m,) do not tell how it turns at rates (m, 3).

    The filter does not expect it to turn so fast.  Where it makes more than a quarter turn between
    two of them, they leave open how many turns and which way round.
    """
    fastest = np.linalg.norm(carried_rad_s, axis=1)
    turn = np.maximum(fastest[1:], fastest[:-1]) * np.diff(tai_ns) * NS
    is_fast = fastest > RATE_SIGMAS * model.rate_sigma_rad_s
    return bool(is_fast.any() or (turn > QUARTER_TURN_RAD).any())


def arrays_of(
    attitudes: AttitudeMeasurements, directions: DirectionMeasurements
) -> Sequence[npt.NDArray[Any]]:
    """All arrays of measurements, as digests take them in."""
    return (
        attitudes.tai_ns,
        attitudes.quaternion,
        attitudes.covariance_rad2,
        directions.tai_ns,
        directions.body,
        directions.inertial,
        directions.sigma_rad,
    )


def usable_attitudes(
    tai_ns: Nanoseconds, quaternion: Vector, covariance_arcsec2: Vector
) -> tuple[AttitudeMeasurements, Mask]:
    """The attitudes with a sound covariance, and marks (m,) of those among all.

    `covariance_arcsec2` (m, 6) is the upper triangle: 11, 12, 13, 22, 23, 33.
    """
    full = full_matrices(covariance_arcsec2) / ARCSEC_PER_RADIAN**2
    sound: Mask = np.asarray(np.isfinite(full).all(axis=(1, 2)))
    sound &= np.asarray(np.isfinite(quaternion).all(axis=1))
    variances = np.linalg.eigvalsh(np.where(sound[:, None, None], full, np.eye(3)))
    sound &= variances[:, 0] > LEAST_RATIO * variances[:, 2]
    sound &= variances[:, 2] < LARGEST_SIGMA_RAD**2
    norm = np.linalg.norm(quaternion[sound], axis=1, keepdims=True)
    kept = AttitudeMeasurements(tai_ns[sound], quaternion[sound] / norm, full[sound])
    return kept, sound


def attitudes_where(attitudes: AttitudeMeasurements, places: Any) -> AttitudeMeasurements:
    """Some of the attitudes."""
    return AttitudeMeasurements(
        attitudes.tai_ns[places], attitudes.quaternion[places], attitudes.covariance_rad2[places]
    )


def directions_where(directions: DirectionMeasurements, places: Any) -> DirectionMeasurements:
    """Some of the directions."""
    return DirectionMeasurements(
        directions.tai_ns[places],
        directions.body[places],
        directions.inertial[places],
        directions.sigma_rad[places],
    )


def cut(recorded: Recorded, mission: Mission) -> Cut:
    """The stretches of a window.

    Where a gyro runs without a gap of `LONGEST_GAP_S`, a stretch has its samples, and the
    measurements from its first sample to its last.  Measurements outside have stretches at a
    constant rate, which the same gap ends.
    """
    stretches: list[Stretch] = []
    attitude_ns, direction_ns = recorded.attitudes.tai_ns, recorded.directions.tai_ns
    left_a, left_d = np.ones(len(attitude_ns), bool), np.ones(len(direction_ns), bool)
    beyond = not_given = 0
    edges: list[int] = []
    if mission.gyro is not None and len(recorded.gyro_ns):
        kept = believed(mission.gyro, recorded.rates_rad_s)
        beyond = int(np.count_nonzero(~kept))
        none = zeros_while_turning(mission.gyro, recorded)
        not_given = int(np.count_nonzero(none))
        kept &= ~none
        times, rates = recorded.gyro_ns[kept], recorded.rates_rad_s[kept]
        for part in _unbroken(times):
            model, gyro = gyro_samples(mission.gyro, times[part], rates[part])
            first, last = int(gyro.tai_ns[0]), int(gyro.tai_ns[-1])
            edges += [first, last]
            of_a, of_d = _within(attitude_ns, first, last), _within(direction_ns, first, last)
            left_a &= ~of_a
            left_d &= ~of_d
            stretches.append(
                Stretch(
                    model,
                    gyro,
                    attitudes_where(recorded.attitudes, of_a),
                    directions_where(recorded.directions, of_d),
                )
            )
    alone = 0
    for of_a, of_d in _without_gyro(attitude_ns, direction_ns, left_a, left_d, edges):
        if np.count_nonzero(of_a) + np.count_nonzero(of_d) < FilterSettings().confirmations:
            alone += int(np.count_nonzero(of_a) + np.count_nonzero(of_d))
            continue
        at_rate, carried = constant_rate(mission.motion), None
        if recorded.carried_rad_s is not None:
            times = np.union1d(attitude_ns[of_a], direction_ns[of_d])
            at_rate, carried = at_carried_rates(
                at_rate, times, attitude_ns[of_a], recorded.carried_rad_s[of_a]
            )
        stretches.append(
            Stretch(
                at_rate,
                carried,
                attitudes_where(recorded.attitudes, of_a),
                directions_where(recorded.directions, of_d),
            )
        )
    # At least one measured attitude: the filter starts from nothing else.
    stretches = [each for each in stretches if len(each.attitudes.tai_ns)]
    return Cut(sorted(stretches, key=lambda each: each.begin_ns), beyond, not_given, alone)


def _unbroken(times_ns: Nanoseconds) -> Iterator[slice]:
    """The parts of rising times between long gaps."""
    if not len(times_ns):
        return
    breaks = (np.flatnonzero(np.diff(times_ns) > _LONGEST_GAP_NS) + 1).tolist()
    for first, end in pairwise([0, *breaks, len(times_ns)]):
        yield slice(first, end)


def _within(times_ns: Nanoseconds, first: int, last: int) -> Mask:
    return np.asarray((times_ns >= first) & (times_ns <= last))


def _without_gyro(
    attitude_ns: Nanoseconds,
    direction_ns: Nanoseconds,
    left_a: Mask,
    left_d: Mask,
    edges: list[int],
) -> Iterator[tuple[Mask, Mask]]:
    """Masks of the measurements that are left, for each stretch without a gyro."""
    times = np.union1d(attitude_ns[left_a], direction_ns[left_d])
    # Between two of the same stretch lies no stretch with a gyro.
    place = np.searchsorted(np.asarray(edges, dtype=np.int64), times)
    for part in _unbroken(times):
        for number in np.unique(place[part]):
            inside = times[part][place[part] == number]
            first, last = int(inside[0]), int(inside[-1])
            yield (
                left_a & _within(attitude_ns, first, last),
                left_d & _within(direction_ns, first, last),
            )


def zeros_while_turning(settings: GyroSettings, recorded: Recorded) -> Mask:
    """Marks (n,) of gyro samples that are zero about all axes, in a row, while the body turned.

    Such samples stand for none.  A gyro of coarse steps also reads zero, of a body nearly at rest.
    """
    zero: Mask = np.asarray(~recorded.rates_rad_s.any(axis=1))
    attitude_ns = recorded.attitudes.tai_ns
    if not zero.any() or len(attitude_ns) < 2:
        return np.zeros_like(zero)
    # Samples after the first attitude of each step, up to that after the second.
    first = np.searchsorted(recorded.gyro_ns, attitude_ns[:-1], side="right")
    end = np.searchsorted(recorded.gyro_ns, attitude_ns[1:])
    zeros = np.append(0, np.cumsum(zero))
    a = recorded.attitudes
    turned = turns_beside_bias(
        settings, a.tai_ns, a.quaternion, a.covariance_rad2, recorded.carried_rad_s
    )
    turned &= end > first
    turned &= zeros[end] - zeros[first] == end - first
    # Each run of zeros of which a part is none, is none.
    run = np.cumsum(np.diff(zero, prepend=False))
    is_none = np.zeros(run[-1] + 1, bool)
    is_none[run[first[turned]]] = True
    return np.asarray(zero & is_none[run])


def constant_rate(settings: MotionSettings | None) -> ConstantRateModel:
    """The model of a body without a gyro."""
    settings = settings or MotionSettings()
    return ConstantRateModel(settings.rate_walk_rad_s1_5, settings.rate_sigma_rad_s)


def at_carried_rates(
    model: ConstantRateModel,
    times_ns: Nanoseconds,
    attitude_ns: Nanoseconds,
    carried_rad_s: Vector,
) -> tuple[ConstantRateModel, GyroSamples | None]:
    """The model and the rates of a stretch whose batches carried rates of a body that spins.

    `times_ns` (n,) are those of all measurements, `carried_rad_s` (m, 3) the rates of the
    attitudes, zeros where none.  Where they are of no use, or all measurements are of one time,
    the model comes back without rates.
    """
    known = carried_rad_s.any(axis=1)
    if len(times_ns) < 2 or not rates_of_use(model, attitude_ns, carried_rad_s):
        return model, None
    known_ns = attitude_ns[known]
    # Each measurement without rates takes those of the nearest that has some.
    after = np.searchsorted(known_ns, times_ns).clip(max=len(known_ns) - 1)
    before = (after - 1).clip(0)
    is_before = np.abs(times_ns - known_ns[before]) < np.abs(known_ns[after] - times_ns)
    rates = carried_rad_s[known][np.where(is_before, before, after)]
    step_s = np.diff(times_ns) * NS
    # Between two batches the body may nutate: half of the change is an error of the mean.
    error = 0.5 * np.abs(np.diff(rates, axis=0)).max(axis=1)
    angle_walk = _rounded_up(math.sqrt(float(np.mean(error**2 * step_s))))
    mean = np.vstack([rates[:1], 0.5 * (rates[1:] + rates[:-1])])
    return replace(model, angle_walk_rad_s0_5=angle_walk), GyroSamples(times_ns, mean)


WALK_STEP = 1.1
"""The ratio of an angle walk to the next larger one."""


def _rounded_up(walk: float) -> float:
    """The next power of `WALK_STEP`: one more batch changes it rarely.

    With another model the live filter begins its stretch anew.
    """
    return WALK_STEP ** math.ceil(math.log(walk, WALK_STEP)) if walk > 0.0 else 0.0
