"""The answer to a batch, recorded results, pictures, tracks of unexplained stars, data of events.

Quaternions have the scalar last and transform inertial (EME2000) into body components.  Times
are UTC in calendar form, as text: they may be in a leap second and have nanoseconds.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from ..base import Identifier, Model, Outcome, Status


class StarRef(Model, frozen=True):
    """A star of the catalog, such as `HIP 26311`."""

    catalog: str
    id: str


class Star(Model, frozen=True, kw_only=True):
    """The result for one observed star; `outcome` is unique, ambiguous or unmatched.

    `probability` is that of `star`, of the most probable of `rivals`, or that it is no star of
    the zone; None where the identifier gives none.
    """

    outcome: Outcome
    star: StarRef | None
    votes: int
    runner_up: int
    rivals: Sequence[str] = ()
    rival_probabilities: Sequence[float] = ()
    probability: float | None
    residual_arcsec: float | None
    flags: Sequence[str]


class SearchedZone(Model, frozen=True):
    """The part of the sky in which the service searched for the stars of a tracker."""

    kind: str
    ra_deg: float
    dec_deg: float
    stars: int
    pairs: int
    cached: bool


class TrackerStars(Model, frozen=True):
    """One tracker's stars, in the order observed."""

    tracker: str
    zone: SearchedZone | None
    stars: Sequence[Star]


class StarCounts(Model, frozen=True):
    """Stars by outcome."""

    observed: int
    unique: int
    ambiguous: int
    unmatched: int


class TrackerFit(Model, frozen=True):
    """Agreement of one tracker with the attitude from all trackers."""

    tracker: str
    stars: int
    taste: float
    outlier: bool


class Rival(Model, frozen=True):
    """A second attitude, from stars that the first one leaves unexplained."""

    quaternion: Sequence[float]
    covariance_arcsec2: Sequence[Sequence[float]]
    probability: float
    angle_deg: float
    stars: Sequence[Sequence[str | None]]


class Attitude(Model, frozen=True):
    """An attitude with its accuracy; use it only where `status` is good.

    `covariance_arcsec2` (3, 3) is of the small error rotation about the body axes.  The method
    `measured` is that of an attitude that a tracker sent: what needs stars is None then.
    """

    quaternion: Sequence[float]
    frame: str
    covariance_arcsec2: Sequence[Sequence[float]]
    method: str
    residual_rms_arcsec: float | None
    predicted_rms_arcsec: float | None
    taste: float | None
    degrees_of_freedom: int
    status: Status
    triad: Sequence[float] | None
    quest: Sequence[float] | None
    triad_quest_angle_arcsec: float | None
    trackers: Sequence[TrackerFit] = ()
    outlier: str | None = None
    rival: Rival | None = None


class Timings(Model, frozen=True):
    """Microseconds per step; `record` is None where nothing was recorded."""

    zone: int
    identify: int
    solve: int
    record: int | None


class Provenance(Model, frozen=True):
    """The versions of the data and the program that made the answer."""

    catalog: str
    run_catalog: str
    epoch_year: float
    mission: str
    version: str


class FrameTimings(Model, frozen=True):
    """Microseconds per step from file to stars."""

    read: int
    detect: int
    centroid: int


class FrameSummary(Model, frozen=True, kw_only=True):
    """The frame of a batch, and the numbers of detected stars."""

    digest: str
    format: str
    tracker: str
    width_px: int
    height_px: int
    exposure_s: float
    centroid: str
    background_counts: float
    noise_counts: float
    candidates: int
    measured: int
    used: int
    hot_or_cosmic: int
    timings_us: FrameTimings
    remarks: Sequence[str] = ()


class Detection(Model, frozen=True):
    """One measured candidate.  The centre of the first pixel is (0, 0); u counts columns."""

    u_px: float | None
    v_px: float | None
    sigma_u_px: float | None
    sigma_v_px: float | None
    flux_counts: float | None
    magnitude: float | None
    signal_ratio: float | None
    flags: Sequence[str]
    used: bool
    left_out: str | None


class FrameWithStars(FrameSummary, frozen=True, kw_only=True):
    """A frame with every candidate; those in the batch come first."""

    stars: Sequence[Detection]
    hot_or_cosmic_px: Sequence[Sequence[float]]


class Prediction(Model, frozen=True, kw_only=True):
    """The attitude that was predicted for a batch, and the result that it came from."""

    quaternion: Sequence[float]
    covariance_arcsec2: Sequence[Sequence[float]]
    margin_deg: float
    result: str | None
    age_s: float | None
    rate: str | None


class Tracking(Model, frozen=True, kw_only=True):
    """What came of asking for the last attitude: `state` is acquiring, tracking or lost."""

    state: str
    by_default: bool
    prediction: Prediction | None
    reason: str | None


class AnswerFields(Model, frozen=True, kw_only=True):
    """What every answer has.  Without an attitude, `reason` says why there is none.

    `parent` is the result that a what-if started from.
    """

    spacecraft: str
    batch: str
    run: str
    time: str
    identifier: Identifier
    path: str
    observations: Sequence[TrackerStars]
    counts: StarCounts
    attitude: Attitude | None
    reason: str | None
    warnings: Sequence[str]
    timings_us: Timings
    provenance: Provenance
    parent: str | None = None
    recorded: bool = True
    frame: FrameSummary | None = None
    tracking: Tracking | None = None


class Answer(AnswerFields, frozen=True, kw_only=True):
    """The answer to a batch that was recorded."""

    id: str


class WhatIf(AnswerFields, frozen=True, kw_only=True):
    """The answer to a what-if; `id` is None where it was not recorded."""

    id: str | None


