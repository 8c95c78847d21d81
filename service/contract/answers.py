"""Records of answers to batches, of the stars on a frame, and of results in lists."""

from functools import cache
from typing import Annotated, Any, ClassVar, Literal

from msgspec import UNSET, Raw, Struct, UnsetType
from pydantic import BaseModel, Field, GetCoreSchemaHandler, create_model
from pydantic_core import CoreSchema

from service.acquire.result import TrackingState
from service.contract.base import (
    Absent,
    Count,
    Covariance,
    DescribedAs,
    Digest,
    Id,
    MissionSettings,
    Moment,
    Outcome,
    Quaternion,
    Reason,
    Record,
    Shape,
    Stamp,
    Status,
    doc,
    list_record,
    page_record,
)
from service.contract.problems import Problem
from service.missions import mission
from service.observations.schema import BatchIn, NoPrediction, RateSource
from service.trends.quantities import QUANTITIES, value_names

Identifier = Annotated[str, DescribedAs(mission.Identifier)]


class FrameTimings(Record, frozen=True, kw_only=True):
    """Duration of each step from a frame's file to its stars, in microseconds."""

    component: ClassVar[str] = "FrameTimingsOut"
    read: Count
    detect: Count
    centroid: Count


class FrameSummary(Record, frozen=True, kw_only=True):
    """Summary of the frame from which a batch was made, with the numbers of detected stars."""

    component: ClassVar[str] = "FrameOut"
    digest: Digest
    format: Annotated[
        str, DescribedAs(Literal["FITS", "TIFF", "PNG", "NPY", "JPEG", "BMP", "GIF", "PGM", "RAW"])
    ]
    tracker: str
    width_px: Count
    height_px: Count
    exposure_s: float
    centroid: Annotated[str, DescribedAs(Literal["window", "scan", "matched", "recursive"])]
    background_counts: Annotated[float, doc("Median background above the bias.")]
    noise_counts: Annotated[float, doc("Standard deviation of a background pixel.")]
    candidates: Annotated[Count, doc("Detections above the threshold, without hot pixels.")]
    measured: Annotated[Count, doc("The brightest of these, whose positions were measured.")]
    used: Annotated[Count, doc("Measured detections that are stars of the batch.")]
    hot_or_cosmic: Annotated[Count, doc("Detections that are sharper than a star.")]
    timings_us: FrameTimings
    remarks: list[str] | UnsetType = UNSET
    """Remarks on the frame in words: fitted values, choices in the file, and changes of
        orientation."""


class Detection(Record, frozen=True, kw_only=True):
    """Candidate for a star on a frame. The first pixel's centre is (0, 0); u counts columns."""

    component: ClassVar[str] = "DetectionOut"
    u_px: float | None
    """Place along the frame's columns, in pixels; null if not measured, see `left_out`."""
    v_px: float | None
    sigma_u_px: Annotated[float | None, doc("Predicted, one standard deviation.")]
    sigma_v_px: float | None
    flux_counts: float | None
    magnitude: float | None
    signal_ratio: Annotated[float | None, doc("Signal divided by its noise.")]
    flags: list[
        Annotated[
            str,
            DescribedAs(
                Literal[
                    "saturated",
                    "edge",
                    "blended",
                    "too_faint",
                    "outside_hump",
                    "masked_pixels",
                    "truncated",
                    "not_converged",
                ]
            ),
        ]
    ]
    used: Annotated[bool, doc("True if it is in the batch, which has the same order.")]
    left_out: Annotated[str | None, doc("Why it is not in the batch.")]


class FrameWithStars(FrameSummary, frozen=True, kw_only=True):
    """Summary of a frame with all candidates for stars."""

    component: ClassVar[str] = "FrameRecordOut"
    stars: Annotated[list[Detection], doc("The stars in the batch come first.")]
    hot_or_cosmic_px: list[Annotated[list[float], Field(min_length=2, max_length=2)]]
    """Positions (u, v) of rejected hot pixels and cosmic rays; the first 500."""


