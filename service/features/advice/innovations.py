"""Noise of gyro and trackers from filter innovations and their autocorrelation.

The mean square of innovations alone cannot tell the gyro's noise: a filter that believes its gyro
four times too good has errors nearly three times as large, and innovations that are as large as
it expects.  But then each innovation resembles the one before.  (Mehra, 1970: the covariances of
innovations at zero and other lags give both noises.)

About each axis the filter predicts an error of variance P = S - R and corrects it by the gain
K = P / S.  If the true noise is r R of a measurement and q Q of a step, the true variance of
the prediction is r A + q B, where

    A' = (1 - K)^2 A + K^2 R        B' = (1 - K)^2 B + Q        Q = P' - (1 - K) P

from one measurement to the next, so that

    E z^2 = r (A + R) + q B         E z' z = (1 - K) (r A + q B) - K r R

and (1 - K) times that at each further lag.  Both sides are summed, and r and q are what remains.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
import numpy.typing as npt

from service.attitude.definitive import MeasuredInnovations, Outcome
from service.features.advice.statements import FileChange, Statement
from service.features.advice.trackers import NoiseFinding
from service.intervals import Interval
from service.missions.mission import Mission
from service.missions.motion import GyroSettings
from service.vectors import Vector, full_matrices

MOST = 20_000
"""Greatest number of measurements used, the latest ones; this bounds the computing time."""
LEAST = 300
SEGMENTS = 20
"""Number of consecutive parts of the measurements; each is left out once (jackknife)."""
STUDENT = 2.093
"""The 97.5 % point of Student's t with 19 degrees of freedom."""
LONGEST_STEPS = 3.0
"""Longest step, in median steps, across which the noise of the gyro is estimated."""
SETTLING = 4.0
"""Number of measurements skipped after a break until the equations settle, in 1 / gain."""

Full = npt.NDArray[np.float64]


@dataclass(frozen=True)
class InnovationNoise:
    """Ratio of true to assumed sigma, for the gyro over one step and for the measured attitudes."""

    gyro: Interval
    attitudes: Interval
    measurements: int


def innovation_noise(parts: Sequence[MeasuredInnovations]) -> InnovationNoise | None:
    """Estimate the noise of gyro and attitudes from innovations; None with too few of them.

    Each part is an uninterrupted interval with a gyro, in order of time.  The drift of the gyro's
    bias counts as noise of its steps.
    """
    sums = _segment_sums(_latest(parts))
    if sums is None:
        return None
    matrix, right, measurements = sums
    whole = _ratios(matrix.sum(axis=0), right.sum(axis=0))
    left_out = [
        _ratios(matrix.sum(axis=0) - matrix[k], right.sum(axis=0) - right[k])
        for k in range(SEGMENTS)
    ]
    if whole is None or any(each is None for each in left_out):
        return None
    spread = np.array([each for each in left_out if each is not None])
    sigma = np.sqrt((SEGMENTS - 1) / SEGMENTS * np.sum((spread - spread.mean(axis=0)) ** 2, axis=0))
    attitudes, gyro = (
        _of_sigmas(float(value), STUDENT * float(width))
        for value, width in zip(whole, sigma, strict=True)
    )
    return InnovationNoise(gyro, attitudes, measurements)


def _of_sigmas(ratio: float, half: float) -> Interval:
    """Convert a ratio of variances with its interval to a ratio of sigmas."""
    low, value, high = (math.sqrt(max(each, 0.0)) for each in (ratio - half, ratio, ratio + half))
    return Interval(value, low, high)


def _ratios(matrix: Full, right: Full) -> Vector | None:
    if abs(np.linalg.det(matrix)) < 1e-12 * np.abs(matrix).max() ** 2:
        return None
    return np.asarray(np.linalg.solve(matrix, right))


