"""Filtering and smoothing of the attitudes of one UTC day.

The result depends on the record from six hours before the day to two hours after it, and on nothing
else: not on the requested period, nor on results for earlier days.  So a day can be computed again,
alone, with the same bytes; a late batch affects one day or two.

An innovation is the rotation from the filter's prediction to a measured attitude.  A difference is
the rotation from the smoothed attitude to the measured one.  If the smoother used the measurement,
their errors are correlated, and the covariance of the difference is R - P; otherwise it is R + P.
Both are shown on the attitude page and used to estimate noise.
"""

from dataclasses import dataclass

import numpy as np

from service.attitude.definitive import (
    DefinitiveSamples,
    Grade,
    MeasuredInnovations,
    Model,
    Outcome,
    Status,
    day_bounds,
    was_used,
)
from service.errors import BadInput, Fault
from service.features.definitive.kernels.filter import filter_attitude
from service.features.definitive.kernels.inputs import AttitudeMeasurements, ConstantRateModel
from service.features.definitive.kernels.result import AttitudeHistory, FilterResult
from service.features.definitive.kernels.smoother import smooth
from service.features.definitive.kernels.updates import ATTITUDE
from service.features.definitive.stretches import Mask, Recorded, Stretch, cut
from service.missions.mission import Mission
from service.times import Utc, shifted
from service.vectors import ARCSEC_PER_RADIAN, UPPER, rotation_vectors


def innovations_of(
    attitudes: AttitudeMeasurements,
    result: FilterResult,
    smoothed: AttitudeHistory,
    start_ns: int,
    end_ns: int,
) -> MeasuredInnovations:
    """Innovations of measured attitudes from `start_ns` up to `end_ns`, with smoothed differences.

    `attitudes` are the filter's input; measurements of single directions are left out.
    """
    met = result.innovations
    chosen = np.flatnonzero(
        (met.kind == ATTITUDE) & (met.tai_ns >= start_ns) & (met.tai_ns < end_ns)
    )
    row, outcome = met.row[chosen], met.outcome[chosen]
    # Every measurement is an epoch.
    epoch = np.searchsorted(smoothed.tai_ns, met.tai_ns[chosen])
    measured = attitudes.covariance_rad2[row]
    own = smoothed.model_covariance[epoch, :3, :3]
    used = was_used(outcome)
    axes = np.arange(3)
    apart = measured[:, axes, axes] + np.where(used, -1.0, 1.0)[:, None] * own[:, axes, axes]
    apart += smoothed.doubt_rad[epoch, None] ** 2
    turned = rotation_vectors(smoothed.quaternion[epoch], attitudes.quaternion[row])
    return MeasuredInnovations(
        met.tai_ns[chosen],
        outcome,
        met.innovation_rad[chosen] * ARCSEC_PER_RADIAN,
        met.covariance_rad2[chosen][:, *UPPER] * ARCSEC_PER_RADIAN**2,
        met.nis[chosen],
        measured[:, *UPPER] * ARCSEC_PER_RADIAN**2,
        turned * ARCSEC_PER_RADIAN,
        np.sqrt(np.maximum(apart, 0.0)) * ARCSEC_PER_RADIAN,
    )


METHOD = 5
"""Version of the algorithm; a change makes stored days be computed again."""
WARM_UP_S = 6 * 3600.0
"""Seconds of data before a day: two hours for the bias to settle, after up to three in which a
tracker with wrong stars at the beginning is detected and its measurements are rejected.
"""
LOOK_AHEAD_S = 2 * 3600.0
"""Seconds of data after a day, for the smoother and to resolve doubts at the day's end."""
STEP_NS = 10**9
"""Interval between stored samples in nanoseconds; the first epoch in each TAI second is kept."""
MOST_SAMPLES = 4_000_000
"""Greatest number of gyro samples of a day and its margins: 30 Hz, 1 kB of memory each."""
OUTCOMES = {each.name.lower(): int(each) for each in Outcome}
"""Outcomes of a measurement in the filter, by name; see `kernels.result.Outcome`."""


@dataclass(frozen=True, eq=False)
class DefinitiveStretch:
    """Unbroken interval of a day with filtered and smoothed samples, and innovations."""

    model: Model
    samples: dict[Grade, DefinitiveSamples]
    innovations: MeasuredInnovations


@dataclass(frozen=True, eq=False)
class DefinitiveDay:
    """Filtered and smoothed attitudes of a day, with counts of the measurements and gyro samples.

    `measurements` counts by the names of `kernels.result.Outcome`, and `unusable` and `alone`
    ones; `gyro` counts samples, gaps, samples beyond the largest rate, zeros while the body
    turned, and samples of a gyro that turns the other way.  `nis_per_degree` is the
    mean of z^T S^-1 z of the accepted measurements per degree of freedom: about 1.
    """

    stretches: list[DefinitiveStretch]
    measurements: dict[str, int]
    gyro: dict[str, int]
    nis_per_degree: float | None

    @property
    def samples(self) -> int:
        """Number of samples of one grade."""
        return sum(len(each.samples["smoothed"]) for each in self.stretches)


def window_of(day: int) -> tuple[Utc, Utc]:
    """Period of the record that the attitudes of a UTC day depend on; the end is excluded."""
    start, end = day_bounds(day)
    return shifted(start, -WARM_UP_S), shifted(end, LOOK_AHEAD_S)


def definitive_day(recorded: Recorded, mission: Mission, day: int) -> DefinitiveDay:
    """Filter and smooth the record of a day's window; see `window_of`.

    Raises `BadInput` for more gyro samples than fit into memory.
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
        computed = _stretch_of_day(each, result, smoothed, start, end)
        if computed is not None:
            stretches.append(computed)
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
    return DefinitiveDay(
        stretches,
        {**outcomes, "unusable": recorded.unusable, "alone": found.alone},
        {
            "samples": int(np.count_nonzero(of_gyro)),
            "gaps": gaps,
            "beyond_largest": found.beyond_largest,
            "not_given": found.not_given,
            "reversed": found.reversed,
        },
        nis / degrees if degrees else None,
    )


def _stretch_of_day(
    stretch: Stretch, result: FilterResult, smoothed: AttitudeHistory, start: int, end: int
) -> DefinitiveStretch | None:
    """Part of a filtered and smoothed interval within the day; None if there is none."""
    kept = _kept(result.history, start, end)
    if not kept.any():
        return None
    is_constant = isinstance(stretch.model, ConstantRateModel)
    return DefinitiveStretch(
        "constant_rate" if is_constant else "gyro",
        {
            "filtered": samples_of(result.history, kept, is_constant),
            "smoothed": samples_of(smoothed, kept, is_constant),
        },
        innovations_of(stretch.attitudes, result, smoothed, start, end),
    )


def _kept(history: AttitudeHistory, start: int, end: int) -> Mask:
    """Mask of the first epoch in each second of the day, from the first measured attitude on."""
    times = history.tai_ns
    inside = (times >= start) & (times < end) & (history.status != Status.NONE)
    second = times // STEP_NS
    is_first = np.append(True, np.diff(second) != 0)[: len(times)]
    return np.asarray(inside & is_first)


def samples_of(history: AttitudeHistory, kept: Mask, is_constant: bool) -> DefinitiveSamples:
    """Convert the selected epochs (mask (n,)) of an attitude history to stored samples."""
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
    return DefinitiveSamples(
        history.tai_ns[kept],
        quaternion,
        upper,
        np.degrees(history.rate_rad_s[kept]),
        np.full_like(bias, np.nan) if is_constant else bias,
        np.degrees(sigma) * 3600.0,
        history.status[kept],
    )
