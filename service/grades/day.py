"""The grades of a UTC day: filtered, smoothed, and packed as compressed bytes for the record.

A day depends on the record from six hours before it to two hours after it, and on nothing
else: not on the period that is asked for, nor on what was computed of the days before.  So it
can be computed again, alone, and gives the same bytes; a late batch concerns one day or two.
"""

import zlib
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np

from service.errors import BadInput, Fault
from service.filtering.filter import filter_attitude
from service.filtering.inputs import ConstantRateModel
from service.filtering.result import AttitudeHistory, FilterResult, Integers, Outcome, Status
from service.filtering.smoother import smooth
from service.grades.innovations import UPPER, MeasuredInnovations, TimedColumns, innovations_of
from service.grades.stretches import Mask, Recorded, Stretch, cut
from service.missions.mission import Mission
from service.times import DAY_S, Utc, bucket_start, shifted
from service.vectors import ARCSEC_PER_RADIAN, Vector

Grade = Literal["filtered", "smoothed"]
Model = Literal["gyro", "constant_rate"]
GRADES: tuple[Grade, ...] = ("filtered", "smoothed")

METHOD = 4
"""Counted up with every change of what is computed: then days are computed anew."""
WARM_UP_S = 6 * 3600.0
"""For the bias to settle (two hours), after a tracker that is wrong at the beginning was found
out (an hour, and two in which everything is rejected)."""
LOOK_AHEAD_S = 2 * 3600.0
"""The data after a day for the smoother, and for doubts at its end to be settled."""
STEP_NS = 10**9
"""The time between samples: the first sample in each second of TAI is kept."""
MOST_SAMPLES = 4_000_000
"""The most samples of a day with its surroundings: 30 Hz, all in memory at 1 kB each."""
OUTCOMES = {each.name.lower(): int(each) for each in Outcome}
"""The outcomes of a measurement; see `filtering.result.Outcome`."""


@dataclass(frozen=True, eq=False)
class GradedSamples(TimedColumns):
    """Attitudes of a stretch of one grade.

    `tai_ns` (n,), `quaternion` (n, 4) inertial to body, `covariance_arcsec2` (n, 6) of the small
    error rotation about the body axes (11, 12, 13, 22, 23, 33), `rate_deg_per_s` (n, 3) of the
    body in the step that ends at the sample, `bias_deg_per_h` (n, 3) of the gyro and
    `bias_sigma_deg_per_h` (n, 3); `status` (n,) is a `filtering.result.Status`.  At a constant
    rate there is no bias, and the sigma is that of the rate.
    """

    quaternion: Vector
    covariance_arcsec2: Vector
    rate_deg_per_s: Vector
    bias_deg_per_h: Vector
    bias_sigma_deg_per_h: Vector
    status: Integers


@dataclass(frozen=True, eq=False)
class GradedStretch:
    """A stretch of a day in both grades, which have the same times, and its measurements."""

    model: Model
    samples: dict[Grade, GradedSamples]
    innovations: MeasuredInnovations


@dataclass(frozen=True, eq=False)
class GradedDay:
    """The stretches of a day, and what became of what was recorded.

    `measurements` counts by the names of `filtering.result.Outcome`, and `unusable` and `alone`
    ones; `gyro` counts samples, gaps and those beyond the largest rate.  `nis_per_degree` is
    the mean of z^T S^-1 z of the accepted measurements by their degrees of freedom: about 1.
    """

    stretches: list[GradedStretch]
    measurements: dict[str, int]
    gyro: dict[str, int]
    nis_per_degree: float | None

    @property
    def samples(self) -> int:
        """The samples of one grade."""
        return sum(len(each.samples["smoothed"]) for each in self.stretches)


def day_bounds(day: int) -> tuple[Utc, Utc]:
    """The beginning of a UTC day, counted as `Utc.bucket`, and of the next."""
    return bucket_start(day, DAY_S), bucket_start(day + 1, DAY_S)