def _latest(parts: Sequence[MeasuredInnovations]) -> list[MeasuredInnovations]:
    kept: list[MeasuredInnovations] = []
    room = MOST
    for part in reversed(parts):
        if room <= 0:
            break
        kept.append(part.taken(slice(max(0, len(part) - room), None)))
        room -= len(kept[-1])
    return kept[::-1]


def _segment_sums(
    parts: Sequence[MeasuredInnovations],
) -> tuple[Full, Full, int] | None:
    """Left (s, 2, 2) and right sides (s, 2) of two equations by segment; measurements used."""
    used = [part for whole in parts for part in _unbroken(whole)]
    if not used:
        return None
    axes = _principal_axes(used)
    rows = [row for part in used for row in _rows(part, axes)]
    if len(rows) < LEAST:
        return None
    every = np.array(rows).reshape(len(rows), 2, 3)
    segments = np.array([each.sum(axis=0) for each in np.array_split(every, SEGMENTS)])
    return segments[:, :, :2], segments[:, :, 2], len(rows)


def _unbroken(whole: MeasuredInnovations) -> Iterator[MeasuredInnovations]:
    """Split innovations into runs of consecutive accepted measurements without a gap."""
    if len(whole) < 2:
        return
    step = np.diff(whole.tai_ns)
    accepted = whole.outcome == Outcome.ACCEPTED
    breaks = (step > LONGEST_STEPS * np.median(step)) | (step <= 0)
    breaks |= ~accepted[1:] | ~accepted[:-1]
    edges = [0, *(np.flatnonzero(breaks) + 1).tolist(), len(whole)]
    for first, end in pairwise(edges):
        if end - first > 1 and accepted[first]:
            yield whole.taken(slice(first, end))


def _principal_axes(parts: Sequence[MeasuredInnovations]) -> Full:
    """Axes (columns) about which errors of measured attitudes are uncorrelated on average."""
    mean = np.mean(np.concatenate([full_matrices(each.measured_arcsec2) for each in parts]), axis=0)
    return np.asarray(np.linalg.eigh(mean)[1])


def _rows(part: MeasuredInnovations, axes: Full) -> Iterator[list[float]]:
    """Six coefficients of two linear equations per settled measurement, summed over three axes."""
    z = part.innovation_arcsec @ axes
    predicted, measured = (
        np.einsum("ji,njk,ki->ni", axes, full_matrices(each), axes)
        for each in (part.predicted_arcsec2, part.measured_arcsec2)
    )
    by_axis = [
        list(_axis_rows(z[:, k].tolist(), predicted[:, k].tolist(), measured[:, k].tolist()))
        for k in range(3)
    ]
    for of_axes in zip(*by_axis, strict=True):
        settled = [each for each in of_axes if each is not None]
        if len(settled) == 3:
            yield [sum(terms) for terms in zip(*settled, strict=True)]


