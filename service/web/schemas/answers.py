"""The answer to a batch, and answers in lists."""

from typing import Annotated, Literal

from pydantic import Field

from service.observe.wire import BatchIn
from service.web.schemas.base import (
    Count,
    Covariance,
    Digest,
    Id,
    Moment,
    Outcome,
    Quaternion,
    Reason,
    Settings,
    Shape,
    Status,
)


class StarRef(Shape):
    """A star of the catalog."""

    catalog: str = Field(examples=["HIP"])
    id: str = Field(examples=["HIP 26311"])


class StarOut(Shape):
    """What became of one observed star."""

    outcome: Outcome
    star: StarRef | None
    votes: Count = Field(description="STARID's highest tally.")
    runner_up: Count = Field(description="The second highest; equal to `votes` in a tie.")
    rivals: list[str] = Field(
        default=[],
        description="Which stars it may be, where it is not unique: those tied in votes, or where "
        "the identifier gives probabilities all that are likely enough, the likeliest first.",
    )
    rival_probabilities: list[float] = Field(
        default=[], description="Of each of `rivals`, where the identifier gives probabilities."
    )
    probability: float | None = Field(
        description="That it is `star`; of an ambiguous star its likeliest rival's; of an "
        "unmatched one that it is no star of the zone. null where the identifier gives none."
    )
    residual_arcsec: float | None = Field(description="null where the star is in no attitude.")
    flags: list[Literal["outside_field_of_view", "no_magnitude"]]


class ZoneSummary(Shape):
    """The part of the sky that stars were looked for in."""

    kind: Literal["cap", "band"]
    ra_deg: float = Field(description="Of the cap's centre, of the band's pole.")
    dec_deg: float
    stars: Count = Field(description="NCAP.")
    pairs: Count = Field(description="NTOT.")


class ZoneOut(ZoneSummary):
    """A zone as a batch met it."""

    cached: bool


class TrackerOut(Shape):
    """One tracker's stars, in the order observed."""

    tracker: str
    zone: ZoneOut | None = Field(
        description="null where the whole sky gave no attitude to look about."
    )
    stars: list[StarOut]


class CountsOut(Shape):
    """Stars by outcome."""

    observed: Count
    unique: Count
    ambiguous: Count
    unmatched: Count


class TrackerFitOut(Shape):
    """How one tracker agrees with the attitude of all."""

    tracker: str
    stars: Count
    taste: float
    outlier: bool


class RivalOut(Shape):
    """A second attitude, of a group of stars that the first one leaves unexplained."""

    quaternion: Quaternion
    covariance_arcsec2: Covariance
    probability: float = Field(description="Its share of the two.")
    angle_deg: float = Field(description="The rotation between the two attitudes.")
    stars: list[list[str | None]] = Field(
        description="Of every tracker its stars in the order observed; null for a star that is "
        "not in the group."
    )


class AttitudeOut(Shape):
    """An attitude with all that tells how far to trust it."""

    quaternion: Quaternion
    frame: Literal["EME2000"]
    covariance_arcsec2: Covariance
    method: Literal["quest", "triad"]
    residual_rms_arcsec: float
    predicted_rms_arcsec: float
    taste: float = Field(description="Weighted sum of squares; about chi-square.")
    degrees_of_freedom: Count
    status: Status = Field(
        description="`suspect`: `taste` is beyond its 99.9 % point, or there is a `rival`."
    )
    triad: Quaternion
    quest: Quaternion
    triad_quest_angle_arcsec: float
    trackers: list[TrackerFitOut] = Field(default=[], description="Where there are several.")
    outlier: str | None = Field(default=None, description="The tracker that disagrees.")
    rival: RivalOut | None = Field(
        default=None,
        description="Where two groups of stars have each an attitude of their own, the less "
        "likely one.",
    )


class TimingsOut(Shape):
    """Microseconds per step."""

    zone: Count
    identify: Count
    solve: Count
    record: int | None = Field(description="null where nothing was recorded.")


class ProvenanceOut(Shape):
    """What the answer was made of."""

    catalog: Digest
    run_catalog: Digest
    epoch_year: float
    mission: Digest
    version: str


class FrameTimingsOut(Shape):
    """Microseconds per step from file to stars."""

    read: Count
    detect: Count
    centroid: Count


