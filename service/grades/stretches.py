"""The input of the filter: recorded measurements and gyro samples, in unbroken stretches."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from service.filtering.inputs import (
    LARGEST_SIGMA_RAD,
    AttitudeMeasurements,
    ConstantRateModel,
    DirectionMeasurements,
    FilterSettings,
    GyroModel,
    GyroSamples,
)
from service.gyro import Nanoseconds
from service.missions.mission import Mission
from service.missions.motion import GyroSettings, MotionSettings
from service.vectors import ARCSEC_PER_RADIAN, Vector, full_matrices

LONGEST_GAP_S = 600.0
"""A longer gap ends a stretch; what an attitude is worth is gone by then."""
_LONGEST_GAP_NS = int(LONGEST_GAP_S) * 10**9


@dataclass(frozen=True, eq=False)
class Stretch:
    """The filter's input of an unbroken stretch; `gyro` is None at a constant rate."""

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

    `beyond_largest` counts gyro samples beyond the mission's largest rate, `alone` the
    measurements that are too few to confirm an attitude at a constant rate.
    """

    stretches: list[Stretch]
    beyond_largest: int
    alone: int


Mask = npt.NDArray[np.bool_]
LEAST_RATIO = 1e-10
"""The least ratio of smallest to largest variance: a covariance below it is as good as singular."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """Gyro samples and measurements of a window, each in order of time.

    `gyro_ns` (n,) and `rates_rad_s` (n, 3) are as recorded, about the gyro's axes.  Of m
    attitudes those are left out whose covariance says nothing, and counted in `unusable`.
    """

    gyro_ns: Nanoseconds
    rates_rad_s: Vector
    attitudes: AttitudeMeasurements
    directions: DirectionMeasurements
    unusable: int = 0


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
) -> tuple[AttitudeMeasurements, int]:
    """The attitudes with a sound covariance, and how many there are without one.

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
    return kept, int(np.count_nonzero(~sound))


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
    beyond = 0
    edges: list[int] = []
    if mission.gyro is not None and len(recorded.gyro_ns):
        kept = believed(mission.gyro, recorded.rates_rad_s)
        beyond = int(np.count_nonzero(~kept))
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
        stretches.append(
            Stretch(
                constant_rate(mission.motion),
                None,
                attitudes_where(recorded.attitudes, of_a),
                directions_where(recorded.directions, of_d),
            )
        )
    # At least one measured attitude: the filter starts from nothing else.
    stretches = [each for each in stretches if len(each.attitudes.tai_ns)]
    return Cut(sorted(stretches, key=lambda each: each.begin_ns), beyond, alone)


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


# From a mission and its recorded gyro samples to what the filter takes.
#
# This is the one place where recorded rates are converted: to body axes, to mean rates, and to
# samples that the gyro can have measured.

GAP_IN_STEPS = 1.5
"""A step longer than this many median steps is a gap, unless the mission sets one."""
NS = 1e-9


def believed(settings: GyroSettings, rates_rad_s: Vector) -> npt.NDArray[np.bool_]:
    """Marks (n,) of rates (n, 3) about the gyro's axes that are within the mission's largest.

    Blocks beyond it are refused on arrival; the mission may have named another number since.
    """
    largest = math.radians(settings.largest_rate_deg_per_s)
    return np.asarray((np.abs(rates_rad_s) <= largest).all(axis=1))


def gyro_samples(
    settings: GyroSettings, tai_ns: Nanoseconds, rates_rad_s: Vector
) -> tuple[GyroModel, GyroSamples]:
    """The model and the samples of a stretch: mean rates since the sample before, in body axes.

    `tai_ns` (n,) rise, and `rates_rad_s` (n, 3) are as recorded, about the gyro's axes.
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
        # The mission's is about each axis of the gyro, the filter's about each of the body.
        largest_rate_rad_s=math.radians(settings.largest_rate_deg_per_s) * widest * (1.0 + 1e-9),
    )
    return model, GyroSamples(tai_ns, body)


def constant_rate(settings: MotionSettings | None) -> ConstantRateModel:
    """The model of a body without a gyro."""
    settings = settings or MotionSettings()
    return ConstantRateModel(settings.rate_walk_rad_s1_5, settings.rate_sigma_rad_s)
