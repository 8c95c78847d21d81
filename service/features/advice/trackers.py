"""Noise, magnitudes and mutual alignment of trackers, judged from identified stars."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from service import vectors
from service.features.advice.evidence import Evidence, StarEvidence, TrackerAttitude
from service.intervals import Interval, intervals, median, quantile, robust_fit
from service.missions.mission import Mission, Tracker
from service.times import Utc

LEAST_BATCHES = 20
LEAST_STARS = 50
CERTAIN_CHI2 = 16.266
"""The 99.9 % point of chi-square with three degrees of freedom."""
CLOSE = 0.2
"""Relative error of a sigma that is tolerated without recommending a change."""
CERTAIN = 0.999
"""Confidence of the intervals that show a change of noise; high, since several are tested."""
SCAN_SIGMAS = 4.5
"""Threshold in sigmas for a noisier period; constant noise exceeds it in 1 of 500 samples."""

SizeVerdict = Literal["too_small", "fits", "too_large", "no_verdict"]


@dataclass(frozen=True)
class NoisePeriod:
    """Noise of a tracker over consecutive batches, with the times of the first and the last."""

    sigma_arcsec: Interval
    batches: int
    first: Utc
    last: Utc


@dataclass(frozen=True)
class NoiseFinding:
    """Measured noise of a tracker, one standard deviation per tangent axis, beside the mission's
    sigma.

    If the noise changed, the values are of the latest batches alone, from `since` on, and
    `before_arcsec` is the earlier noise, else None.  `worst` is a period of certainly larger noise,
    whose batches are left out of the other values.
    """

    tracker: str
    now_arcsec: float
    sigma_arcsec: Interval | None
    batches: int
    verdict: SizeVerdict
    before_arcsec: Interval | None = None
    since: Utc | None = None
    worst: NoisePeriod | None = None


@dataclass(frozen=True)
class MagnitudeFinding:
    """Fit of magnitudes, observed = catalog + offset + (scale - 1) (catalog - pivot), and the
    scatter.

    The offset is that at the pivot, the median of the catalog magnitudes.  The
    scatter is one standard deviation.
    """

    tracker: str
    now_sigma_mag: float
    pivot_mag: float
    offset_mag: Interval | None
    scale: Interval | None
    scatter_mag: Interval | None
    stars: int
    verdict: Literal["off", "fits", "no_verdict"]
    scatter_verdict: SizeVerdict


@dataclass(frozen=True)
class AlignmentFinding:
    """Rotation of a tracker from its alignment in the mission file, relative to another tracker.

    The rotation vector is in body axes; `axes_body` are the tracker's axes
    turned by it, where it is certainly not zero.
    """

    tracker: str
    reference: str
    rotation_arcsec: tuple[Interval, Interval, Interval] | None
    batches: int
    verdict: Literal["off", "fits", "no_verdict"]
    axes_body: tuple[tuple[float, ...], ...] | None


def noise_findings(mission: Mission, evidence: Evidence) -> list[NoiseFinding]:
    """Judge the noise of each tracker from the fit of its own stars to one attitude.

    TASTE over the square of the true noise is chi-square with 2N - 3 degrees of freedom.  So the
    median of TASTE over the median of that distribution is the square of the noise, in units of the
    sigmas.  The median over batches resists a few bad ones, and so hides a tracker that began to
    fail: the latest batches are compared with earlier ones, and are used alone where they differ.
    An earlier period of more noise is found as well, since an alarm may refer to it.
    """
    return [_noise(tracker, index, evidence) for index, tracker in enumerate(mission.trackers)]


def _noise(tracker: Tracker, index: int, evidence: Evidence) -> NoiseFinding:
    fits = [fit for fit in evidence.fits if fit.tracker == index]
    if len(fits) < LEAST_BATCHES:
        return NoiseFinding(tracker.name, tracker.sigma_arcsec, None, len(fits), "no_verdict")
    fits.sort(key=lambda fit: fit.time.tai_ns)
    squared = _squared_noise(fits)
    worst = _worst_in_a_row(squared)
    others = np.arange(len(squared))
    if worst is not None and worst.start >= LEAST_BATCHES:
        if worst.stop <= len(squared) - LEAST_BATCHES // 2:
            # The disturbance is over; its value in the median would bias the other periods.
            others = np.delete(others, worst)
        else:
            worst = None
    latest = _latest_with_own_noise(squared[others])
    now, before = squared[others[-latest:]], squared[others[:-latest]]
    sigma = _sigma(now, tracker)
    return NoiseFinding(
        tracker.name,
        tracker.sigma_arcsec,
        sigma,
        len(now),
        _size_verdict(tracker.sigma_arcsec, sigma),
        _sigma(before, tracker) if len(before) else None,
        fits[others[-latest]].time if len(before) else None,
        None if worst is None else _noise_period(fits[worst], squared[worst], tracker),
    )


def _noise_period(
    fits: list[TrackerAttitude], squared: vectors.Vector, tracker: Tracker
) -> NoisePeriod:
    return NoisePeriod(_sigma(squared, tracker), len(fits), fits[0].time, fits[-1].time)


def _worst_in_a_row(squared: vectors.Vector) -> slice | None:
    """Slice of consecutive batches with clearly more noise than the rest; None if there is none.

    The rank sum of each run is compared with its expectation (Mann & Whitney); the search is one
    step of circular binary segmentation (Olshen et al. 2004).
    """
    count = len(squared)
    _, value, times = np.unique(squared, return_inverse=True, return_counts=True)
    rank = (np.cumsum(times) - (times - 1) / 2.0)[value]
    total = np.concatenate([[0.0], np.cumsum(rank - (count + 1) / 2.0)])
    best, found = SCAN_SIGMAS, None
    for length in range(LEAST_BATCHES, count - LEAST_BATCHES + 1):
        excess = total[length:] - total[:-length]
        begin = int(np.argmax(excess))
        sigma = math.sqrt(length * (count - length) * (count + 1) / 12.0)
        if excess[begin] > best * sigma:
            best, found = float(excess[begin]) / sigma, slice(begin, begin + length)
    if found is None:
        return None
    others = np.concatenate([squared[: found.start], squared[found.stop :]])
    more = np.median(squared[found]) > (1.0 + CLOSE) ** 2 * np.median(others)
    return found if more else None


def _sigma(squared: vectors.Vector, tracker: Tracker) -> Interval:
    ratio = median(squared)
    # The median of fewer than six values has no bounds; the lower one may even be negative.
    bounds = (max(each, 0.0) for each in (ratio.value, ratio.low, ratio.high))
    return Interval(*map(math.sqrt, bounds)).scaled(tracker.sigma_arcsec)


def _latest_with_own_noise(squared: vectors.Vector) -> int:
    """Number of latest batches whose noise differs from the earlier ones; all batches if none
    differs.

    The smallest number with a certain difference is taken: with steadily growing noise it is
    nearest to the present value.
    """
    count = len(squared)
    latest = LEAST_BATCHES
    while 2 * latest <= count:
        before, now = (median(part, CERTAIN) for part in (squared[:-latest], squared[-latest:]))
        apart = now.low > before.high or now.high < before.low
        less, more = sorted((now.value, before.value))
        if apart and more > (1.0 + CLOSE) ** 2 * less:
            return latest
        latest *= 2
    return count


def _squared_noise(fits: list[TrackerAttitude]) -> vectors.Vector:
    """Estimate of the squared noise from each fit, in units of the squared star sigmas."""
    from scipy.special import gammaincinv

    freedom = np.array([fit.degrees_of_freedom for fit in fits])
    median_of_chi_square = 2.0 * gammaincinv(freedom / 2.0, 0.5)
    return np.asarray(np.array([fit.taste for fit in fits]) / median_of_chi_square)


def _size_verdict(now: float, found: Interval) -> SizeVerdict:
    """Judge a sigma as too small or too large, if certainly so by more than the fraction CLOSE."""
    if found.low > now and found.value > (1.0 + CLOSE) * now:
        return "too_small"
    if found.high < now and found.value < (1.0 - CLOSE) * now:
        return "too_large"
    return "fits"


def magnitude_findings(mission: Mission, evidence: Evidence) -> list[MagnitudeFinding]:
    """Offset, scale and scatter of each tracker's magnitudes, from a robust line fit."""
    return [
        _magnitudes(tracker, index, evidence.stars)
        for index, tracker in enumerate(mission.trackers)
    ]