class FrameOut(Shape):
    """The frame that a batch was made of, and how many stars were found on it."""

    digest: Digest
    format: Literal["FITS", "TIFF", "PNG", "NPY"]
    tracker: str
    width_px: Count
    height_px: Count
    exposure_s: float
    centroid: Literal["window", "scan", "matched", "recursive"]
    background_counts: float = Field(description="Above the bias, at the median.")
    noise_counts: float = Field(description="Of a pixel of background, one standard deviation.")
    candidates: Count = Field(description="Found above the threshold, hot pixels left out.")
    measured: Count = Field(description="Of these the brightest, which were placed.")
    used: Count = Field(description="Of these the ones that are in the batch.")
    hot_or_cosmic: Count = Field(description="What was found and is sharper than a star.")
    timings_us: FrameTimingsOut


class DetectionOut(Shape):
    """One candidate that was placed.  The first pixel's centre is (0, 0); u counts columns."""

    u_px: float | None = Field(description="null where there is no place; `left_out` says why.")
    v_px: float | None
    sigma_u_px: float | None = Field(description="Predicted, one standard deviation.")
    sigma_v_px: float | None
    flux_counts: float | None
    magnitude: float | None
    signal_ratio: float | None = Field(description="Light over its noise.")
    flags: list[
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
    ]
    used: bool = Field(description="In the batch, in which these stand in the same order.")
    left_out: str | None = Field(description="Why it is not.")


class FrameRecordOut(FrameOut):
    """The same with everything that was found."""

    stars: list[DetectionOut] = Field(description="Those in the batch first.")
    hot_or_cosmic_px: list[Annotated[list[float], Field(min_length=2, max_length=2)]] = Field(
        description="Where (u, v) hot pixels and cosmic rays were passed by; the first 500."
    )


class Answer(Shape):
    """The answer to a batch, as it is recorded."""

    id: Id | None = Field(description="null for a what-if that was not recorded.")
    spacecraft: str
    batch: str
    run: str
    time: Moment
    identifier: Literal["starid", "verified", "ptp", "lost_in_space"]
    path: Literal["zone", "lost_in_space", "zone_then_lost_in_space"] = Field(
        description="`zone`: about the a priori attitude. `lost_in_space`: there was none, or it "
        "was not to be used, and the whole sky gave the attitude to look about. "
        "`zone_then_lost_in_space`: nothing good was found about the a priori attitude, and the "
        "whole sky was looked at."
    )
    observations: list[TrackerOut]
    counts: CountsOut
    attitude: AttitudeOut | None
    reason: Reason | None = Field(description="Why there is no attitude.")
    warnings: list[str]
    timings_us: TimingsOut
    provenance: ProvenanceOut
    parent: Id | None = Field(
        default=None, description="Of a what-if, and only there: the result it was made from."
    )
    recorded: bool = Field(default=True, description="Of a what-if: whether it was kept.")
    frame: FrameOut | None = Field(
        default=None, description="Where the batch was made of a frame, and only there."
    )


class MeasuresOut(Shape):
    """What is measured of a result; null where there is nothing to measure or it is not known."""

    residual_rms_arcsec: float | None
    predicted_rms_arcsec: float | None
    residual_ratio: float | None = Field(description="The first over the second; about 1.")
    magnitude_offset_mag: float | None = Field(
        description="Observed less catalog magnitude, the mean of the unique stars."
    )
    a_priori_angle_deg: float | None = Field(
        description="From the a priori attitude to the one found; where the a priori leaves the "
        "roll open, from its boresight or pole."
    )


class Summary(Shape):
    """A result in a list: all but its stars and its attitude."""

    id: Id
    spacecraft: str
    batch: str
    run: str
    time: Moment
    received: Moment = Field(description="When the batch first came.")
    created: Moment = Field(description="When this result was recorded.")
    identifier: str
    options: Settings = Field(description="What was asked to be done otherwise.")
    counts: CountsOut
    status: Status | None = Field(description="Of the attitude; null where there is none.")
    reason: Reason | None
    measures: MeasuresOut
    parent: Id | None = Field(description="Of a what-if: the result it was made from.")
    current: bool = Field(description="Whether it stands for its batch.")


class BatchPage(Shape):
    """A page of results."""

    items: list[Summary]
    next_cursor: str | None


class Record(Shape):
    """A result with the batch it was made of and the other results of that batch."""

    answer: Answer
    input: BatchIn = Field(description="The batch as it was sent, defaults left out.")
    options: Settings = Field(
        description="What this result was asked to do otherwise than its mission; the mission's "
        "own settings are those of `provenance.mission`."
    )
    measures: MeasuresOut
    current: bool
    parent: Id | None
    what_ifs: list[Summary]
    frame: FrameRecordOut | None = Field(
        default=None, description="Where the batch was made of a frame, and only there."
    )
