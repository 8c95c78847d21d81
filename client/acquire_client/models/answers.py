"""Records of answers to batches, of the stars on a frame, and of results in lists."""
# Written by `make client` from service/contract/answers.py.

from collections.abc import Sequence
from typing import Any

from ..base import Model
from ..words import Identifier, Outcome, Status


class FrameTimings(Model, frozen=True, kw_only=True):
    """Duration of each step from a frame's file to its stars, in microseconds."""

    read: int
    detect: int
    centroid: int


class FrameSummary(Model, frozen=True, kw_only=True):
    """Summary of the frame from which a batch was made, with the numbers of detected stars."""

    digest: str
    format: str
    tracker: str
    width_px: int
    height_px: int
    exposure_s: float
    centroid: str
    background_counts: float
    """Median background above the bias."""
    noise_counts: float
    """Standard deviation of a background pixel."""
    candidates: int
    """Detections above the threshold, without hot pixels."""
    measured: int
    """The brightest of these, whose positions were measured."""
    used: int
    """Measured detections that are stars of the batch."""
    hot_or_cosmic: int
    """Detections that are sharper than a star."""
    timings_us: FrameTimings
    remarks: Sequence[str] = ()
    """Remarks on the frame in words: fitted values, choices in the file, and changes of
    orientation."""


class Detection(Model, frozen=True, kw_only=True):
    """Candidate for a star on a frame. The first pixel's centre is (0, 0); u counts columns."""

    u_px: float | None
    """Place along the frame's columns, in pixels; None if not measured, see `left_out`."""
    v_px: float | None
    sigma_u_px: float | None
    """Predicted, one standard deviation."""
    sigma_v_px: float | None
    flux_counts: float | None
    magnitude: float | None
    signal_ratio: float | None
    """Signal divided by its noise."""
    flags: Sequence[str]
    used: bool
    """True if it is in the batch, which has the same order."""
    left_out: str | None
    """Why it is not in the batch."""


class FrameWithStars(FrameSummary, frozen=True, kw_only=True):
    """Summary of a frame with all candidates for stars."""

    stars: Sequence[Detection]
    """The stars in the batch come first."""
    hot_or_cosmic_px: Sequence[Sequence[float]]
    """Positions (u, v) of rejected hot pixels and cosmic rays; the first 500."""


class StarRef(Model, frozen=True, kw_only=True):
    """Reference to a star of the catalog."""

    catalog: str
    id: str


class Star(Model, frozen=True, kw_only=True):
    """Identification of one observed star."""

    outcome: Outcome
    star: StarRef | None
    votes: int
    """Highest number of votes (STARID)."""
    runner_up: int
    """Second highest number of votes; equal to `votes` in a tie."""
    rivals: Sequence[str] = ()
    """Catalog stars that an ambiguous star may be: those with equal votes or, with probabilities,
    the probable ones, most probable first."""
    rival_probabilities: Sequence[float] = ()
    """Probability of each entry of `rivals`, if the identifier gives probabilities."""
    probability: float | None
    """Probability of `star`; for an ambiguous star, of its most probable rival; for an unmatched
    star, that it is no star of the zone. None: the identifier gives none."""
    residual_arcsec: float | None
    """None if the attitude does not use the star."""
    flags: Sequence[str]


class ZoneSummary(Model, frozen=True, kw_only=True):
    """Zone: the part of the sky in which the service searched for stars."""

    kind: str
    ra_deg: float
    """Centre of the cap, or pole of the band."""
    dec_deg: float
    stars: int
    """Number of stars (NCAP)."""
    pairs: int
    """Number of pairs (NTOT)."""


class SearchedZone(ZoneSummary, frozen=True, kw_only=True):
    """Zone that the service searched for a tracker's stars in a batch."""

    cached: bool


class TrackerStars(Model, frozen=True, kw_only=True):
    """Identified stars of one tracker, in the order observed."""

    tracker: str
    zone: SearchedZone | None
    """Zone in which the stars were searched for; None if the whole sky gave no attitude."""
    stars: Sequence[Star]


class StarCounts(Model, frozen=True, kw_only=True):
    """Number of stars by outcome of the identification."""

    observed: int
    unique: int
    ambiguous: int
    unmatched: int


class TrackerFit(Model, frozen=True, kw_only=True):
    """Agreement of one tracker with the attitude from all trackers."""

    tracker: str
    stars: int
    taste: float
    outlier: bool


class Rival(Model, frozen=True, kw_only=True):
    """Rival attitude, from stars that the better attitude leaves unexplained."""

    quaternion: Sequence[float]
    covariance_arcsec2: Sequence[Sequence[float]]
    probability: float
    """Its probability, relative to the first attitude."""
    angle_deg: float
    """The rotation between the two attitudes."""
    stars: Sequence[Sequence[str | None]]
    """Catalog stars of the rival attitude for each tracker, in the order observed; None for a star
    that does not support it."""


