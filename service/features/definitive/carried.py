"""Attitude filter for live data, continued from stored states as more data are recorded.

The input is always the whole record of the window, and the result depends on it alone: it equals
the result of `day.definitive_day` at the last epoch of the same record.  Filter states at regular
marks are kept, so that only new data are filtered; a late measurement, or other settings, drop the
later marks.

The window does not grow with the day, unlike that of `day.window_of`: at most seven hours of
attitudes and gyro samples are read, or 13 hours of gyro samples if batches have stopped.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from service.attitude.definitive import DefinitiveSamples, Model
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
"""Interval between stored filter states, in nanoseconds: each ends ten minutes of TAI."""


def live_window(latest: Utc) -> tuple[Utc, Utc]:
    """Period of the record that a live filter reads for a latest batch; the end is excluded.

    The period begins six hours before the UTC hour of the latest batch: late batches and blocks
    within it are filtered in their order, earlier ones change nothing.  It moves once an hour,
    because a filter that begins at another moment has to filter everything again.  The end leaves
    room for gyro samples without attitudes: six hours after the hour of the last attitude.
    """
    hour = bucket_start(latest.bucket(HOUR_S), HOUR_S)
    return shifted(hour, -WARM_UP_S), shifted(hour, HOUR_S + WARM_UP_S)


@dataclass(frozen=True, eq=False)
class Mark:
    """Filter state after an epoch, and a digest of the model and data that led to it."""

    digest: bytes
    state: FilterState


@dataclass(frozen=True, eq=False)
class Carried:
    """Filtered attitude at the last epoch: one sample, and the motion model used."""

    model: Model
    sample: DefinitiveSamples


class CarriedFilter:
    """Filters the last unbroken interval of a record repeatedly; not thread-safe."""

    def __init__(self) -> None:
        self._marks: list[Mark] = []
        self.filtered = 0
        """Number of epochs filtered so far; stored states save repeating earlier ones."""

    def carry_on(self, recorded: Recorded, mission: Mission) -> Carried | None:
        """Filtered attitude at the last epoch of a record; None if no filter can start."""
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
    """Last unbroken interval of a record, as input of the filter; None without any.

    Gyro samples arrive in blocks: measurements later than the last sample wait for more samples, up
    to the longest gap.
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
    """Times of samples or measurements, at which the filter's input may be divided."""
    if stretch.gyro is not None:
        return stretch.gyro.tai_ns
    return np.union1d(stretch.attitudes.tai_ns, stretch.directions.tai_ns)


def _parts(stretch: Stretch) -> Iterator[Stretch]:
    """Divide filter input at every ten minutes of TAI, which leaves the result unchanged."""
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
    """Slice of ascending times that are after `after` and not after `last`."""
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
