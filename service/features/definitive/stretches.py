"""Division of recorded measurements and gyro samples into unbroken intervals for the filter."""

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
from service.vectors import ARCSEC_PER_RADIAN, Vector, full_matrices, rotation_vectors

LONGEST_GAP_S = 600.0
"""Longest gap in seconds within an interval; a propagated attitude is useless by then."""
_LONGEST_GAP_NS = int(LONGEST_GAP_S) * 10**9


@dataclass(frozen=True, eq=False)
class Stretch:
    """Filter input of an unbroken interval.

    At a constant rate `gyro` is None, or the rates sent with the batches of a spinning body.
    """

    model: GyroModel | ConstantRateModel
    gyro: GyroSamples | None
    attitudes: AttitudeMeasurements
    directions: DirectionMeasurements

    @property
    def begin_ns(self) -> int:
        """Time of the first gyro sample or measurement."""
        times = [] if self.gyro is None else [self.gyro.tai_ns]
        times += [self.attitudes.tai_ns, self.directions.tai_ns]
        return min(int(each[0]) for each in times if len(each))


@dataclass(frozen=True, eq=False)
class Cut:
    """Filter input of a window, divided into intervals in order of time, and the unused rest.

    `beyond_largest` counts gyro samples beyond the mission's largest rate, `not_given` samples of
    zeros while the body turned, `reversed` samples of a gyro that turns the other way than the
    body, `alone` measurements that are too few to confirm an attitude at a constant rate.
    """

    stretches: list[Stretch]
    beyond_largest: int
    not_given: int
    reversed: int
    alone: int


Mask = npt.NDArray[np.bool_]
LEAST_RATIO = 1e-10
"""Least ratio of smallest to largest variance; below it a covariance counts as singular."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """Recorded gyro samples and measurements of a window, in order of time.

    `gyro_ns` (n,) and `rates_rad_s` (n, 3) are as recorded, about the gyro's axes.  Attitudes (m)
    with a useless covariance are left out, and counted in `unusable`.  `carried_rad_s` (m, 3) are
    the rates about the body axes sent with the batches of the attitudes, zeros if not sent; None if
    none were sent.
    """

    gyro_ns: Nanoseconds
    rates_rad_s: Vector
    attitudes: AttitudeMeasurements
    directions: DirectionMeasurements
    unusable: int = 0
    carried_rad_s: Vector | None = None


RATE_SIGMAS = 3.0
"""Rate, in the mission's sigmas, above which attitudes alone do not show the rotation."""


def rates_of_use(model: ConstantRateModel, tai_ns: Nanoseconds, carried_rad_s: Vector) -> bool:
    """True if sent rates (m, 3) must be used, as attitudes at times (m,) do not show the rotation.

    The filter does not expect such a fast rotation; and with more than a quarter turn between two
    attitudes, the number and the sense of the turns stay open.
    """
    fastest = np.linalg.norm(carried_rad_s, axis=1)
    turn = np.maximum(fastest[1:], fastest[:-1]) * np.diff(tai_ns) * NS
    is_fast = fastest > RATE_SIGMAS * model.rate_sigma_rad_s
    return bool(is_fast.any() or (turn > QUARTER_TURN_RAD).any())


