"""Registry of quantities, for trends, limits and rankings of batches.

Every list of quantities is derived from `QUANTITIES`: histories, limits, the ranking, query
parameters and the OpenAPI document, the labels of the console, and the columns of CSV files.

A quantity that is derived from the counts of stars and batches is one entry here.  One that is
measured, or that the rollups have columns of, has its source in `service.trends.measures`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import Annotated, Any, Literal

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

from service.missions.mission import Band, Mission
from service.trends.limits import LimitSettings, Sample, about_zero, above
from service.trends.measures import (
    STORED,
    BatchShare,
    Gap,
    Measured,
    MeasuredOfBatch,
    Rate,
    Ratio,
    SmoothedShare,
    Source,
    StarShare,
)


@dataclass(frozen=True)
class Cause:
    """Usual cause of a quantity out of its limits, and the remedy."""

    cause: str
    remedy: str
    calibrate: bool = False
    """True if a new calibration is the remedy."""


@dataclass(frozen=True)
class Quantity:
    """A quantity of results with its unit, label and everything derived from it."""

    name: str
    unit: str
    label: str
    """Name of the quantity on pages."""
    source: Source
    limits: Callable[[Mission], LimitSettings] | None = None
    """Function that gives a mission's default limits; None if limits do not apply."""
    worse: Literal["high", "size"] = "high"
    """Direction of worse values: `high` if greater, `size` if further from zero."""
    description: str = ""
    """Description of the quantity in `measures`, for the OpenAPI document."""
    by_tracker: bool = False
    """True if each tracker of a spacecraft with several has its own value of the quantity.

    A tracker is suspect if it disagrees with the others.
    """
    cause: Cause | None = None
    """Usual cause of a value out of limits; docs/operators.md has the table of all causes."""

    def __post_init__(self) -> None:
        of_trackers = StarShare | BatchShare | Measured | Ratio
        if self.by_tracker and not isinstance(self.source, of_trackers):
            raise ValueError(f"{self.name}: no tracker has a value of {self.source}")

    @property
    def rolled_up(self) -> bool:
        """True if the rollups have columns for the quantity; see `Source`."""
        return getattr(self.source, "rolled_up", False)

    @property
    def is_share(self) -> bool:
        """True if the quantity is a fraction of stars or batches, which rollups count."""
        return isinstance(self.source, StarShare | BatchShare)

    @property
    def value_of(self) -> Callable[[Mapping[str, Any]], float | None]:
        """Function that gives the quantity of one result from its row; None without a value."""
        match self.source:
            case Measured() | MeasuredOfBatch():
                return itemgetter(self.name)
            case Ratio(numerator, denominator):
                return lambda row: _over(row[numerator], row[denominator])
            case StarShare(part):
                return lambda row: _over(part(row), row["observed"])
            case BatchShare(part):
                return lambda row: float(part(counts_of(row)))
            case _:
                return lambda row: None

    def sample_of(self, result: Mapping[str, Any]) -> Sample | None:
        """Sample of the quantity from one result, to evaluate limits; None without a value."""
        match self.source:
            case StarShare(part):
                whole = result["observed"]
                return (result["time_ns"], part(result), whole) if whole else None
            case BatchShare(part):
                return result["time_ns"], part(counts_of(result)), 1
            case _:
                value = self.value_of(result)
                return None if value is None else (result["time_ns"], value, 1)


def counts_of(result: Mapping[str, Any]) -> dict[str, int]:
    """Counts of one result, in the form of a rollup of it."""
    stars = {name: result[name] for name in ("observed", "unique", "ambiguous", "unmatched")}
    solved, suspect = result["status"] is not None, result["status"] == "suspect"
    return {"batches": 1, **stars, "solved": int(solved), "suspect": int(suspect)}


