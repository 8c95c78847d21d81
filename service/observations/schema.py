"""The JSON schema of batches sent by clients, checked field by field.

All interfaces read batches with this module, so that they refuse the same errors with the same
messages, in the service's words. The pydantic models are also what `openapi.yaml` shows.
"""

import codecs
import hashlib
import math
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from msgspec import Struct
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    model_validator,
)

from service.errors import BadBatch, BadInput, Fault, shown_value
from service.missions.faults import NAME_PATTERN
from service.missions.mission import GridStep, Identifier, SolverName
from service.missions.scan import MOST_LINES, MOST_SAMPLES, MOST_WIRES
from service.observations.batch import (
    MAX_STARS_PER_TRACKER,
    MAX_TRACKERS,
    Aberration,
    APriori,
    ObservationBatch,
    Options,
)
from service.observations.decode import batch_from_canonical, prior_from_canonical
from service.observations.field_faults import PRIOR_KINDS, checked_by
from service.observations.fill_values import MOST_REMARKS, without_fill_values
from service.observations.frame_record import FrameRecord
from service.times import parse_utc


def is_time(text: str) -> str:
    """The given text, checked to be a UTC time; raises `ValueError` otherwise, for pydantic."""
    try:
        parse_utc(text)
    except BadInput as error:
        raise ValueError(error.faults[0].message) from None
    return text


Key = Annotated[str, Field(min_length=1, max_length=128, pattern=r"^[^\x00-\x1f\x7f]+$")]
"""Text that may name a record, checked loosely: earlier versions allowed more than `Name`."""
Name = Annotated[str, Field(min_length=1, max_length=128, pattern=NAME_PATTERN)]
LIVE = "live"
"""Name of the run of the batches that operations send."""
RunName = Annotated[
    str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.:-]*$")
]


NORM_TOLERANCE = 1e-3

ReferenceFrame = Literal["EME2000", "ICRF", "GCRF"]


def _near_unit(components: tuple[float, ...]) -> tuple[float, ...]:
    norm = math.hypot(*components)
    if abs(norm - 1.0) > NORM_TOLERANCE:
        raise ValueError(f"must have norm 1 within {NORM_TOLERANCE}; its norm is {norm:.6g}")
    return components


Number = Annotated[float, Field(strict=True)]
"""A strict JSON number: pydantic would otherwise accept true and "5.3"."""
Components = tuple[Number, Number, Number]
UnitVector = Annotated[Components, AfterValidator(_near_unit)]
Quaternion = Annotated[tuple[Number, Number, Number, Number], AfterValidator(_near_unit)]


BodyRate = Annotated[Number, Field(ge=-360, le=360)]
Speed = Annotated[Number, Field(ge=-100, le=100)]
Distance = Annotated[Number, Field(ge=-1e9, le=1e9)]
Position = tuple[Distance, Distance, Distance]
ToleranceValue = Annotated[Number, Field(ge=0, le=180)]


