"""The filter of an unfinished stretch, carried on as more is recorded.

What is given is always the whole record of the window, and what comes out depends on it alone:
it is what `day.grade_day` would give at the last epoch, of the same record.  States at marks
along the stretch are kept, so that only what is new is filtered; a late measurement, or other
settings, drop the marks after it.

The window does not grow with the day, as that of `day.window_of` does: a look reads at most seven
hours of attitudes at any time of the day, and the gyro samples of these hours; where batches have
stopped and the gyro goes on, those of up to 13 hours.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from service.attitude.definitive import GradedSamples, Model
from service.features.definitive.day import WARM_UP_S, samples_of
from service.features.definitive.kernels.filter import filter_attitude
from service.features.definitive.kernels.inputs import ConstantRateModel
from service.features.definitive.kernels.result import FilterResult, FilterState
from service.features.definitive.stretches import (
    LONGEST_GAP_S,
    Recorded,
    Stretch,
    arrays_of,
    attitudes_where,
    cut,
    directions_where,
)
from service.gyro.blocks import Nanoseconds
from service.gyro.samples import GyroModel, GyroSamples
from service.missions.mission import Mission
from service.times import HOUR_S, Utc, bucket_start, shifted

MARK_NS = 600 * 10**9
"""A mark ends with the last epoch of each ten minutes of TAI."""


def live_window(latest: Utc) -> tuple[Utc, Utc]:
    """The time whose record a live filter depends on, its end excluded.

    It begins six hours before the UTC hour of the latest batch: late batches and blocks within it
    are filtered in their order, earlier ones change nothing.  It moves on once an hour, because
    a filter that begins at another moment has to filter everything again.  The end leaves room
    for gyro samples while trackers give no attitude: six hours after the hour of the last one.
    """
    hour = bucket_start(latest.bucket(HOUR_S), HOUR_S)
    return shifted(hour, -WARM_UP_S), shifted(hour, HOUR_S + WARM_UP_S)


@dataclass(frozen=True, eq=False)
class Mark:
    """The filter's state after an epoch, and the digest of all that led to it."""

    digest: bytes
    state: FilterState


@dataclass(frozen=True, eq=False)
class Carried:
    """The filtered attitude at the last epoch: one sample, and the model of its stretch."""

    model: Model
    sample: GradedSamples


class CarriedFilter:
    """Filters the last stretch of a record again and again; it is not thread-safe."""

    def __init__(self) -> None:
        self._marks: list[Mark] = []
        self.filtered = 0
        """Epochs that were filtered so far: fewer than were given if marks were of use."""

    def carry_on(self, recorded: Recorded, mission: Mission) -> Carried | None:
        """The filtered attitude at the last epoch of a record; None where no filter can start."""
        stretch = last_stretch(recorded, mission)
        if stretch is None:
            self._marks.clear()
            return None
        digest, state = _digest_of_model(stretch), None
        result: FilterResult | None = None
        parts = list(_parts(stretch))
        for number, part in enumerate(parts):
            digest = _digest_after(digest, part)
            is_last = number == len(parts) - 1
            if not is_last and number < len(self._marks):
                if self._marks[number].digest == digest:
                    state = self._marks[number].state
                    continue
                del self._marks[number:]
            result = filter_attitude(
                part.model, part.gyro, part.attitudes, part.directions, state=state
            )
            self.filtered += len(result.history.tai_ns)
            state = result.state
            if not is_last:
                self._marks.append(Mark(digest, state))
        del self._marks[len(parts) - 1 :]
        assert result is not None
        is_constant = isinstance(stretch.model, ConstantRateModel)
        kept = np.arange(len(result.history.tai_ns)) == len(result.history.tai_ns) - 1
        sample = samples_of(result.history, kept, is_constant)
        return Carried("constant_rate" if is_constant else "gyro", sample)


def last_stretch(recorded: Recorded, mission: Mission) -> Stretch | None:
    """The stretch that a record ends with, or None.

    Gyro samples come in blocks: measurements after the last sample wait for it, as long as a
    gap may be.
    """
    found = cut(recorded, mission).stretches
    if not found:
        return None
    end_ns = max(_end_ns(each) for each in found)
    with_gyro = [each for each in found if isinstance(each.model, GyroModel)]
    for each in reversed(with_gyro):
        if end_ns - _end_ns(each) <= LONGEST_GAP_S * 1e9:
            return each
    return max(found, key=_end_ns)


def _end_ns(stretch: Stretch) -> int:
    return int(_epochs(stretch)[-1])


def _epochs(stretch: Stretch) -> Nanoseconds:
    """The times at which a stretch may be divided."""
    if stretch.gyro is not None:
        return stretch.gyro.tai_ns
    return np.union1d(stretch.attitudes.tai_ns, stretch.directions.tai_ns)


def _parts(stretch: Stretch) -> Iterator[Stretch]:
    """The stretch, divided where ten minutes end: filtered one by one they give the same."""
    times = _epochs(stretch)
    ends = np.append(np.flatnonzero(np.diff(times // MARK_NS)), len(times) - 1)
    before, first = np.iinfo(np.int64).min, 0
    for end in ends.tolist():
        last = int(times[end])
        gyro = stretch.gyro
        if gyro is not None:
            part = slice(first, end + 1)
            gyro = GyroSamples(gyro.tai_ns[part], gyro.rate_rad_s[part])
        attitudes, directions = stretch.attitudes, stretch.directions
        yield Stretch(
            stretch.model,
            gyro,
            attitudes_where(attitudes, _between(attitudes.tai_ns, before, last)),
            directions_where(directions, _between(directions.tai_ns, before, last)),
        )
        before, first = last, end + 1


def _between(times_ns: Nanoseconds, after: int, last: int) -> slice:
    """The places of rising times after one and not after another."""
    first, end = np.searchsorted(times_ns, [after, last], side="right").tolist()
    return slice(first, end)


def _digest_of_model(stretch: Stretch) -> bytes:
    return hashlib.sha256(repr(stretch.model).encode()).digest()


def _digest_after(before: bytes, part: Stretch) -> bytes:
    digest = hashlib.sha256(before)
    values = [*arrays_of(part.attitudes, part.directions)]
    if part.gyro is not None:
        values += [part.gyro.tai_ns, part.gyro.rate_rad_s]
    for each in values:
        digest.update(f"{each.shape}".encode())
        digest.update(np.ascontiguousarray(each).tobytes())
    return digest.digest()
