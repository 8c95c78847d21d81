"""What innovations say of the noise of gyro and trackers, with lines for the mission file."""

from dataclasses import dataclass
from typing import Literal

from service.advice.innovations import LEAST, InnovationNoise
from service.advice.intervals import Interval
from service.advice.statements import FileChange, Statement
from service.advice.trackers import NoiseFinding
from service.missions.gyro import GyroSettings
from service.missions.mission import Mission

FITS = (0.85, 1.18)
"""A ratio of sigmas between these changes no attitude by more than its sigma says."""
Subject = Literal["gyro", "attitudes"]


@dataclass(frozen=True)
class InnovationFinding:
    """The ratio of the true sigma to the assumed one, of gyro or attitudes; None: unknown."""

    subject: Subject
    ratio: Interval | None
    measurements: int
    statement: Statement


def innovation_findings(
    noise: InnovationNoise | None, mission: Mission, trackers: tuple[NoiseFinding, ...]
) -> list[InnovationFinding]:
    """The findings on the gyro and on the attitudes; none for a mission without a gyro.

    `trackers` are those of residuals: where they say that a tracker's sigma fits, or give it
    a line, innovations give it none.
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
            _of_attitudes(noise.attitudes, noise, mission, trackers),
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
    noise: InnovationNoise,
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
        told = f"{line:<32} # was {tracker.sigma_arcsec:g}"
        changes.append(FileChange("trackers", tracker.name, told))
    return Statement("correct", f"{start}: so are the stars' sigmas.", tuple(changes))


def _fits(ratio: Interval) -> bool:
    low, high = FITS
    return ratio.holds(1.0) or low < ratio.value < high


def _shown(ratio: Interval) -> str:
    return f"{ratio.value:.2f} ({ratio.low:.2f} to {ratio.high:.2f})"
