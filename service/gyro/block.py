"""A gyro block: rates about three axes at rising times, and their packed form."""

import hashlib
import zlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from erfa import ufunc

from service.errors import Conflict
from service.times import DAY_S, Utc, shifted
from service.vectors import Vector

Nanoseconds = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class GyroBlock:
    """The samples of one gyro block, which passed every check.

    `rates_rad_per_s` has the shape (n, 3), in the axes that the mission gives its gyro;
    `times_s` has the shape (n,), in seconds of TAI after `start`, which is the time of the
    first sample.  `step_s` is the interval where the block was sent with one, else None.
    """

    spacecraft: str
    run: str
    block: str
    start: Utc
    step_s: float | None
    times_s: Vector
    rates_rad_per_s: Vector

    @property
    def tai_ns(self) -> Nanoseconds:
        """The times of the samples as `Utc.tai_ns`."""
        return tai_ns_of(self.start.tai_ns, self.times_s)

    @property
    def end(self) -> Utc:
        """The time of the last sample."""
        return shifted(self.start, float(self.times_s[-1]))

    @property
    def fingerprint(self) -> str:
        """The digest of everything that was sent.

        White space, the order of keys and the form of a time make no other body.
        """
        digest = hashlib.sha256()
        for text in (self.spacecraft, self.run, self.block, self.start.text, repr(self.step_s)):
            digest.update(text.encode() + b"\0")
        for values in (self.times_s, self.rates_rad_per_s):
            digest.update(np.ascontiguousarray(values, "<f8").tobytes())
        return digest.hexdigest()


def times_of_steps(step_s: float, samples: int) -> Vector:
    """Seconds from the first of so many samples, `step_s` apart."""
    return np.arange(samples, dtype=np.float64) * step_s


def texts_of(start: Utc, times_s: Vector) -> list[str]:
    """The UTC texts, as of `Utc.text`, of times in seconds of TAI after a start."""
    tai1, tai2, _ = ufunc.utctai(start.jd1, start.jd2)
    utc1, utc2, _ = ufunc.taiutc(tai1, tai2 + times_s / DAY_S)
    years, months, days, clocks, _ = ufunc.d2dtf(b"UTC", 9, utc1, utc2)
    fields = (years, months, days, *(clocks[name] for name in "hmsf"))
    return [
        f"{year:04d}-{month:02d}-{day:02d}T{h:02d}:{m:02d}:{s:02d}."
        f"{f'{f:09d}'.rstrip('0').ljust(3, '0')}Z"
        for year, month, day, h, m, s, f in zip(*(each.tolist() for each in fields), strict=True)
    ]


def tai_ns_of(start_ns: int, times_s: Vector) -> Nanoseconds:
    """Times as `Utc.tai_ns`, from seconds after a start."""
    return start_ns + np.rint(times_s * 1e9).astype(np.int64)


SAME_TIME_NS = 1_000
"""Samples nearer than this have the same time.

Times are sent with a start that is rounded and steps that are added up, so the same sample in two
blocks may differ by some nanoseconds.
"""


class SampleTaken(Conflict):
    """A sample at a time that another block of the spacecraft and the run holds."""


def first_shared_ns(times_ns: Nanoseconds, others_ns: Nanoseconds) -> int | None:
    """The first of the times that another block holds, or None; both in rising order."""
    place = np.searchsorted(others_ns, times_ns)
    after = others_ns[np.minimum(place, others_ns.size - 1)]
    before = others_ns[np.maximum(place - 1, 0)]
    distance = np.minimum(np.abs(after - times_ns), np.abs(times_ns - before))
    shared = np.flatnonzero(distance < SAME_TIME_NS)
    return int(times_ns[shared[0]]) if shared.size else None


# A gyro counts, so its rates are few different numbers: zlib finds them again where they stand
# whole, and takes two bytes for most.

LEVEL = 1
"""Of zlib; level 6 takes four times as long for about 2 % less."""


def pack(values: Vector) -> bytes:
    """The compressed bytes of an array of float64, column by column."""
    return zlib.compress(np.ascontiguousarray(values.T, "<f8").tobytes(), LEVEL)


def unpack(packed: bytes, shape: tuple[int, ...]) -> Vector:
    """The array of a shape that `pack` was given.

    Raises `ValueError` for bytes that are damaged or hold another number of values.
    """
    try:
        columns = np.frombuffer(zlib.decompress(packed), "<f8")
    except zlib.error as error:
        raise ValueError(f"cannot be decompressed: {error}") from None
    if columns.size != np.prod(shape):
        raise ValueError(f"{columns.size} numbers are no {' x '.join(map(str, shape))}")
    return np.ascontiguousarray(columns.reshape(shape[::-1]).T)