def _magnitudes(tracker: Tracker, index: int, stars: StarEvidence) -> MagnitudeFinding:
    own = (stars.tracker == index) & np.isfinite(stars.observed_mag)
    observed, catalog, batch = stars.observed_mag[own], stars.catalog_mag[own], stars.batch[own]
    count = int(own.sum())
    spread = float(np.ptp(catalog)) if count else 0.0
    if count < LEAST_STARS or len(np.unique(batch)) < LEAST_BATCHES or spread == 0.0:
        return MagnitudeFinding(
            tracker.name,
            tracker.magnitude_sigma_mag,
            float(np.median(catalog)) if count else math.nan,
            None,
            None,
            None,
            count,
            "no_verdict",
            "no_verdict",
        )
    pivot = float(np.median(catalog))
    design = np.stack([np.ones(count), catalog - pivot], axis=1)
    beta, covariance = robust_fit(design, observed - catalog, batch)
    offset, slope = intervals(beta, covariance)
    residual = np.abs(observed - catalog - design @ beta)
    # Half of a Gaussian's values lie within 0.6745 sigma.
    scatter = quantile(residual, batch, 0.5).scaled(1.0 / 0.674489750196)
    off = not (offset.holds(0.0) and slope.holds(0.0))
    matters = (
        max(abs(offset.value), abs(slope.value) * spread / 2) > tracker.magnitude_sigma_mag / 4
    )
    return MagnitudeFinding(
        tracker.name,
        tracker.magnitude_sigma_mag,
        pivot,
        offset,
        Interval(1.0 + slope.value, 1.0 + slope.low, 1.0 + slope.high),
        scatter,
        count,
        "off" if off and matters else "fits",
        _size_verdict(tracker.magnitude_sigma_mag, scatter),
    )