class StarRef(Record, frozen=True, kw_only=True):
    """Reference to a star of the catalog."""

    catalog: Annotated[str, Field(examples=["HIP"])]
    id: Annotated[str, Field(examples=["HIP 26311"])]


class Star(Record, frozen=True, kw_only=True):
    """Identification of one observed star."""

    component: ClassVar[str] = "StarOut"
    outcome: Outcome
    star: StarRef | None
    votes: Annotated[Count, doc("Highest number of votes (STARID).")]
    runner_up: Annotated[Count, doc("Second highest number of votes; equal to `votes` in a tie.")]
    rivals: list[str] | UnsetType = UNSET
    """Catalog stars that an ambiguous star may be: those with equal votes or, with
        probabilities, the probable ones, most probable first."""
    rival_probabilities: list[float] | UnsetType = UNSET
    """Probability of each entry of `rivals`, if the identifier gives probabilities."""
    probability: float | None
    """Probability of `star`; for an ambiguous star, of its most probable rival; for an unmatched
    star, that it is no star of the zone. null: the identifier gives none."""
    residual_arcsec: Annotated[float | None, doc("null if the attitude does not use the star.")]
    flags: list[
        Annotated[
            str, DescribedAs(Literal["outside_field_of_view", "no_magnitude", "same_star_twice"])
        ]
    ]


ZoneKind = Annotated[str, DescribedAs(Literal["cap", "band"])]
ZoneRightAscension = Annotated[float, doc("Centre of the cap, or pole of the band.")]
ZoneStarCount = Annotated[Count, doc("Number of stars (NCAP).")]
ZonePairCount = Annotated[Count, doc("Number of pairs (NTOT).")]


class ZoneSummary(Record, frozen=True, kw_only=True):
    """Zone: the part of the sky in which the service searched for stars."""

    kind: ZoneKind
    ra_deg: ZoneRightAscension
    dec_deg: float
    stars: ZoneStarCount
    pairs: ZonePairCount


class SearchedZone(ZoneSummary, frozen=True, kw_only=True):
    """Zone that the service searched for a tracker's stars in a batch."""

    component: ClassVar[str] = "ZoneOut"
    cached: bool


class TrackerStars(Record, frozen=True, kw_only=True):
    """Identified stars of one tracker, in the order observed."""

    component: ClassVar[str] = "TrackerOut"
    tracker: str
    zone: SearchedZone | None
    """Zone in which the stars were searched for; null if the whole sky gave no attitude."""
    stars: list[Star]


class StarCounts(Record, frozen=True, kw_only=True):
    """Number of stars by outcome of the identification."""

    component: ClassVar[str] = "CountsOut"
    observed: Count
    unique: Count
    ambiguous: Count
    unmatched: Count


class TrackerFit(Record, frozen=True, kw_only=True):
    """Agreement of one tracker with the attitude from all trackers."""

    component: ClassVar[str] = "TrackerFitOut"
    tracker: str
    stars: Count
    taste: float
    outlier: bool


class Rival(Record, frozen=True, kw_only=True):
    """Rival attitude, from stars that the better attitude leaves unexplained."""

    component: ClassVar[str] = "RivalOut"
    quaternion: Quaternion
    covariance_arcsec2: Covariance
    probability: Annotated[float, doc("Its probability, relative to the first attitude.")]
    angle_deg: Annotated[float, doc("The rotation between the two attitudes.")]
    stars: list[list[str | None]]
    """Catalog stars of the rival attitude for each tracker, in the order observed; null for a
        star that does not support it."""


class Attitude(Record, frozen=True, kw_only=True):
    """An attitude with its accuracy and consistency; use it only where `status` is good."""

    component: ClassVar[str] = "AttitudeOut"
    quaternion: Quaternion
    frame: Annotated[str, DescribedAs(Literal["EME2000"])]
    covariance_arcsec2: Covariance
    method: Annotated[str, DescribedAs(Literal["quest", "triad", "measured"])]
    """Method that gave the attitude. `measured`: a tracker measured it itself; fields that need
        stars are null then."""
    residual_rms_arcsec: float | None
    predicted_rms_arcsec: float | None
    taste: Annotated[float | None, doc("Weighted sum of squared residuals; follows chi-square.")]
    degrees_of_freedom: Count
    status: Status
    """Consistency of the attitude. `suspect`: `taste` exceeds its 99.9 % point, or there is a
        `rival`."""
    triad: Quaternion | None
    quest: Quaternion | None
    triad_quest_angle_arcsec: float | None
    trackers: Annotated[list[TrackerFit] | UnsetType, doc("If there are several trackers.")] = UNSET
    outlier: Annotated[str | UnsetType | None, doc("The tracker that disagrees.")] = UNSET
    rival: Rival | UnsetType | None = UNSET
    """The less probable attitude, if two groups of stars give two attitudes."""