class Wire(BaseModel):
    """The base class of request bodies: no unknown fields, no NaN, no infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


Count = Annotated[Number, Field(ge=0, le=1e12)]
Counts = Annotated[list[Count], Field(min_length=3, max_length=MOST_SAMPLES)]
Times = Annotated[list[Annotated[Number, Field(ge=0, le=1e15)]], Field(max_length=MOST_WIRES)]
Lines = Annotated[list[Count], Field(min_length=8, max_length=MOST_LINES)]


class StarIn(Wire):
    """One observed star: a unit vector in tracker axes, or the angles of (tan h, tan v, 1).

    Of a scanning tracker: the samples of two lines through these angles, or in their place
    the times at which the star crossed the wires, in the mission's unit.
    """

    vector: UnitVector | None = None
    h_deg: Annotated[Number, Field(gt=-89, lt=89)] | None = None
    v_deg: Annotated[Number, Field(gt=-89, lt=89)] | None = None
    magnitude: Annotated[Number, Field(ge=-30, le=30)] | None = None
    time_offset_s: Annotated[Number, Field(ge=-3600, le=3600)] = 0.0
    sigma_arcsec: Annotated[Number, Field(ge=1e-3, le=3600)] | None = None
    h_counts: Counts | None = None
    v_counts: Counts | None = None
    h_times: Times | None = None
    v_times: Times | None = None

    @model_validator(mode="after")
    def _one_direction(self) -> Self:
        angles = (self.h_deg is not None, self.v_deg is not None)
        for kind in ("counts", "times"):
            present = [getattr(self, f"{axis}_{kind}") is not None for axis in ("h", "v")]
            if any(present) and not all(present):
                raise ValueError(f"needs both h_{kind} and v_{kind}, or neither")
        if self.h_times is not None:
            if self.vector is not None or any(angles) or self.h_counts is not None:
                raise ValueError("takes h_times and v_times without any other direction")
            return self
        if self.vector is None and not all(angles):
            raise ValueError("needs either vector, or both h_deg and v_deg")
        if self.vector is not None and (any(angles) or self.h_counts is not None):
            raise ValueError("takes either vector, or h_deg and v_deg, not both")
        return self


class TrackerIn(Wire):
    """The stars that one tracker observed, or the sums of the lines of its raster."""

    tracker: Name
    stars: Annotated[list[StarIn], Field(max_length=MAX_STARS_PER_TRACKER)]
    column_counts: Lines | None = None
    row_counts: Lines | None = None

    @model_validator(mode="after")
    def _stars_or_lines(self) -> Self:
        if (self.column_counts is None) != (self.row_counts is None):
            raise ValueError("needs both column_counts and row_counts, or neither")
        if self.column_counts is not None and self.stars:
            raise ValueError("takes either stars, or column_counts and row_counts, not both")
        return self


class QuaternionIn(Wire):
    """An a priori attitude: inertial to body, scalar last."""

    quaternion: Quaternion
    frame: ReferenceFrame = "EME2000"


class DirectionIn(Wire):
    """A direction in right ascension and declination."""

    ra_deg: Annotated[Number, Field(ge=-360, le=360)]
    dec_deg: Annotated[Number, Field(ge=-90, le=90)]


class BoresightIn(Wire):
    """An a priori boresight with unknown roll (cap missions)."""

    boresight: DirectionIn
    frame: ReferenceFrame = "EME2000"


class SunPointedIn(Wire):
    """A pole at the Sun with unknown roll (band missions)."""

    sun_pointed: Literal[True]
    sun_counts: tuple[Count, Count, Count, Count] | None = None
    """Counts of the mission's Sun tracker: I+ and I- of the pair along its X, then along its Y."""
    sun_vector: UnitVector | None = None
    position_km: Position | None = None
    frame: ReferenceFrame = "EME2000"


Row = Components
NoPrediction = Literal["no_good_attitude", "too_uncertain", "flip"]
RateSource = Literal["gyro", "body_rates", "attitudes", "unknown"]


def _positive_definite(rows: tuple[Row, Row, Row]) -> tuple[Row, Row, Row]:
    matrix = np.array(rows)
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise ValueError("must be positive definite") from None
    if not np.array_equal(matrix, matrix.T):
        raise ValueError("must be symmetric")
    return rows


PositiveDefinite = Annotated[tuple[Row, Row, Row], AfterValidator(_positive_definite)]