def a_priori_margin_deg(mission: Mission) -> float:
    """A priori attitude error in degrees at which the field of view leaves the zone."""
    zone = mission.zone
    half_width_deg = zone.half_width_deg if isinstance(zone, Band) else zone.radius_deg
    widest_deg = max(each.field_of_view_radius_deg for each in mission.trackers)
    return max(half_width_deg - widest_deg, 0.1 * half_width_deg)


def _a_priori_limits(mission: Mission) -> LimitSettings:
    margin_deg = a_priori_margin_deg(mission)
    bounds_deg = (0.8 * margin_deg, 1.0 * margin_deg, 1.3 * margin_deg)
    return above(*bounds_deg, hysteresis=0.03 * margin_deg, minimum_count=5)


def _over(part: float | None, whole: float | None) -> float | None:
    return None if part is None or not whole else float(part / whole)


_SIGMA = Cause(
    "The mission's sigma is too small, or the focal plane has changed.",
    "Open the advice for the time of the alarm: it compares the noise of each tracker with its "
    "sigma, and gives the lines to change.",
)
SILENCE = "silence_s"
REJECTED = "innovation_rejected_share"


QUANTITIES: dict[str, Quantity] = {
    each.name: each
    for each in (
        Quantity(
            "ambiguous_share",
            "1",
            "ambiguous stars",
            STORED["ambiguous_share"],
            lambda mission: above(0.15, 0.25, 0.5, hysteresis=0.03),
            by_tracker=True,
            cause=Cause(
                "Fewer or fainter stars than usual, or a crowded or sparse region of the sky.",
                "Open the worst batch. If it has an attitude, with residuals as predicted, wait "
                "until the region has passed, or try the separation tolerance that the advice "
                "names.",
            ),
        ),
        Quantity(
            "unmatched_share",
            "1",
            "unmatched stars",
            STORED["unmatched_share"],
            lambda mission: above(0.15, 0.25, 0.5, hysteresis=0.03),
            by_tracker=True,
            cause=Cause(
                "The a priori attitude drifts, so that stars lie beyond the edge of the zone; "
                "or false stars: particles, planets, radiation.",
                "Look at the angle from the a priori attitude. If it grows too, correct the a "
                "priori attitude. If it stays the same, open the worst batch and look where its "
                "false stars are.",
            ),
        ),
        Quantity(
            "no_attitude_share",
            "1",
            "batches without attitude",
            BatchShare(lambda counts: counts["batches"] - counts["solved"]),
            lambda mission: above(0.1, 0.25, 0.5, hysteresis=0.03),
            cause=Cause(
                "Too few unique stars, or an a priori attitude that is wrong by more than the "
                "zone covers.",
                "Open a batch without an attitude: it states the reason. Try it as lost in "
                "space; if that finds an attitude, correct the a priori attitude.",
            ),
        ),
        Quantity(
            "suspect_share",
            "1",
            "batches with a suspect attitude",
            BatchShare(itemgetter("suspect")),
            lambda mission: above(0.1, 0.25, 0.5, hysteresis=0.03),
            by_tracker=True,
            cause=Cause(
                "A misidentified star, or two trackers that disagree.",
                "Open a suspect batch and compare its trackers. The advice measures the "
                "alignment of the one that has moved.",
            ),
        ),
        Quantity(
            "residual_rms_arcsec",
            "arcsec",
            "residual rms",
            STORED["residual_rms_arcsec"],
            # The normal value depends on the tracker; the ratio below takes that into account.
            lambda mission: LimitSettings(),
            by_tracker=True,
            cause=_SIGMA,
        ),
        Quantity(
            "predicted_rms_arcsec",
            "arcsec",
            "predicted residual rms",
            STORED["predicted_rms_arcsec"],
            by_tracker=True,
        ),
        Quantity(
            "residual_ratio",
            "1",
            "residual over predicted",
            STORED["residual_ratio"],
            lambda mission: above(1.5, 2.0, 3.0, hysteresis=0.1),
            description="Residual rms divided by the predicted rms; about 1.",
            by_tracker=True,
            cause=_SIGMA,
        ),
        Quantity(
            "magnitude_offset_mag",
            "mag",
            "magnitude offset",
            STORED["magnitude_offset_mag"],
            lambda mission: about_zero(0.2, 0.35, 0.6, hysteresis=0.03),
            worse="size",
            description="Observed minus catalog magnitude, mean over the unique stars.",
            by_tracker=True,
            cause=Cause(
                "Instrument drift: the tracker's magnitudes have shifted.",
                "Run `acquire calibrate`, which estimates magnitudes too, or open the "
                "calibration page; try the result over recorded batches, and adopt it. Until "
                "then, widen the magnitude tolerance.",
                calibrate=True,
            ),
        ),
        Quantity(
            "a_priori_angle_deg",
            "deg",
            "angle from the a priori attitude",
            STORED["a_priori_angle_deg"],
            _a_priori_limits,
            description="Angle from the a priori attitude to the found one; without a priori roll, "
            "from the a priori boresight or pole.",
            cause=Cause(
                "The a priori attitude drifts, or a slew was not announced.",
                "Check where the a priori attitude comes from. Until it is corrected, send the "
                "batches as lost in space, or widen the zone.",
            ),
        ),
        Quantity(
            "scale_offset_ppm",
            "ppm",
            "scale offset",
            STORED["scale_offset_ppm"],
            # The normal value depends on the tracker; docs/alarms.md says how to set limits.
            lambda mission: LimitSettings(),
            worse="size",
            description="Distances of the unique stars from each other within a tracker, observed "
            "over catalog, less 1, in millionths: the error of the focal length.",
            by_tracker=True,
            cause=Cause(
                "Instrument drift: the focal length has changed.",
                "Run `acquire calibrate` over the time of the alarm, or open the calibration "
                "page; try the result over recorded batches, and adopt it.",
                calibrate=True,
            ),
        ),
        Quantity(
            "alignment_offset_arcsec",
            "arcsec",
            "alignment offset",
            STORED["alignment_offset_arcsec"],
            lambda mission: LimitSettings(),
            worse="size",
            description="Angle between the unique stars of two trackers, observed minus catalog; "
            "of a tracker, the mean over the others. Null with one tracker.",
            by_tracker=True,
            cause=Cause(
                "Instrument drift: a tracker has turned against the others. Of three trackers, "
                "the one with the largest offset has moved.",
                "Run `acquire calibrate` over the time of the alarm, or open the calibration "
                "page; try the result over recorded batches, and adopt it.",
                calibrate=True,
            ),
        ),
        Quantity("batches_per_hour", "1/h", "batches per hour", Rate()),
        Quantity(
            SILENCE,
            "s",
            "silence",
            Gap(),
            lambda mission: above(None, 3600.0, 6 * 3600.0, minimum_count=1, duration_s=0.0),
            cause=Cause(
                "A fault of the telemetry link, or of the program that sends the batches.",
                "Check that the sender runs and reaches the service, and whether its batches "
                "are refused.",
            ),
        ),
        Quantity(
            REJECTED,
            "1",
            "attitudes that the filter rejects",
            SmoothedShare(),
            # One in ten thousand good attitudes is rejected.
            lambda mission: above(0.02, 0.05, 0.2, hysteresis=0.005, minimum_count=100),
            cause=Cause(
                "A star that is misidentified in every batch, a step of the clock, or a fault "
                "of the gyro.",
                "Open the innovations of that time. If the attitudes agree with each other, "
                "check the clock and the gyro; the advice says whether the gyro is noisier than "
                "the mission file states.",
            ),
        ),
    )
}