class Attitude(Model, frozen=True, kw_only=True):
    """An attitude with its accuracy and consistency; use it only where `status` is good."""

    quaternion: Sequence[float]
    frame: str
    covariance_arcsec2: Sequence[Sequence[float]]
    method: str
    """Method that gave the attitude. `measured`: a tracker measured it itself; fields that need
    stars are None then."""
    residual_rms_arcsec: float | None
    predicted_rms_arcsec: float | None
    taste: float | None
    """Weighted sum of squared residuals; follows chi-square."""
    degrees_of_freedom: int
    status: Status
    """Consistency of the attitude. `suspect`: `taste` exceeds its 99.9 % point, or there is a
    `rival`."""
    triad: Sequence[float] | None
    quest: Sequence[float] | None
    triad_quest_angle_arcsec: float | None
    trackers: Sequence[TrackerFit] = ()
    """If there are several trackers."""
    outlier: str | None = None
    """The tracker that disagrees."""
    rival: Rival | None = None
    """The less probable attitude, if two groups of stars give two attitudes."""


class Timings(Model, frozen=True, kw_only=True):
    """Duration of each step of the processing of a batch, in microseconds."""

    zone: int
    identify: int
    solve: int
    record: int | None
    """None if nothing was recorded."""


class Provenance(Model, frozen=True, kw_only=True):
    """Versions of the data and of the program that produced an answer."""

    catalog: str
    run_catalog: str
    epoch_year: float
    mission: str
    version: str


class Prediction(Model, frozen=True, kw_only=True):
    """Attitude that was predicted for a batch that asks for the last attitude."""

    quaternion: Sequence[float]
    covariance_arcsec2: Sequence[Sequence[float]]
    """Covariance of the rotation about the body axes."""
    margin_deg: float
    """How far the zones reach beyond the fields of view."""
    result: str | None
    """The result whose attitude it came from."""
    age_s: float | None
    """Time since that attitude."""
    rate: str | None
    """What told how the body turned since then."""


class Tracking(Model, frozen=True, kw_only=True):
    """Tracking state of a batch that asks for the last attitude, with its prediction."""

    state: str
    """Tracking state. `tracking`: a good attitude was found about the prediction, or the prediction
    identified a star of a batch that has no attitude. `acquiring`: a good attitude was found in the
    whole sky. `lost`: none of these."""
    by_default: bool
    """The mission asks for it, not the batch."""
    prediction: Prediction | None
    reason: str | None
    """Why nothing was predicted."""


class WhatIf(Model, frozen=True, kw_only=True):
    """The answer to a batch, as it is recorded."""

    id: str | None
    """None for a what-if that was not recorded."""
    spacecraft: str
    batch: str
    run: str
    time: str
    identifier: Identifier
    path: str
    """Way in which the attitude was found. `zone`: the service searched about the a priori
    attitude. `lost_in_space`: without an a priori attitude, it searched about an attitude from the
    whole sky. `zone_then_lost_in_space`: the first search found nothing good, so the service made
    the second. `measured`: the batch holds an attitude that a tracker measured; nothing was
    searched for, and `identifier` was not used."""
    observations: Sequence[TrackerStars]
    counts: StarCounts
    attitude: Attitude | None
    reason: str | None
    """Why there is no attitude."""
    warnings: Sequence[str]
    timings_us: Timings
    provenance: Provenance
    parent: str | None = None
    """Result that a what-if started from; absent for other results."""
    recorded: bool = True
    """True if this what-if was recorded."""
    frame: FrameSummary | None = None
    """Summary of the frame, for a batch that was made from a frame."""
    tracking: Tracking | None = None
    """Tracking state, for a batch that asks for the last attitude."""


class Answer(WhatIf, frozen=True, kw_only=True):
    """The answer to a batch that was recorded."""

    id: str


class Summary(Model, frozen=True, kw_only=True):
    """Entry of a list of results, without stars and attitude."""

    id: str
    spacecraft: str
    batch: str
    run: str
    time: str
    received: str
    """Time at which the service first received the batch."""
    created: str
    """Time at which this result was recorded."""
    identifier: str
    options: dict[str, Any]
    """Options that replaced the mission's settings."""
    counts: StarCounts
    status: Status | None
    """Status of the attitude; None without an attitude."""
    reason: str | None
    measures: dict[str, float | None]
    parent: str | None
    """The result that a what-if started from; a current result with one is adopted."""
    current: bool
    """True if this is the current result of its batch."""
    archived: bool
    """True if it is read from the archive, which takes longer."""


class Signature(Model, frozen=True, kw_only=True):
    """Signature on a recorded or adopted what-if: author, time and comment."""

    who: str
    at: str
    comment: str | None


class Replacement(Model, frozen=True, kw_only=True):
    """Adopted what-if that is current in place of another result of its batch."""

    result: str
    signature: Signature | None
    """Signature of its adoption; None if the audit list has none."""


class Result(Model, frozen=True, kw_only=True):
    """A result with its batch, and the other results of that batch."""

    answer: Answer
    input: dict[str, Any]
    """The batch as it was sent, without default values. The service adds the prediction to one that
    asks for the last attitude."""
    options: dict[str, Any]
    """Options of this result that replaced the mission's settings; `provenance.mission` identifies
    those settings."""
    measures: dict[str, float | None]
    current: bool
    parent: str | None
    signature: Signature | None = None
    """Signature on a recorded what-if; None if the audit list has none."""
    replaced_by: Replacement | None = None
    """The adopted what-if that is current in place of this result; absent if there is none."""
    archived: bool
    """True if it is read from the archive, which takes longer."""
    what_ifs: Sequence[Summary]
    frame: FrameWithStars | None = None
    """Frame with all candidates for stars, for a batch that was made from a frame."""
