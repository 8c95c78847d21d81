"""Records of runs and replays, and of comparisons of two runs or two sets of options."""
# Written by `make client` from service/contract/runs.py.

from collections.abc import Sequence

from ..base import Model
from .problems import FieldFault


class Run(Model, frozen=True, kw_only=True):
    """Run: a named set of batches and their results."""

    run: str
    created: str
    alarms: bool
    """True if its batches can raise alarms."""
    batches: int
    spacecraft: Sequence[str]
    first_day: str
    last_day: str


class ReplayLines(Model, frozen=True, kw_only=True):
    """Number of lines of a replay: total, done and refused."""

    total: int | None
    """None if the number is not known in advance."""
    done: int
    refused: int


class ReplayCounts(Model, frozen=True, kw_only=True):
    """Number of batches, stars and gyro blocks in the lines of a replay so far."""

    new: int
    """Batches that this replay recorded."""
    repeated: int
    """Batches that were already recorded."""
    observed: int
    """Number of observed stars of the replay's batches; the next fields count them by outcome."""
    unique: int
    ambiguous: int
    unmatched: int
    attitudes: int
    """Batches with an attitude."""
    gyro_new: int = 0
    """Gyro blocks that this replay recorded."""
    gyro_repeated: int = 0
    """Gyro blocks that were already recorded."""


class ApidPackets(Model, frozen=True, kw_only=True):
    """Counts of a replay's space packets with one APID."""

    apid: int
    packets: int
    described: bool
    """True if the XTCE file describes them."""
    gaps: int
    """Places where the sequence count skips packets."""
    missing: int
    """Packets that are missing in these places."""
    backward: int
    """Number of places where the sequence count repeats or goes back: a reset, or another order."""
    refused: int
    incomplete: int = 0
    """Segments of packets of which others are missing."""


class ReplayPackets(Model, frozen=True, kw_only=True):
    """Counts of a replay's space packets so far."""

    packets: int
    bytes: int
    batches: int
    """Batches that the packets hold."""
    without_stars: int
    """Without a star or a measured attitude: left out."""
    gyro_blocks: int
    """Gyro blocks that the packets hold."""
    gyro_samples: int
    """Samples of these blocks."""
    unknown: int
    """Packets that the XTCE file does not describe."""
    not_asked: int
    """Packets of APIDs that the mission's table leaves out."""
    idle: int
    """Idle packets (APID 2047)."""
    gaps: int
    missing: int
    backward: int
    refused: int
    """Packets that could not be read."""
    joined: int = 0
    """Packets that were joined of segments."""
    incomplete: int = 0
    """Number of segments of incomplete packets; they are counted as refused as well."""
    unread_bytes: int = 0
    """Number of bytes from the first unreadable packet of each file to the end of the file."""
    empty_files: int = 0
    """Files without a packet."""
    without_attitude: int = 0
    """Number of packets whose a priori quaternion was zero or not finite."""
    apids: Sequence[ApidPackets]
    """The hundred APIDs with the most packets."""


class LineProblem(Model, frozen=True, kw_only=True):
    """Problem of a refused line, with its faults."""

    detail: str
    errors: Sequence[FieldFault] = ()
    """Every fault, field by field."""


class RefusedLine(Model, frozen=True, kw_only=True):
    """Refused line of a replay, which continues with the next line."""

    line: int
    """Number of the line, or of the packet in its file, from 1."""
    problem: LineProblem


class ReplayProgress(Model, frozen=True, kw_only=True):
    """Replay with its progress, without the refused lines: the data of an event."""

    id: str
    run: str
    name: str
    state: str
    lines: ReplayLines
    counts: ReplayCounts
    started: str
    finished: str | None


class Replay(ReplayProgress, frozen=True, kw_only=True):
    """Replay with its progress and refused lines."""

    packets: ReplayPackets | None
    """None unless the replay reads space packets."""
    errors: Sequence[RefusedLine]
    """The first thousand refused lines of the replay; then, for a failed replay, the reason."""


class RunState(Model, frozen=True, kw_only=True):
    """Run, with the evaluation of its limits on or off."""

    run: str
    alarms: bool