class Timings(Record, frozen=True, kw_only=True):
    """Duration of each step of the processing of a batch, in microseconds."""

    component: ClassVar[str] = "TimingsOut"
    zone: Count
    identify: Count
    solve: Count
    record: Annotated[int | None, doc("null if nothing was recorded.")]


class Provenance(Record, frozen=True, kw_only=True):
    """Versions of the data and of the program that produced an answer."""

    component: ClassVar[str] = "ProvenanceOut"
    catalog: Digest
    run_catalog: Digest
    epoch_year: float
    mission: Digest
    version: str


_Rate = Annotated[str, DescribedAs(RateSource)]
_NoPrediction = Annotated[str, DescribedAs(NoPrediction)]


class Prediction(Record, frozen=True, kw_only=True):
    """Attitude that was predicted for a batch that asks for the last attitude."""

    component: ClassVar[str] = "PredictionOut"
    quaternion: Quaternion
    covariance_arcsec2: Annotated[
        Covariance, doc("Covariance of the rotation about the body axes.")
    ]
    margin_deg: Annotated[float, doc("How far the zones reach beyond the fields of view.")]
    result: Annotated[str | None, doc("The result whose attitude it came from.")]
    age_s: Annotated[float | None, doc("Time since that attitude.")]
    rate: Annotated[_Rate | None, doc("What told how the body turned since then.")]


class Tracking(Record, frozen=True, kw_only=True):
    """Tracking state of a batch that asks for the last attitude, with its prediction."""

    component: ClassVar[str] = "TrackingOut"
    state: Annotated[str, DescribedAs(TrackingState)]
    """Tracking state. `tracking`: a good attitude was found about the prediction, or the
        prediction identified a star of a batch that has no attitude. `acquiring`: a good
        attitude was found in the whole sky. `lost`: none of these."""
    by_default: Annotated[bool, doc("The mission asks for it, not the batch.")]
    prediction: Prediction | None
    reason: Annotated[_NoPrediction | None, doc("Why nothing was predicted.")]


class Answer(Record, frozen=True, kw_only=True):
    """The answer to a batch, as it is recorded."""

    client_name: ClassVar[str] = "WhatIf"
    id: Annotated[Id | None, doc("null for a what-if that was not recorded.")]
    spacecraft: str
    batch: str
    run: str
    time: Moment
    identifier: Identifier
    path: Annotated[
        str, DescribedAs(Literal["zone", "lost_in_space", "zone_then_lost_in_space", "measured"])
    ]
    """Way in which the attitude was found. `zone`: the service searched about the a priori
        attitude. `lost_in_space`: without an a priori attitude, it searched about an attitude
        from the whole sky. `zone_then_lost_in_space`: the first search found nothing good, so
        the service made the second. `measured`: the batch holds an attitude that a tracker
        measured; nothing was searched for, and `identifier` was not used."""
    observations: list[TrackerStars]
    counts: StarCounts
    attitude: Attitude | None
    reason: Annotated[Reason | None, doc("Why there is no attitude.")]
    warnings: list[str]
    timings_us: Timings
    provenance: Provenance
    parent: Id | UnsetType | None = UNSET
    """Result that a what-if started from; absent for other results."""
    recorded: Annotated[
        bool | UnsetType, Absent(True), doc("True if this what-if was recorded.")
    ] = UNSET
    frame: FrameSummary | UnsetType | None = UNSET
    """Summary of the frame, for a batch that was made from a frame."""
    tracking: Tracking | UnsetType | None = UNSET
    """Tracking state, for a batch that asks for the last attitude."""