def _axis_rows(
    z: Sequence[float], s: Sequence[float], r: Sequence[float]
) -> Iterator[tuple[float, ...] | None]:
    """Six coefficients of two equations per measurement about one axis; None until they settle."""
    usual = sorted(1.0 - b / a for a, b in zip(s, r, strict=True))[len(s) // 2]
    settling = SETTLING / max(usual, 1e-6)
    a = b = 0.5 * (s[0] - r[0])
    past = lag_a = lag_b = 0.0
    for k in range(len(z)):
        gain = max(1.0 - r[k] / s[k], 0.0)
        left = 1.0 - gain
        if k < settling:
            yield None
        else:
            # Weight by information: a small gain has a long memory, which adds noise.
            weight = gain / s[k]
            yield (
                (a + r[k]) / s[k],
                b / s[k],
                z[k] * z[k] / s[k],
                weight * lag_a,
                weight * lag_b,
                weight * z[k] * past,
            )
        past = z[k] + left * past
        lag_a = left * a - gain * r[k] + left * left * lag_a
        lag_b = left * b + left * left * lag_b
        if k + 1 < len(z):
            step = max((s[k + 1] - r[k + 1]) - left * (s[k] - r[k]), 0.0)
            a = left * left * a + gain * gain * r[k]
            b = left * left * b + step


FITS = (0.85, 1.18)
"""Range of the sigma ratio that still fits: it changes no attitude by more than a sigma."""
Subject = Literal["gyro", "attitudes"]


@dataclass(frozen=True)
class InnovationFinding:
    """Ratio of true to assumed sigma for the gyro or the attitudes, with advice; None: unknown."""

    subject: Subject
    ratio: Interval | None
    measurements: int
    statement: Statement


def innovation_findings(
    noise: InnovationNoise | None, mission: Mission, trackers: tuple[NoiseFinding, ...]
) -> list[InnovationFinding]:
    """Advice on the noise of gyro and attitudes from innovations; empty for a mission without a
    gyro.

    `trackers` are findings from residuals: where they confirm or change the sigma of a tracker,
    innovations propose no line for it.
    """
    if mission.gyro is None:
        return []
    if noise is None:
        text = (
            f"Gyro: too few innovations to judge its noise: {LEAST} are needed, without gaps. "
            f"`acquire smooth {mission.name}` makes them."
        )
        return [InnovationFinding("gyro", None, 0, Statement("wait", text))]
    return [
        InnovationFinding(
            "gyro", noise.gyro, noise.measurements, _of_gyro(noise.gyro, noise, mission.gyro)
        ),
        InnovationFinding(
            "attitudes",
            noise.attitudes,
            noise.measurements,
            _of_attitudes(noise.attitudes, mission, trackers),
        ),
    ]


def _of_gyro(ratio: Interval, noise: InnovationNoise, settings: GyroSettings) -> Statement:
    now = settings.sigma_v_rad_s0_5
    start = (
        f"Gyro: by {noise.measurements} innovations and how they follow each other its noise is "
        f"{_shown(ratio)} times the mission's, sigma_v = {now:g} rad/s^.5"
    )
    if _fits(ratio):
        return Statement("keep", f"{start}: that fits.")
    if not ratio.low > 0.0 or ratio.high > 2.0 * ratio.value:
        return Statement("wait", f"{start}: too uncertain to change it.")
    follows = (
        "filtered and smoothed attitudes are given as better than they are"
        if ratio.value > 1.0
        else "they are given as worse than they are, and measurements are trusted too much"
    )
    line = f"sigma_v_rad_s0_5 = {now * ratio.value:.3g}"
    change = FileChange("gyro", None, f"{line:<32} # was {now:g}")
    text = f"{start}: {follows}. What a bias that walks faster adds is counted in."
    return Statement("correct", text, (change,))


def _of_attitudes(
    ratio: Interval,
    mission: Mission,
    trackers: tuple[NoiseFinding, ...],
) -> Statement:
    start = (
        f"Attitudes of batches: by the same innovations their errors are {_shown(ratio)} times "
        "what their covariances say"
    )
    if _fits(ratio):
        return Statement("keep", f"{start}: that fits.")
    open_ = [each for each in trackers if each.verdict == "no_verdict"]
    if len(open_) < len(mission.trackers):
        return Statement(
            "correct",
            f"{start}, though residuals judge the trackers' noise by themselves: see Noise above. "
            "An error that all stars of a batch share, as of alignment or clock, shows in "
            "innovations alone.",
        )
    changes = []
    for tracker in mission.trackers:
        line = f"sigma_arcsec = {tracker.sigma_arcsec * ratio.value:.3g}"
        file_line = f"{line:<32} # was {tracker.sigma_arcsec:g}"
        changes.append(FileChange("trackers", tracker.name, file_line))
    return Statement("correct", f"{start}: so are the stars' sigmas.", tuple(changes))


def _fits(ratio: Interval) -> bool:
    low, high = FITS
    return ratio.holds(1.0) or low < ratio.value < high


def _shown(ratio: Interval) -> str:
    return f"{ratio.value:.2f} ({ratio.low:.2f} to {ratio.high:.2f})"
