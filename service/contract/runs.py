"""Records of runs and replays, and of comparisons of two runs or two sets of options."""

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
"""States of a replay. One that is `waiting` resumes by itself after a restart, when the service
is ready."""


class Run(Record, frozen=True, kw_only=True):
    """Run: a named set of batches and their results."""

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
    """Counts of the data that are removed when a run, or part of one, is forgotten."""

    run: str
    spacecraft: Annotated[str | None, doc("null: of every spacecraft.")]
    batches: Annotated[Count, doc("Batches in the database, with their results.")]
    archived_batches: Annotated[Count, doc("Batches in the archive.")]
    gyro_blocks: Count
    graded_days: Count
    """Number of days of filtered and smoothed attitudes that were computed with the removed data,
    every revision counted. `acquire smooth` computes them again from the remaining data.
    """


class ReplayLines(Record, frozen=True, kw_only=True):
    """Number of lines of a replay: total, done and refused."""

    total: Annotated[int | None, doc("null if the number is not known in advance.")]
    done: Count
    refused: Count


class ReplayCounts(Record, frozen=True, kw_only=True):
    """Number of batches, stars and gyro blocks in the lines of a replay so far."""

    new: Annotated[Count, doc("Batches that this replay recorded.")]
    repeated: Annotated[Count, doc("Batches that were already recorded.")]
    observed: Count
    """Number of observed stars of the replay's batches; the next fields count them by outcome."""
    unique: Count
    ambiguous: Count
    unmatched: Count
    attitudes: Annotated[Count, doc("Batches with an attitude.")]
    gyro_new: Annotated[Count, doc("Gyro blocks that this replay recorded.")] = 0
    gyro_repeated: Annotated[Count, doc("Gyro blocks that were already recorded.")] = 0


class ApidPackets(Record, frozen=True, kw_only=True):
    """Counts of a replay's space packets with one APID."""

    apid: Annotated[int, Field(ge=0, le=2047)]
    packets: Count
    described: Annotated[bool, doc("True if the XTCE file describes them.")]
    gaps: Annotated[Count, doc("Places where the sequence count skips packets.")]
    missing: Annotated[Count, doc("Packets that are missing in these places.")]
    backward: Count
    """Number of places where the sequence count repeats or goes back: a reset, or another order."""
    refused: Count
    incomplete: Annotated[Count, doc("Segments of packets of which others are missing.")] = 0


class ReplayPackets(Record, frozen=True, kw_only=True):
    """Counts of a replay's space packets so far."""

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
    """Number of segments of incomplete packets; they are counted as refused as well."""
    unread_bytes: Count = 0
    """Number of bytes from the first unreadable packet of each file to the end of the file."""
    empty_files: Annotated[Count, doc("Files without a packet.")] = 0
    without_attitude: Count = 0
    """Number of packets whose a priori quaternion was zero or not finite."""
    apids: Annotated[list[ApidPackets], doc("The hundred APIDs with the most packets.")]


class LineProblem(Record, frozen=True, kw_only=True):
    """Problem of a refused line, with its faults."""

    detail: str
    errors: Annotated[list[FieldFault] | UnsetType, doc("Every fault, field by field.")] = UNSET


class RefusedLine(Record, frozen=True, kw_only=True):
    """Refused line of a replay, which continues with the next line."""

    line: Annotated[int, doc("Number of the line, or of the packet in its file, from 1.")]
    problem: LineProblem


class ReplayProgress(Record, frozen=True, kw_only=True):
    """Replay with its progress, without the refused lines: the data of an event."""

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
    """Replay with its progress and refused lines."""

    component: ClassVar[str] = "ReplayState"
    packets: Annotated[ReplayPackets | None, doc("null unless the replay reads space packets.")]
    errors: list[RefusedLine]
    """The first thousand refused lines of the replay; then, for a failed replay, the reason."""

    def progress(self) -> ReplayProgress:
        """Progress of the replay, without its refused lines."""
        names = ReplayProgress.__struct_fields__
        return ReplayProgress(**{name: getattr(self, name) for name in names})


ReplayList = list_record("ReplayList", Replay, "The latest replays, newest first.")


class RunState(Record, frozen=True, kw_only=True):
    """Run, with the evaluation of its limits on or off."""

    run: str
    alarms: bool


