"""Runs and replays."""

from typing import Annotated, ClassVar, Literal

from msgspec import UNSET, UnsetType
from pydantic import Field

from service.storage.models.base import Count, FieldFault, Id, Record, Stamp, doc, list_record

ReplayStateName = Literal["running", "waiting", "done", "interrupted", "failed", "cancelled"]
"""A replay that is `waiting` goes on by itself as soon as the service is ready after a restart."""


class Run(Record, frozen=True, kw_only=True):
    """A run."""

    component: ClassVar[str] = "RunRow"
    run: str
    created: Stamp
    alarms: Annotated[bool, doc("Whether its batches can raise alarms.")]
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
    described: Annotated[bool, doc("Whether the XTCE file describes them.")]
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