def quantity_named(name: str) -> Quantity:
    """Quantity of a stored alarm by name; a placeholder if it is no longer registered."""
    return QUANTITIES.get(name) or Quantity(name, "", name.replace("_", " "), Gap())


def names() -> tuple[str, ...]:
    """Names of all quantities."""
    return tuple(QUANTITIES)


def trend_names() -> tuple[str, ...]:
    """Names of the quantities that have a history."""
    return _names(lambda each: not isinstance(each.source, Gap | SmoothedShare))


def tracker_names() -> tuple[str, ...]:
    """Names of the quantities that each tracker has its own value of."""
    return _names(lambda each: each.by_tracker)


def limited_names() -> tuple[str, ...]:
    """Names of the quantities that have limits."""
    return _names(lambda each: each.limits is not None)


def ranked_names() -> tuple[str, ...]:
    """Names of the quantities by which batches are ranked."""
    return _names(lambda each: each.rolled_up)


def value_names() -> tuple[str, ...]:
    """Names of the quantities of a single batch: measured, or a ratio of measured ones."""
    return _names(lambda each: isinstance(each.source, Measured | MeasuredOfBatch | Ratio))


def default_limits(mission: Mission) -> dict[str, LimitSettings]:
    """Default limits of a mission by quantity (docs/alarms.md gives reasons)."""
    return {name: each.limits(mission) for name, each in QUANTITIES.items() if each.limits}