class ComparedSide(StarCounts, frozen=True, kw_only=True):
    """One side of a comparison: results of all batches with one set of options."""

    component: ClassVar[str] = "SideOut"
    options: MissionSettings
    solved: Count
    suspect: Count
    residual_ratio_mean: float | None
    us_per_batch: float | None
    """Median computing time of a batch in microseconds, for zones, identification and attitude."""


class Transition(Record, frozen=True, kw_only=True):
    """Number of stars by outcome on side a and outcome on side b, including equal outcomes."""

    from_: Outcome = field(name="from")
    to: Outcome
    stars: Count


class ComparedAttitudes(Record, frozen=True, kw_only=True):
    """Number of batches with an attitude on each side of a comparison, and their angles."""

    component: ClassVar[str] = "AttitudesOut"
    both: Count
    only_a: Count
    only_b: Count
    neither: Count
    angle_arcsec_median: float | None
    angle_arcsec_max: float | None


class StarSide(Record, frozen=True, kw_only=True):
    """Identification of one star on one side of a comparison."""

    outcome: Outcome
    star: str | None


class StarChange(Record, frozen=True, kw_only=True):
    """Star whose identification differs between both sides of a comparison."""

    tracker: str
    position: Annotated[Count, doc("Position among the tracker's stars, from 0.")]
    a: StarSide
    b: StarSide


class BatchChange(Record, frozen=True, kw_only=True):
    """Batch with a star or an attitude that differs between both sides of a comparison."""

    id: Id
    batch: str
    time: Moment
    a: StarCounts
    b: StarCounts
    attitude_angle_arcsec: float | None
    stars: list[StarChange]


class ComparedCell(Record, frozen=True, kw_only=True):
    """Number of stars by outcome on both sides of a comparison, in one cell of time."""

    start: Moment
    a: StarCounts
    b: StarCounts


class Comparison(Record, frozen=True, kw_only=True):
    """Comparison of two sets of options: the results of both sides, and their differences."""

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
    """Number of stars unique on both sides, but identified as different catalog stars."""
    attitudes: ComparedAttitudes
    changed_batches: Count
    changed: Annotated[list[BatchChange], doc("The first hundred, oldest first.")]


class OutcomeCounts(Struct, frozen=True, kw_only=True):
    """Number of unique, ambiguous and unmatched stars."""

    unique: int
    ambiguous: int
    unmatched: int


class StatusCounts(Struct, frozen=True, kw_only=True):
    """Number of batches by the status of their attitude."""

    good: int = 0
    suspect: int = 0
    none: int = 0


class RunTransition(Struct, frozen=True, kw_only=True):
    """Number of stars by outcome in one run and outcome in the other run."""

    before: str
    after: str
    same_star: bool
    stars: int

    @property
    def is_change(self) -> bool:
        """True if the outcome or the named catalog star differs."""
        return self.before != self.after or (self.before == "unique" and not self.same_star)


class RunStars(Struct, frozen=True, kw_only=True):
    """Outcomes of the stars in batches that both compared runs have."""

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
    """Attitudes of the batches that both compared runs have, and the angles between them."""

    before: StatusCounts
    after: StatusCounts
    in_both: int
    angle_arcsec: AngleStatistics | None


class RunComparison(Struct, frozen=True, kw_only=True):
    """Comparison of two runs over their common batches: `before` in `run`, `after` in `other`."""

    run: str | None
    other: str
    batches: int
    stars: RunStars
    attitudes: RunAttitudes


class RunChangeSide(Struct, frozen=True, kw_only=True):
    """Counts and status of a batch in one of two compared runs."""

    id: Id
    counts: OutcomeCounts
    status: str | None


class RunChange(Struct, frozen=True, kw_only=True):
    """Batch whose counts or status differ between two runs."""

    batch: str
    time: Moment
    before: RunChangeSide
    after: RunChangeSide


@dataclass(frozen=True)
class RunRates:
    """Rates of stars by outcome over all current results of a spacecraft in one run."""

    run: str
    totals: Mapping[str, int]
    """Totals of a rollup's counts by name, such as `observed`."""
    shares: Mapping[str, Vector]
    """Fractions of observed stars by outcome (`ambiguous`, `unmatched`) in each time cell."""


@dataclass(frozen=True)
class RatesOfRuns:
    """Rates of several runs over one period, divided into cells of hours or days."""

    start: Utc
    end: Utc
    cell_s: int
    runs: tuple[RunRates, ...]