def window_of(day: int) -> tuple[Utc, Utc]:
    """The time whose record a day depends on, its end excluded."""
    start, end = day_bounds(day)
    return shifted(start, -WARM_UP_S), shifted(end, LOOK_AHEAD_S)


def grade_day(recorded: Recorded, mission: Mission, day: int) -> GradedDay:
    """The grades of a day, of what was recorded in its window; see `window_of`.

    Raises `BadInput` for more gyro samples than there is memory for.
    """
    if len(recorded.gyro_ns) > MOST_SAMPLES:
        expected = f"a day and what is about it may have at most {MOST_SAMPLES:,} samples"
        raise BadInput(Fault("gyro", expected, f"{len(recorded.gyro_ns):,}"))
    start, end = (each.tai_ns for each in day_bounds(day))
    found = cut(recorded, mission)
    outcomes = dict.fromkeys(OUTCOMES, 0)
    nis, degrees = 0.0, 0
    gaps = 0
    stretches = []
    for each in found.stretches:
        result = filter_attitude(each.model, each.gyro, each.attitudes, each.directions)
        smoothed = smooth(result, each.model)
        graded = _graded(each, result, smoothed, start, end)
        if graded is not None:
            stretches.append(graded)
        met = result.innovations
        inside = (met.tai_ns >= start) & (met.tai_ns < end)
        for name, code in OUTCOMES.items():
            outcomes[name] += int(np.sum(met.outcome[inside] == code))
        used = inside & met.accepted
        nis += float(met.nis[used].sum())
        degrees += int(met.degrees[used].sum())
        times = result.history.tai_ns
        of_day = (times >= start) & (times < end)
        # The first step of a gap begins with it.
        gaps += int(np.count_nonzero(result.steps.gap_s[of_day] == 0.0))
    of_gyro = (recorded.gyro_ns >= start) & (recorded.gyro_ns < end)
    return GradedDay(
        stretches,
        {**outcomes, "unusable": recorded.unusable, "alone": found.alone},
        {
            "samples": int(np.count_nonzero(of_gyro)),
            "gaps": gaps,
            "beyond_largest": found.beyond_largest,
        },
        nis / degrees if degrees else None,
    )


def _graded(
    stretch: Stretch, result: FilterResult, smoothed: AttitudeHistory, start: int, end: int
) -> GradedStretch | None:
    """The part of a stretch that lies in the day, or None."""
    kept = _kept(result.history, start, end)
    if not kept.any():
        return None
    is_constant = isinstance(stretch.model, ConstantRateModel)
    return GradedStretch(
        "constant_rate" if is_constant else "gyro",
        {
            "filtered": samples_of(result.history, kept, is_constant),
            "smoothed": samples_of(smoothed, kept, is_constant),
        },
        innovations_of(stretch.attitudes, result, smoothed, start, end),
    )


def _kept(history: AttitudeHistory, start: int, end: int) -> Mask:
    """The first epoch of each second of the day, from the first measured attitude on."""
    times = history.tai_ns
    inside = (times >= start) & (times < end) & (history.status != Status.NONE)
    second = times // STEP_NS
    is_first = np.append(True, np.diff(second) != 0)[: len(times)]
    return np.asarray(inside & is_first)


def samples_of(history: AttitudeHistory, kept: Mask, is_constant: bool) -> GradedSamples:
    """The epochs of a history where a mask (n,) is true, as samples of a grade."""
    quaternion = history.quaternion[kept]
    quaternion = np.where(quaternion[:, 3:] < 0.0, -quaternion, quaternion)
    covariance = history.model_covariance[kept]
    axes = np.arange(3)
    attitude = covariance[:, :3, :3].copy()
    # A doubt is one more sigma about each axis.
    attitude[:, axes, axes] += history.doubt_rad[kept, None] ** 2
    upper = attitude[:, *UPPER] * ARCSEC_PER_RADIAN**2
    bias = np.degrees(history.bias_rad_s[kept]) * 3600.0
    sigma = np.sqrt(covariance[:, axes + 3, axes + 3])
    return GradedSamples(
        history.tai_ns[kept],
        quaternion,
        upper,
        np.degrees(history.rate_rad_s[kept]),
        np.full_like(bias, np.nan) if is_constant else bias,
        np.degrees(sigma) * 3600.0,
        history.status[kept],
    )