class RecordedAnswer(Answer, frozen=True, kw_only=True):
    """The answer to a batch that was recorded."""

    component: ClassVar[str] = ""
    client_name: ClassVar[str] = "Answer"
    id: Id


class _MeasuresShape:
    """Description of a result's measures, built from the registry of quantities."""

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return handler(_measures_shape(value_names()))


@cache
def _measures_shape(names: tuple[str, ...]) -> type[BaseModel]:
    fields: dict[str, Any] = {
        name: (float | None, Field(description=QUANTITIES[name].description or None))
        for name in names
    }
    text = "Quantities of a result; null: not measurable, or unknown."
    return create_model("MeasuresOut", __base__=Shape, __doc__=text, **fields)


Measures = Annotated[dict[str, float | None], DescribedAs(_MeasuresShape)]


class Summary(Record, frozen=True, kw_only=True):
    """Entry of a list of results, without stars and attitude."""

    id: Id
    spacecraft: str
    batch: str
    run: str
    time: Moment
    received: Annotated[Stamp, doc("Time at which the service first received the batch.")]
    created: Annotated[Stamp, doc("Time at which this result was recorded.")]
    identifier: str
    options: Annotated[MissionSettings, doc("Options that replaced the mission's settings.")]
    counts: StarCounts
    status: Annotated[Status | None, doc("Status of the attitude; null without an attitude.")]
    reason: Reason | None
    measures: Measures
    parent: Annotated[
        Id | None,
        doc("The result that a what-if started from; a current result with one is adopted."),
    ]
    current: Annotated[bool, doc("True if this is the current result of its batch.")]
    archived: Annotated[bool, doc("True if it is read from the archive, which takes longer.")]


BatchPage = page_record("BatchPage", Summary, "A page of results.")


class Signature(Record, frozen=True, kw_only=True):
    """Signature on a recorded or adopted what-if: author, time and comment."""

    who: str
    at: Stamp
    comment: str | None


class Replacement(Record, frozen=True, kw_only=True):
    """Adopted what-if that is current in place of another result of its batch."""

    result: Id
    signature: Signature | None
    """Signature of its adoption; null if the audit list has none."""


class Result(Record, frozen=True, kw_only=True):
    """A result with its batch, and the other results of that batch."""

    component: ClassVar[str] = "Record"
    answer: Annotated[RecordedAnswer, DescribedAs(Answer)]
    input: Annotated[dict[str, Any], DescribedAs(BatchIn)]
    """The batch as it was sent, without default values. The service adds the prediction to one that
    asks for the last attitude."""
    options: MissionSettings
    """Options of this result that replaced the mission's settings; `provenance.mission` identifies
    those settings."""
    measures: Measures
    current: bool
    parent: Id | None
    signature: Signature | UnsetType | None = UNSET
    """Signature on a recorded what-if; null if the audit list has none."""
    replaced_by: Replacement | UnsetType = UNSET
    """The adopted what-if that is current in place of this result; absent if there is none."""
    archived: Annotated[bool, doc("True if it is read from the archive, which takes longer.")]
    what_ifs: list[Summary]
    frame: FrameWithStars | UnsetType | None = UNSET
    """Frame with all candidates for stars, for a batch that was made from a frame."""


class Neighbours(Struct, frozen=True):
    """Results before and after a result in time, and the id of the current result of its batch."""

    current: str | None
    earlier: Summary | None
    later: Summary | None


class BatchOutcome(Record, frozen=True, kw_only=True):
    """The outcome of one batch of an array: its answer or its problem, the other is null."""

    status: int
    """HTTP status that the batch alone would have had: 201 if it is now recorded, 200 if it was
        recorded before, or the status of the problem."""
    answer: Annotated[Raw | None, DescribedAs(Answer | None), doc("As it is recorded.")]
    problem: Problem | None


BatchOutcomes = list_record(
    "BatchOutcomes",
    BatchOutcome,
    "One outcome for each batch of an array, in the order in which they were sent.",
)