def arrays_of(
    attitudes: AttitudeMeasurements, directions: DirectionMeasurements
) -> Sequence[npt.NDArray[Any]]:
    """All arrays of the measurements, in the order in which digests take them."""
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
    """Usable attitudes, with a valid quaternion and covariance, and the mask (m,) of these.

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
    """Attitude measurements selected by indices or a mask."""
    return AttitudeMeasurements(
        attitudes.tai_ns[places], attitudes.quaternion[places], attitudes.covariance_rad2[places]
    )


def directions_where(directions: DirectionMeasurements, places: Any) -> DirectionMeasurements:
    """Direction measurements selected by indices or a mask."""
    return DirectionMeasurements(
        directions.tai_ns[places],
        directions.body[places],
        directions.inertial[places],
        directions.sigma_rad[places],
    )


def cut(recorded: Recorded, mission: Mission) -> Cut:
    """Divide the record of a window into unbroken intervals.

    An interval with a gyro has samples without a gap of `LONGEST_GAP_S`, and the measurements from
    its first sample to its last.  Measurements outside form intervals at a constant rate, which the
    same gap ends.
    """
    stretches: list[Stretch] = []
    attitude_ns, direction_ns = recorded.attitudes.tai_ns, recorded.directions.tai_ns
    left_a, left_d = np.ones(len(attitude_ns), bool), np.ones(len(direction_ns), bool)
    beyond = not_given = opposite = 0
    edges: list[int] = []
    if mission.gyro is not None and len(recorded.gyro_ns):
        kept = believed(mission.gyro, recorded.rates_rad_s)
        beyond = int(np.count_nonzero(~kept))
        none = zeros_while_turning(mission.gyro, recorded)
        not_given = int(np.count_nonzero(none))
        kept &= ~none
        if turns_backwards(mission.gyro, recorded, kept):
            opposite = int(np.count_nonzero(kept))
            kept[:] = False
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
    return Cut(
        sorted(stretches, key=lambda each: each.begin_ns), beyond, not_given, opposite, alone
    )


def _unbroken(times_ns: Nanoseconds) -> Iterator[slice]:
    """Slices of ascending times between long gaps."""
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
    """Masks of measured attitudes and of directions for each interval without gyro samples."""
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
    """Mask (n,) of gyro samples in a run of zeros about all axes while the body turned.

    Such samples stand for missing data.  A gyro with coarse resolution also reads zero when the
    body is nearly at rest.
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


LEAST_TURNS = 5
"""Least number of steps between attitudes that show the sense of a gyro."""
REVERSED_SHARE = 0.25
"""Largest miss of a gyro with the other sign, as a share of the rotation that attitudes show."""


def turns_backwards(settings: GyroSettings, recorded: Recorded, kept: Mask) -> bool:
    """True if the kept gyro samples (mask (n,)) turn the other way than the body.

    In most of the steps in which the body certainly rotated, the rotation by the gyro is then
    opposite to that between the attitudes. A filter would take twice the rate for a bias.
    """
    a, times = recorded.attitudes, recorded.gyro_ns[kept]
    if len(a.tai_ns) < 2 or not len(times):
        return False
    body = recorded.rates_rad_s[kept] @ settings.body_from_gyro.T
    sums = np.vstack([np.zeros(3), np.cumsum(body, axis=0)])
    first = np.searchsorted(times, a.tai_ns[:-1], side="right")
    end = np.searchsorted(times, a.tai_ns[1:], side="right")
    step_s = np.diff(a.tai_ns) * NS
    mean = (sums[end] - sums[first]) / np.maximum(end - first, 1)[:, None]
    by_gyro = mean * step_s[:, None]
    turn = rotation_vectors(a.quaternion[:-1], a.quaternion[1:])
    angle = np.linalg.norm(turn, axis=1)
    shown = turns_beside_bias(settings, a.tai_ns, a.quaternion, a.covariance_rad2)
    # A farther turn between two attitudes may be one in the opposite direction.
    shown &= (end > first) & (np.linalg.norm(by_gyro, axis=1) < QUARTER_TURN_RAD)
    opposite = np.linalg.norm(turn + by_gyro, axis=1) < REVERSED_SHARE * angle
    count = np.count_nonzero(shown)
    return bool(count >= LEAST_TURNS and np.count_nonzero(shown & opposite) > 0.5 * count)


def constant_rate(settings: MotionSettings | None) -> ConstantRateModel:
    """Constant-rate model with the mission's settings, for a body without a gyro."""
    settings = settings or MotionSettings()
    return ConstantRateModel(settings.rate_walk_rad_s1_5, settings.rate_sigma_rad_s)


def at_carried_rates(
    model: ConstantRateModel,
    times_ns: Nanoseconds,
    attitude_ns: Nanoseconds,
    carried_rad_s: Vector,
) -> tuple[ConstantRateModel, GyroSamples | None]:
    """Constant-rate model and body rates of an interval whose batches were sent with rates.

    `times_ns` (n,) are the times of all measurements, `carried_rad_s` (m, 3) the rates sent with
    the attitudes, zeros if none.  If the rates are of no use, or all times are equal, the model is
    returned without rates.
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
"""Ratio of two successive values to which an angle walk is rounded."""


def _rounded_up(walk: float) -> float:
    """Round up to the next power of `WALK_STEP`, so that one more batch rarely changes the value.

    With another model the live filter has to filter its interval again.
    """
    return WALK_STEP ** math.ceil(math.log(walk, WALK_STEP)) if walk > 0.0 else 0.0