def _names(chosen: Callable[[Quantity], bool]) -> tuple[str, ...]:
    return tuple(name for name, each in QUANTITIES.items() if chosen(each))


@dataclass(frozen=True)
class OneOf:
    """Validator of a name against the registry, read at each validation."""

    names: Callable[[], tuple[str, ...]]

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Schema of a text that must be one of the names."""
        return core_schema.no_info_after_validator_function(self._check, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """JSON schema of an enumeration of the names, as for a `Literal`."""
        return {"enum": list(self.names()), "type": "string"}

    def _check(self, name: str) -> str:
        known = self.names()
        if name not in known:
            *first, last = (repr(each) for each in known)
            raise PydanticKnownError("literal_error", {"expected": f"{', '.join(first)} or {last}"})
        return name


QuantityName = Annotated[str, OneOf(names)]
RankedName = Annotated[str, OneOf(ranked_names)]


# ---- subjects of limits ----------------------------------------------------------------------

Subject = str
"""Subject of a limit: a quantity of a spacecraft, or of one of its trackers.

Texts such as `residual_ratio` and `residual_ratio@STARTRACKER_2`: names have no `@`.
"""


def subject_of(quantity: str, tracker: str = "") -> Subject:
    """Subject of a limit: a quantity of a tracker, or without one of the whole spacecraft."""
    return f"{quantity}@{tracker}" if tracker else quantity


def quantity_and_tracker(subject: Subject) -> tuple[str, str]:
    """Quantity and tracker in a limit's subject; the tracker is empty for the whole spacecraft."""
    quantity, _, tracker = subject.partition("@")
    return quantity, tracker


def limited_trackers(mission: Mission) -> tuple[str, ...]:
    """Trackers with limits of their own: all, if the mission has several."""
    if len(mission.trackers) == 1:
        return ()
    return tuple(each.name for each in mission.trackers)


def limits_of_subjects(
    mission: Mission, shipped: Mapping[str, LimitSettings], own: Mapping[Subject, LimitSettings]
) -> dict[Subject, LimitSettings]:
    """Limits of every subject of a mission; a spacecraft's own settings override shipped ones.

    A tracker without limits of its own has those of its spacecraft.
    """
    found = {name: own.get(name, settings) for name, settings in shipped.items()}
    for tracker in limited_trackers(mission):
        for name in shipped:
            if QUANTITIES[name].by_tracker:
                subject = subject_of(name, tracker)
                found[subject] = own.get(subject, found[name])
    return found


def sampler(subject: Subject) -> Callable[[Mapping[str, Any], Mapping[str, Any]], Any]:
    """Function that gives a result's sample of a limit's subject, or None.

    It takes the result and, by tracker, the values of its trackers.
    """
    quantity, tracker = quantity_and_tracker(subject)
    sample_of = QUANTITIES[quantity].sample_of
    if not tracker:
        return lambda result, trackers: sample_of(result)
    return lambda result, trackers: sample_of(trackers[tracker]) if tracker in trackers else None