# Graded samples and innovations as compressed bytes, and back.
#
# Times and quaternions keep every bit, all else has the seven digits of a float32.  The bytes of
# equal weight stand together, so that signs and exponents, which hardly change, take no room.

Packable = TypeVar("Packable", GradedSamples, MeasuredInnovations)
Fields = tuple[tuple[str, str, int], ...]

LEVEL = 1
"""The level of zlib; level 6 takes five times as long for about 3 % less."""
MOST_PACKED = 3_600
"""The most samples of a block: an hour."""
_FIELDS: dict[type, Fields] = {
    GradedSamples: (
        ("tai_ns", "<i8", 1),
        ("quaternion", "<f8", 4),
        ("covariance_arcsec2", "<f4", 6),
        ("rate_deg_per_s", "<f4", 3),
        ("bias_deg_per_h", "<f4", 3),
        ("bias_sigma_deg_per_h", "<f4", 3),
        ("status", "u1", 1),
    ),
    MeasuredInnovations: (
        ("tai_ns", "<i8", 1),
        ("outcome", "u1", 1),
        ("innovation_arcsec", "<f4", 3),
        ("predicted_arcsec2", "<f4", 6),
        ("nis", "<f4", 1),
        ("measured_arcsec2", "<f4", 6),
        ("difference_arcsec", "<f4", 3),
        ("difference_sigma_arcsec", "<f4", 3),
    ),
}
"""Name, type and columns of each field; the times come first."""
_NUMBERS = {"i": np.int64, "u": np.int64, "f": np.float64}


def packed(samples: GradedSamples | MeasuredInnovations) -> bytes:
    """The compressed bytes of samples."""
    parts = []
    for name, kind, _ in _FIELDS[type(samples)]:
        values = np.asarray(getattr(samples, name)).T
        if kind == "<i8":
            # Steps are alike, times are not.
            values = np.diff(values, prepend=0)
        each = np.ascontiguousarray(values, kind)
        parts.append(each.view(np.uint8).reshape(-1, each.itemsize).T.tobytes())
    return zlib.compress(b"".join(parts), LEVEL)


def unpacked(data: bytes, samples: int) -> GradedSamples:
    """So many samples that `packed` was given.

    Raises `ValueError` for bytes that are damaged or hold another number of samples.
    """
    return _unpacked(GradedSamples, data, samples)


def unpacked_innovations(data: bytes, measurements: int) -> MeasuredInnovations:
    """So many measurements that `packed` was given; raises `ValueError` as `unpacked`."""
    return _unpacked(MeasuredInnovations, data, measurements)


def _unpacked(of: type[Packable], data: bytes, samples: int) -> Packable:
    try:
        raw = np.frombuffer(zlib.decompress(data), np.uint8)
    except zlib.error as error:
        raise ValueError(f"cannot be decompressed: {error}") from None
    each = sum(np.dtype(kind).itemsize * columns for _, kind, columns in _FIELDS[of])
    if raw.size != samples * each:
        raise ValueError(f"{raw.size} bytes are not {samples} samples")
    found: dict[str, Any] = {}
    at = 0
    for name, kind, columns in _FIELDS[of]:
        dtype = np.dtype(kind)
        size = dtype.itemsize * columns * samples
        shuffled = raw[at : at + size].reshape(dtype.itemsize, -1)
        values = np.ascontiguousarray(shuffled.T).view(dtype).reshape(columns, samples).T
        values = np.ascontiguousarray(values, _NUMBERS[dtype.kind])
        found[name] = values if columns > 1 else values[:, 0]
        at += size
    found["tai_ns"] = np.cumsum(found["tai_ns"])
    return of(**found)
