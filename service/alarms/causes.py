"""The usual cause of an alarm, and what to do about it, by quantity.

The page of an alarm shows them, and docs/operators.md has the table of all.
"""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Cause:
    """Why a quantity usually leaves its limits, and what to do then."""

    cause: str
    remedy: str
    calibrate: bool = False
    """Whether a new calibration is the remedy."""


_SIGMA = Cause(
    "The mission's sigma is too small, or the focal plane has changed.",
    "Open the advice for the time of the alarm: it compares the noise of each tracker with its "
    "sigma, and gives the lines to change.",
)

CAUSES: Mapping[str, Cause] = {
    "ambiguous_share": Cause(
        "Fewer or fainter stars than usual, or a crowded or sparse region of the sky.",
        "Open the worst batch. If its residuals are as predicted, wait until the region has "
        "passed, or try the separation tolerance that the advice names.",
    ),
    "unmatched_share": Cause(
        "The a priori attitude drifts, so that stars lie beyond the edge of the zone; or false "
        "stars: particles, planets, radiation.",
        "Look at the angle from the a priori attitude. If it grows too, correct the a priori "
        "attitude. If it stays the same, open the worst batch and look where its false stars are.",
    ),
    "no_attitude_share": Cause(
        "Too few unique stars, or an a priori attitude that is wrong by more than the zone covers.",
        "Open a batch without an attitude: it states the reason. Try it as lost in space; if that "
        "finds an attitude, correct the a priori attitude.",
    ),
    "suspect_share": Cause(
        "A misidentified star, or two trackers that disagree.",
        "Open a suspect batch and compare its trackers. The advice measures the alignment of the "
        "one that has moved.",
    ),
    "residual_rms_arcsec": _SIGMA,
    "residual_ratio": _SIGMA,
    "magnitude_offset_mag": Cause(
        "Instrument drift: the tracker's magnitudes have shifted.",
        "Run `acquire calibrate`, which estimates magnitudes too, or open the calibration page; "
        "try the result over recorded batches, and adopt it. Until then, widen the magnitude "
        "tolerance.",
        calibrate=True,
    ),
    "scale_offset_ppm": Cause(
        "Instrument drift: the focal length has changed.",
        "Run `acquire calibrate` over the time of the alarm, or open the calibration page; try the "
        "result over recorded batches, and adopt it.",
        calibrate=True,
    ),
    "alignment_offset_arcsec": Cause(
        "Instrument drift: a tracker has turned against the others. Of three trackers, the one "
        "with the largest offset has moved.",
        "Run `acquire calibrate` over the time of the alarm, or open the calibration page; try the "
        "result over recorded batches, and adopt it.",
        calibrate=True,
    ),
    "a_priori_angle_deg": Cause(
        "The a priori attitude drifts, or a slew was not announced.",
        "Check where the a priori attitude comes from. Until it is corrected, send the batches as "
        "lost in space, or widen the zone.",
    ),
    "innovation_rejected_share": Cause(
        "A star that is misidentified in every batch, a step of the clock, or a fault of the gyro.",
        "Open the innovations of that time. If the attitudes agree with each other, check the "
        "clock and the gyro; the advice says whether the gyro is noisier than the mission file "
        "states.",
    ),
    "silence_s": Cause(
        "A fault of the telemetry link, or of the program that sends the batches.",
        "Check that the sender runs and reaches the service, and whether its batches are refused.",
    ),
}
"""Of every quantity with limits as shipped; one that is added may have none."""