class Summary(Model, frozen=True, kw_only=True):
    """A result in a list, without its stars and its attitude; `status` is the attitude's.

    `measures` has quantities of the result, None where they could not be measured.  `current`
    tells whether this result stands for its batch.
    """

    id: str
    spacecraft: str
    batch: str
    run: str
    time: str
    received: str
    created: str
    identifier: Identifier
    options: dict[str, Any]
    counts: StarCounts
    status: Status | None
    reason: str | None
    measures: dict[str, float | None]
    parent: str | None
    current: bool
    archived: bool


class Signature(Model, frozen=True, kw_only=True):
    """Who recorded or adopted a what-if, when and why."""

    who: str
    at: str
    comment: str | None


class Result(Model, frozen=True, kw_only=True):
    """A result with its batch as it was sent, and the other results of that batch."""

    answer: Answer
    input: dict[str, Any]
    options: dict[str, Any]
    measures: dict[str, float | None]
    current: bool
    parent: str | None
    archived: bool
    what_ifs: Sequence[Summary]
    frame: FrameWithStars | None = None
    signature: Signature | None = None


class PictureAttitude(Model, frozen=True, kw_only=True):
    """The attitude of a picture; the quaternion turns ICRS into the camera's axes."""

    status: str
    quaternion: Sequence[float]
    sigma_arcsec: Sequence[float]
    ra_deg: float
    dec_deg: float
    roll_deg: float
    aberration: str
    log_odds: float


class PictureLens(Model, frozen=True, kw_only=True):
    """The lens that fits a picture; None: the sigma of a parameter that was not fitted."""

    field_deg: Sequence[float]
    focal_px: float
    focal_sigma_px: float | None
    distortion_corner: float
    distortion_sigma: float | None
    center_px: Sequence[float]
    center_sigma_px: float | None


class PictureStar(Model, frozen=True, kw_only=True):
    """A star on a picture; the residual is its place less the expected one."""

    id: str
    name: str | None
    v_mag: float
    u_px: float
    v_px: float
    residual_px: Sequence[float]


class Picture(Model, frozen=True, kw_only=True):
    """The attitude, lens and stars of a picture; without an attitude, `remarks` say what to try."""

    width_px: int
    height_px: int
    candidates: int
    psf_sigma_px: float
    noise_counts: float
    attitude: PictureAttitude | None
    orientation: str
    remarks: Sequence[str]
    time: str | None
    exposure_s: float | None
    lens: PictureLens | None
    residual_rms_px: float | None
    sigma_scale: float | None
    shared_error_px: float | None
    zero_point_mag: float | None
    zero_point_sigma_mag: float | None
    stars: Sequence[PictureStar]
    overlay_png: str | None = None


class TrackPoint(Model, frozen=True):
    """A point of a track: the result, the tracker, and its place among the tracker's stars."""

    id: str
    tracker: str
    star: int
    time: str
    ra_deg: float
    dec_deg: float
    magnitude: float | None


class Track(Model, frozen=True, kw_only=True):
    """Points that move together; direction and rate hold for `time`, the middle.

    `kind` is moving, planet, fixed_on_sky, fixed_on_detector or fixed.  Components along right
    ascension are on the sky: with the cosine of the declination.
    """

    kind: str
    planet: str | None
    planet_offset_arcsec: float | None
    first: str
    last: str
    time: str
    ra_deg: float
    dec_deg: float
    sigma_ra_arcsec: float
    sigma_dec_arcsec: float
    rate_ra_arcsec_per_s: float
    rate_dec_arcsec_per_s: float
    sigma_rate_ra_arcsec_per_s: float
    sigma_rate_dec_arcsec_per_s: float
    rate_arcsec_per_s: float
    sigma_rate_arcsec_per_s: float
    magnitude: float | None
    sigma_magnitude: float | None
    chi_square: float
    degrees_of_freedom: int
    log10_expected: float
    points: list[TrackPoint]


class TrackList(Model, frozen=True, kw_only=True):
    """The tracks of a period, those of most points first.

    `unexplained` counts the unmatched stars of batches with an attitude, `linked` those of them
    that are points of a track.
    """

    spacecraft: str
    run: str
    batches: int
    without_attitude: int
    unexplained: int
    linked: int
    items: list[Track]


class LatestBatch(Model, frozen=True, kw_only=True):
    """The latest of the batches of an event; `status` is None without an attitude."""

    id: str
    batch: str
    time: str
    status: Status | None
    reason: str | None
    counts: StarCounts


class Recorded(Model, frozen=True, kw_only=True):
    """Batches that were recorded: how many, and the latest of them."""

    spacecraft: str
    run: str
    batches: int
    latest: LatestBatch


class Adopted(Model, frozen=True, kw_only=True):
    """A what-if that was adopted: its id, and that of the batch."""

    spacecraft: str
    run: str
    id: str
    batch_id: str


class Limit(Model, frozen=True, kw_only=True):
    """The limits of a quantity; `since`, `who` and `comment` are None for the default."""

    spacecraft: str
    quantity: str
    tracker: str | None = None
    unit: str
    is_default: bool
    since: str | None
    who: str | None
    comment: str | None
    settings: Mapping[str, Any]


class AnnotationChange(Model, frozen=True, kw_only=True):
    """A note that was written, or deleted."""

    id: str
    spacecraft: str | None
    start: str
    end: str | None
    text: str
    who: str
    created: str
    deleted: bool


class TrackingChange(Model, frozen=True, kw_only=True):
    """A change of the tracking state of a spacecraft at a batch; None: not tracked."""

    spacecraft: str
    run: str
    id: str
    batch: str
    time: str
    state: str | None
    before: str | None