class PredictionIn(BaseModel):
    """The attitude that was predicted for a batch, or why there was none.

    The service adds it when it records a batch.  A batch that is sent with it is searched about it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    quaternion: tuple[Number, Number, Number, Number] | None = None
    """The predicted attitude as a quaternion, inertial to body, scalar last."""
    covariance_arcsec2: PositiveDefinite | None = None
    """Covariance in arcsec² of the prediction, for rotations about the body axes."""
    margin_deg: Annotated[Number, Field(gt=0, le=60)] | None = None
    """Distance in degrees by which the search zone extends beyond the field of view."""
    result: Annotated[str, Field(max_length=26)] | None = None
    """The id of the result that the prediction started from."""
    age_s: Annotated[Number, Field(ge=0)] | None = None
    rate: RateSource | None = None
    """The source of the body rates used for the prediction."""
    reason: NoPrediction | None = None
    """The reason why there is no prediction of the attitude; None if there is one."""

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.reason is not None:
            if self.quaternion is not None:
                raise ValueError("takes either quaternion or reason, not both")
        elif None in (self.quaternion, self.covariance_arcsec2, self.margin_deg):
            raise ValueError("needs reason, or quaternion, covariance_arcsec2 and margin_deg")
        if self.quaternion is not None and abs(np.linalg.norm(self.quaternion) - 1.0) > 1e-3:
            raise ValueError("quaternion: must have norm 1 within 0.001")
        return self


class FromLastIn(Wire):
    """The attitude predicted from the last good one of the spacecraft and the run."""

    model_config = ConfigDict(serialize_by_alias=True)
    from_: Annotated[Literal["last"], Field(alias="from")]
    by_default: bool = False
    """True if the service added the request, because the mission asks for it by default."""
    prediction: PredictionIn | None = None


class TestsIn(Wire):
    """Tests of the identification, switched on or off."""

    magnitude: bool | None = None
    cross_product: bool | None = None
    pole: bool | None = None
    fov_rotation: bool | None = None
    match_groups: bool | None = None


class TolerancesIn(Wire):
    """Tolerances of the identification, with the names of the mission file."""

    pair_separation_max_deg: Annotated[Number, Field(ge=0.01, le=60)] | None = None
    separation_deg: Annotated[Number, Field(ge=0, le=5)] | None = None
    magnitude_mag: Annotated[Number, Field(ge=0, le=30)] | None = None
    magnitude_order_mag: Annotated[Number, Field(ge=0, le=30)] | None = None
    cross_product_deg: ToleranceValue | None = None
    pole_difference_deg: ToleranceValue | None = None
    pole_angle_deg: ToleranceValue | None = None
    fov_rotation_deg: ToleranceValue | None = None


class OptionsIn(Wire):
    """Options that replace the mission's settings."""

    identifier: Identifier | None = None
    solver: SolverName | None = None
    tests: TestsIn = TestsIn()
    tolerances: TolerancesIn = TolerancesIn()
    zone_grid_deg: Annotated[GridStep, Field(strict=True)] | None = None

    def to_options(self) -> Options:
        """A batch's sent options as the solver takes them."""
        return Options(
            identifier=self.identifier,
            solver=self.solver,
            tests=_named(self.tests),
            tolerances=_named(self.tolerances),
            zone_grid_deg=self.zone_grid_deg,
        )


def _named(model: Wire) -> dict[str, Any]:
    """The fields of a model that were set to a value other than null."""
    values = ((name, getattr(model, name)) for name in model.model_fields_set)
    return {name: value for name, value in values if value is not None}


def _kind_of_prior(value: Any) -> str | None:
    if isinstance(value, FromLastIn):
        return "from_last"
    keys = value if isinstance(value, dict) else getattr(value, "model_fields_set", ())
    return next((kind for kind, key in PRIOR_KINDS.items() if key in keys), None)


APrioriIn = Annotated[
    Annotated[QuaternionIn, Tag("quaternion")]
    | Annotated[BoresightIn, Tag("boresight")]
    | Annotated[SunPointedIn, Tag("sun_pointed")]
    | Annotated[FromLastIn, Tag("from_last")],
    Discriminator(
        _kind_of_prior,
        custom_error_type="a_priori_kind",
        custom_error_message=(
            "must hold one of quaternion, boresight, sun_pointed, from, or be null"
        ),
    ),
]


def _stars_of_different_trackers(
    observations: list[TrackerIn], info: ValidationInfo
) -> list[TrackerIn]:
    if "measurement" not in info.data:
        # The measurement has a fault of its own, which is reported already.
        return observations
    if info.data["measurement"] is not None:
        if observations:
            raise ValueError("takes either measurement or observations, not both")
        return observations
    if not observations:
        raise ValueError("must have at least 1 tracker; a measured attitude is a measurement")
    names = [each.tracker for each in observations]
    if len(set(names)) != len(names):
        raise ValueError(f"a tracker occurs twice: {', '.join(names)}")
    if not any(each.stars or each.column_counts for each in observations):
        raise ValueError("there are no stars; at least one is needed")
    return observations