def alignment_findings(mission: Mission, evidence: Evidence) -> list[AlignmentFinding]:
    """Rotation of each further tracker relative to the first, over batches with both attitudes."""
    first, *others = mission.trackers
    by_batch = {fit.batch: fit for fit in evidence.fits if fit.tracker == 0}
    return [
        _alignment(
            first,
            tracker,
            [
                (by_batch[fit.batch], fit)
                for fit in evidence.fits
                if fit.tracker == index and fit.batch in by_batch
            ],
        )
        for index, tracker in enumerate(others, start=1)
    ]


def _alignment(
    first: Tracker, tracker: Tracker, both: list[tuple[TrackerAttitude, TrackerAttitude]]
) -> AlignmentFinding:
    """Weighted mean rotation e of tracker B's attitude from A's, A_B = exp(-[e x]) A_A.

    A tracker whose axes are rotated by e from the mission's alignment yields, through that
    alignment, an attitude with the error e.
    """
    if len(both) < LEAST_BATCHES:
        return AlignmentFinding(tracker.name, first.name, None, len(both), "no_verdict", None)
    turned, whiten = [], []
    for a, b in both:
        turned.append(
            vectors.attitude_error_arcsec(
                vectors.matrix_from_quaternion(b.quaternion),
                vectors.matrix_from_quaternion(a.quaternion),
            )
        )
        covariance = a.covariance_arcsec2 + b.covariance_arcsec2
        whiten.append(np.linalg.inv(np.linalg.cholesky(covariance)))
    root, errors = np.stack(whiten), np.stack(turned)
    cluster = np.repeat(np.arange(len(both)), 3)
    values = np.einsum("nij,nj->ni", root, errors).ravel()
    beta, covariance = robust_fit(root.reshape(-1, 3), values, cluster)
    certain = float(beta @ np.linalg.solve(covariance, beta)) > CERTAIN_CHI2
    x, y, z = intervals(beta, covariance)
    axes = vectors.rotate_about(beta / vectors.ARCSEC_PER_RADIAN, tracker.body_from_tracker.T)
    return AlignmentFinding(
        tracker.name,
        first.name,
        (x, y, z),
        len(both),
        "off" if certain else "fits",
        tuple(tuple(round(float(part), 9) for part in axis) for axis in axes) if certain else None,
    )
