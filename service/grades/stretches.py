"""Stretches of a window: with a gyro as long as it runs, at a constant rate where there is none."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from service.filtering.gyro import ConstantRateModel, FilterSettings, GyroModel
from service.filtering.samples import AttitudeMeasurements, DirectionMeasurements, GyroSamples
from service.grades.measured import Mask, Recorded, attitudes_where, directions_where
from service.grades.models import believed, constant_rate, gyro_samples
from service.gyro.block import Nanoseconds
from service.missions.mission import Mission

LONGEST_GAP_S = 600.0
"""A longer gap ends a stretch; what an attitude is worth is gone by then."""
_LONGEST_GAP_NS = int(LONGEST_GAP_S) * 10**9


@dataclass(frozen=True, eq=False)
class Stretch:
    """What the filter is given of an unbroken stretch; `gyro` is None at a constant rate."""

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
