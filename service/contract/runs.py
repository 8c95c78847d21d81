"""Runs and replays; two runs, and two sets of options, side by side."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from msgspec import UNSET, Struct, UnsetType, field
from pydantic import Field

from service.contract.answers import StarCounts
from service.contract.base import (
    Count,
    Id,
    MissionSettings,
    Moment,
    Outcome,
    Record,
    Stamp,
    doc,
    list_record,
)
from service.contract.problems import FieldFault
from service.times import Utc
from service.vectors import Vector

ReplayStateName = Literal["running", "waiting", "done", "interrupted", "failed", "cancelled"]
"""A replay that is `waiting` goes on by itself as soon as the service is ready after a restart."""


class Run(Record, frozen=True, kw_only=True):
    """A run."""

    component: ClassVar[str] = "RunRow"
    run: str
    created: Stamp
    alarms: Annotated[bool, doc("True if its batches can raise alarms.")]
    batches: Count
    spacecraft: list[str]
    first_day: Annotated[str, Field(examples=["1999-03-01"])]
    last_day: str


RunList = list_record("RunList", Run, "Every run with batches.")


class Forgotten(Record, frozen=True, kw_only=True):
    """What is removed from a run."""

    run: str
    spacecraft: Annotated[str | None, doc("null: of every spacecraft.")]
    batches: Annotated[Count, doc("Batches in the database, with their results.")]
    archived_batches: Annotated[Count, doc("Batches in the archive.")]
    gyro_blocks: Count
    graded_days: Count
    """Days of filtered and smoothed attitudes that were computed with them, every revision counted.
    `acquire smooth` computes them again from what is left."""


class ReplayLines(Record, frozen=True, kw_only=True):
    """The lines of a replay."""

    total: Annotated[int | None, doc("null if the number is not known in advance.")]
    done: Count
    refused: Count


class ReplayCounts(Record, frozen=True, kw_only=True):
    """Results of the lines so far."""

    new: Annotated[Count, doc("Batches that this replay recorded.")]
    repeated: Annotated[Count, doc("Batches that were already recorded.")]
    observed: Count
    """Stars of these batches; the next fields count them by outcome."""
    unique: Count
    ambiguous: Count
    unmatched: Count
    attitudes: Annotated[Count, doc("Batches with an attitude.")]
    gyro_new: Annotated[Count, doc("Gyro blocks that this replay recorded.")] = 0
    gyro_repeated: Annotated[Count, doc("Gyro blocks that were already recorded.")] = 0


class ApidPackets(Record, frozen=True, kw_only=True):
    """The packets of one APID."""

    apid: Annotated[int, Field(ge=0, le=2047)]
    packets: Count
    described: Annotated[bool, doc("True if the XTCE file describes them.")]
    gaps: Annotated[Count, doc("Places where the sequence count skips packets.")]
    missing: Annotated[Count, doc("Packets that are missing in these places.")]
    backward: Count
    """Places where the count repeats or goes back: a reset, or a changed order."""
    refused: Count
    incomplete: Annotated[Count, doc("Segments of packets of which others are missing.")] = 0


class ReplayPackets(Record, frozen=True, kw_only=True):
    """The space packets of a replay so far."""

    packets: Count
    bytes: Count
    batches: Annotated[Count, doc("Batches that the packets hold.")]
    without_stars: Annotated[Count, doc("Without a star or a measured attitude: left out.")]
    gyro_blocks: Annotated[Count, doc("Gyro blocks that the packets hold.")]
    gyro_samples: Annotated[Count, doc("Samples of these blocks.")]
    unknown: Annotated[Count, doc("Packets that the XTCE file does not describe.")]
    not_asked: Annotated[Count, doc("Packets of APIDs that the mission's table leaves out.")]
    idle: Annotated[Count, doc("Idle packets (APID 2047).")]
    gaps: Count
    missing: Count
    backward: Count
    refused: Annotated[Count, doc("Packets that could not be read.")]
    joined: Annotated[Count, doc("Packets that were joined of segments.")] = 0
    incomplete: Count = 0
    """Segments of packets of which others are missing; they are refused, too."""
    unread_bytes: Count = 0
    """From the packets on at which files could not be read any further."""
    empty_files: Annotated[Count, doc("Files without a packet.")] = 0
    without_attitude: Count = 0
    """Packets whose a priori quaternion was zero or not finite."""
    apids: Annotated[list[ApidPackets], doc("The hundred APIDs with the most packets.")]


class LineProblem(Record, frozen=True, kw_only=True):
    """The faults of a line."""

    detail: str
    errors: Annotated[list[FieldFault] | UnsetType, doc("Every fault, field by field.")] = UNSET


class RefusedLine(Record, frozen=True, kw_only=True):
    """A refused line; the replay continues with the next one."""

    line: Annotated[int, doc("Number of the line, or of the packet in its file, from 1.")]
    problem: LineProblem


class ReplayProgress(Record, frozen=True, kw_only=True):
    """A replay and its progress, without the refused lines: the data of an event."""

    component: ClassVar[str] = "ReplayEvent"
    id: Id
    run: str
    name: str
    state: ReplayStateName
    lines: ReplayLines
    counts: ReplayCounts
    started: Stamp
    finished: Stamp | None


class Replay(ReplayProgress, frozen=True, kw_only=True):
    """A replay and its progress."""

    component: ClassVar[str] = "ReplayState"
    packets: Annotated[ReplayPackets | None, doc("null unless the replay reads space packets.")]
    errors: list[RefusedLine]
    """The first thousand refused lines; then, for a failed replay, the reason."""

    def progress(self) -> ReplayProgress:
        """The replay without the refused lines."""
        names = ReplayProgress.__struct_fields__
        return ReplayProgress(**{name: getattr(self, name) for name in names})


ReplayList = list_record("ReplayList", Replay, "The latest replays, newest first.")


class RunState(Record, frozen=True, kw_only=True):
    """A run, and whether its batches can raise alarms."""

    run: str
    alarms: bool


class ComparedSide(StarCounts, frozen=True, kw_only=True):
    """Results of all batches with one set of options."""

    component: ClassVar[str] = "SideOut"
    options: MissionSettings
    solved: Count
    suspect: Count
    residual_ratio_mean: float | None
    us_per_batch: float | None
    """Median time for zones, identification and attitude."""


class Transition(Record, frozen=True, kw_only=True):
    """Number of stars with an outcome on side a and an outcome on side b, including equal ones."""

    from_: Outcome = field(name="from")
    to: Outcome
    stars: Count


class ComparedAttitudes(Record, frozen=True, kw_only=True):
    """How many batches have an attitude on either side, and the angles between them."""

    component: ClassVar[str] = "AttitudesOut"
    both: Count
    only_a: Count
    only_b: Count
    neither: Count
    angle_arcsec_median: float | None
    angle_arcsec_max: float | None


class StarSide(Record, frozen=True, kw_only=True):
    """One star on one side."""

    outcome: Outcome
    star: str | None


class StarChange(Record, frozen=True, kw_only=True):
    """One star that differs."""

    tracker: str
    position: Annotated[Count, doc("Position among the tracker's stars, from 0.")]
    a: StarSide
    b: StarSide


class BatchChange(Record, frozen=True, kw_only=True):
    """One batch of which a star or the attitude differs."""

    id: Id
    batch: str
    time: Moment
    a: StarCounts
    b: StarCounts
    attitude_angle_arcsec: float | None
    stars: list[StarChange]


class ComparedCell(Record, frozen=True, kw_only=True):
    """Stars of the batches of one cell of time, by outcome on both sides."""

    start: Moment
    a: StarCounts
    b: StarCounts


class Comparison(Record, frozen=True, kw_only=True):
    """The results of both sides, and their differences."""

    spacecraft: str
    run: str
    start: Annotated[Moment | None, doc("Time of the earliest batch of the sample.")]
    end: Moment | None
    batches_in_stretch: Count
    sampled: Count
    compared: Count
    cut_short: Annotated[bool, doc("True if the time limit ended the comparison early.")]
    cell_s: Annotated[Count, doc("Width of the cells of the trend, in seconds.")]
    trend: Annotated[list[ComparedCell], doc("The cells of time that have batches, oldest first.")]
    a: ComparedSide
    b: ComparedSide
    transitions: list[Transition]
    renamed: Count
    """Stars that are unique on both sides, but as different catalog stars."""
    attitudes: ComparedAttitudes
    changed_batches: Count
    changed: Annotated[list[BatchChange], doc("The first hundred, oldest first.")]


class OutcomeCounts(Struct, frozen=True, kw_only=True):
    """Stars by outcome, without their sum."""

    unique: int
    ambiguous: int
    unmatched: int


class StatusCounts(Struct, frozen=True, kw_only=True):
    """Batches by the status of their attitude."""

    good: int = 0
    suspect: int = 0
    none: int = 0


class RunTransition(Struct, frozen=True, kw_only=True):
    """Number of stars with an outcome in one run and an outcome in the other."""

    before: str
    after: str
    same_star: bool
    stars: int

    @property
    def is_change(self) -> bool:
        """True if the outcome differs, or the named star."""
        return self.before != self.after or (self.before == "unique" and not self.same_star)


class RunStars(Struct, frozen=True, kw_only=True):
    """Outcomes of the stars of the batches that both runs have."""

    observed: int
    before: OutcomeCounts
    after: OutcomeCounts
    transitions: list[RunTransition]


class AngleStatistics(Struct, frozen=True, kw_only=True):
    """Angles between the attitudes of two runs, in arcseconds."""

    median: float
    p95: float
    max: float


class RunAttitudes(Struct, frozen=True, kw_only=True):
    """Attitudes of the batches that both runs have, and the angles between them."""

    before: StatusCounts
    after: StatusCounts
    in_both: int
    angle_arcsec: AngleStatistics | None


class RunComparison(Struct, frozen=True, kw_only=True):
    """The batches that two runs have in common: `before` in `run`, `after` in `other`."""

    run: str | None
    other: str
    batches: int
    stars: RunStars
    attitudes: RunAttitudes


class RunChangeSide(Struct, frozen=True, kw_only=True):
    """What a batch came to in one of two runs."""

    id: Id
    counts: OutcomeCounts
    status: str | None


class RunChange(Struct, frozen=True, kw_only=True):
    """A batch that came to something else in another run."""

    batch: str
    time: Moment
    before: RunChangeSide
    after: RunChangeSide


@dataclass(frozen=True)
class RunRates:
    """All current results of a spacecraft in one run."""

    run: str
    totals: Mapping[str, int]
    """The totals of a rollup's counts, such as `observed`."""
    shares: Mapping[str, Vector]
    """Shares of the observed stars: `ambiguous`, `unmatched` in each cell; NaN without a star."""


@dataclass(frozen=True)
class RatesOfRuns:
    """Runs over one period, divided into cells of an hour, a day or several days."""

    start: Utc
    end: Utc
    cell_s: int
    runs: tuple[RunRates, ...]