LEAST_SIGMA_ARCSEC, LARGEST_SIGMA_ARCSEC = 1e-3, 36_000.0
LEAST_RATIO = 1e-10
"""Least ratio of the smallest to the largest variance; below it a covariance is singular."""


def _of_a_tracker(rows: tuple[Row, Row, Row]) -> tuple[Row, Row, Row]:
    variances = np.linalg.eigvalsh(np.array(rows)).tolist()
    least, largest = LEAST_SIGMA_ARCSEC**2, LARGEST_SIGMA_ARCSEC**2
    if variances[0] < least or variances[-1] > largest:
        raise ValueError(
            f"must have sigmas from {LEAST_SIGMA_ARCSEC:g} to {LARGEST_SIGMA_ARCSEC:g} arcsec "
            "about every axis"
        )
    _require_ratio(variances)
    return rows


def _of_one_tracker(sigmas: tuple[float, float, float]) -> tuple[float, float, float]:
    _require_ratio([sigma**2 for sigma in sigmas])
    return sigmas


def _require_ratio(variances: Sequence[float]) -> None:
    if min(variances) < LEAST_RATIO * max(variances):
        raise ValueError(f"must have no sigma below {LEAST_RATIO**0.5:g} of the largest")


def none_beside_measurement(prior: Any, info: ValidationInfo) -> Any:
    """The a priori knowledge of a batch; raises `ValueError` for any beside a measured attitude."""
    if prior is not None and info.data.get("measurement") is not None:
        raise ValueError("must be null: a measured attitude needs no a priori knowledge")
    return prior


def no_options_beside_measurement(options: Any, info: ValidationInfo) -> Any:
    """The options of a batch, unchanged; raises `ValueError` if set beside a measured attitude."""
    if options.model_fields_set and info.data.get("measurement") is not None:
        raise ValueError("must be left out: a measured attitude is not searched for")
    return options


Remark = Annotated[str, Field(max_length=300, pattern=r"^[a-z_0-9]+: [^\x00-\x1f\x7f]+$")]
Sigma = Annotated[Number, Field(ge=LEAST_SIGMA_ARCSEC, le=LARGEST_SIGMA_ARCSEC)]


class MeasurementIn(BaseModel):
    """An attitude that a star tracker measured itself, with its covariance or its sigmas."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    quaternion: Quaternion
    """Measured quaternion: scalar last, from inertial to the axes of `tracker`, or to the body."""
    tracker: Name | None = None
    """The tracker whose axes the quaternion describes; the alignment turns them into body axes."""
    sigma_arcsec: Annotated[tuple[Sigma, Sigma, Sigma], AfterValidator(_of_one_tracker)] | None = (
        None
    )
    """One sigma in arcsec of the rotation about each axis of the tracker, or of the body."""
    covariance_arcsec2: Annotated[PositiveDefinite, AfterValidator(_of_a_tracker)] | None = None
    """Covariance in arcsec² of a small rotation about the axes of the tracker, or of the body."""
    frame: ReferenceFrame = "EME2000"

    @model_validator(mode="after")
    def _one_accuracy(self) -> Self:
        if (self.sigma_arcsec is None) == (self.covariance_arcsec2 is None):
            raise ValueError("needs either sigma_arcsec or covariance_arcsec2")
        return self


class BatchIn(Wire):
    """A batch of observed stars, or of an attitude that a tracker measured itself."""

    spacecraft: Name
    batch: Name
    time: Annotated[str, AfterValidator(is_time)]
    run: RunName = LIVE
    measurement: MeasurementIn | None = None
    a_priori: Annotated[APrioriIn | None, AfterValidator(none_beside_measurement)]
    body_rates_deg_per_s: tuple[BodyRate, BodyRate, BodyRate] = (0.0, 0.0, 0.0)
    velocity_km_per_s: tuple[Speed, Speed, Speed] | None = None
    sun_vector: UnitVector | None = None
    position_km: Position | None = None
    aberration: Aberration = "to_correct"
    observations: Annotated[
        list[TrackerIn],
        Field(max_length=MAX_TRACKERS, validate_default=True),
        AfterValidator(_stars_of_different_trackers),
    ] = []
    options: Annotated[OptionsIn, AfterValidator(no_options_beside_measurement)] = OptionsIn()
    remarks: Annotated[tuple[Remark, ...], Field(max_length=MOST_REMARKS)] = ()
    """Notes on values interpreted otherwise than sent, added by the service."""


def prior_of(prior: APrioriIn) -> APriori:
    """A priori knowledge of no batch as the solver takes it; raises `BadBatch` for "last"."""
    known = prior_from_canonical(prior.model_dump_json(exclude_defaults=True))
    if known is None:
        raise BadBatch(Fault("a_priori.from", "is for batches alone", shown_value("last")))
    return known


class Checked(Struct, frozen=True):
    """A batch that passed every check, as canonical JSON with its fingerprint.

    `text` is its canonical JSON without defaults, which is recorded and can be run again.
    `fingerprint` is the digest of that text without additions of the service, so that white space
    and the order of keys make no difference.
    """

    text: str
    fingerprint: str


class Submission(Struct, frozen=True, eq=False):
    """A batch to be processed, decoded, with its canonical JSON and its fingerprint.

    A batch made from a frame has the fingerprint of the frame and its metadata.
    """

    batch: ObservationBatch
    text: str
    fingerprint: str
    frame: FrameRecord | None = None


def checked_from_json(body: bytes | str, run: str | None = None) -> Checked:
    """The canonical JSON of a batch after all checks; `run` overrides the batch's own.

    Raises `BadBatch` with every fault, each naming field and value.
    """
    # Some editors put a byte order mark before the text.
    if isinstance(body, bytes):
        body = body.removeprefix(codecs.BOM_UTF8)
    else:
        body = body.removeprefix("\ufeff")
    model = checked_by(BatchIn.model_validate_json, body)
    return checked_from_model(model if run is None else model.model_copy(update={"run": run}))


def checked_from_model(model: BatchIn) -> Checked:
    """The canonical JSON and the fingerprint of a validated model of a batch."""
    model = without_fill_values(model)
    text, prior = model.model_dump_json(exclude_defaults=True), model.a_priori
    sent = text
    if isinstance(prior, FromLastIn) and (prior.prediction or prior.by_default):
        as_sent = None if prior.by_default else FromLastIn.model_validate({"from": "last"})
        sent_model = model.model_copy(update={"a_priori": as_sent})
        sent = sent_model.model_dump_json(exclude_defaults=True, exclude={"remarks"})
    elif model.remarks:
        sent = model.model_dump_json(exclude_defaults=True, exclude={"remarks"})
    return Checked(text, hashlib.sha256(sent.encode()).hexdigest())


def fingerprint_of(input: str) -> str:
    """The fingerprint of a recorded batch that was not made from a frame."""
    if _PREDICTED in input or _REMARKS in input:
        return checked_from_json(input).fingerprint
    return hashlib.sha256(input.encode()).hexdigest()


_PREDICTED, _REMARKS = '"from":"last"', '"remarks":['


def submission_from_json(body: bytes | str, run: str | None = None) -> Submission:
    """The submission of a batch in JSON, after all checks; see `checked_from_json`."""
    return submission_from_checked(checked_from_json(body, run))


def submission_from_model(model: BatchIn) -> Submission:
    """The submission made from a validated model of a batch."""
    return submission_from_checked(checked_from_model(model))


def submission_from_checked(checked: Checked) -> Submission:
    """The submission of a checked batch, decoded from its canonical JSON."""
    return Submission(batch_from_canonical(checked.text), checked.text, checked.fingerprint)


def tolerances_from_text(texts: Iterable[str], field: str) -> TolerancesIn:
    """Tolerances written as NAME=VALUE; raises `BadBatch` naming `field`, the name and the value.

    If a name occurs twice the last value counts, as in JSON.
    """
    values: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            values[name.strip()] = float(value)
        except ValueError:
            message = "must be NAME=VALUE, such as separation_deg=0.01"
            raise BadBatch(Fault(field, message, shown_value(text))) from None
    return checked_by(TolerancesIn.model_validate, values, (field,))
