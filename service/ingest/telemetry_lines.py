"""Lines of telemetry, a batch or a gyro block each: read and solved many at once.

In this process or in a worker.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec

from service.errors import AcquisitionError
from service.gyro.block import GyroBlock
from service.gyro.schema import block_from_line, is_gyro_line
from service.observations.batch import ObservationBatch
from service.observations.schema import Submission, submission_from_json
from service.storage.recording.identity import Identity, identity_of
from service.storage.recording.unsaved_result import UnsavedResult


@dataclass(frozen=True)
class TelemetryLines:
    """Lines for one run; `known` holds the positions of those that seem to be recorded."""

    run: str
    texts: Sequence[bytes]
    known: frozenset[int] = frozenset()


@dataclass(frozen=True)
class RecordedLine:
    """A line that was read, but not computed."""

    identity: Identity
    fingerprint: str


@dataclass(frozen=True)
class InvalidLine:
    """The error of a line, and the spacecraft of its batch where it can be read."""

    spacecraft: str | None
    error: AcquisitionError


@dataclass(frozen=True)
class TrackedLine:
    """A batch that asks for the last attitude, as JSON: only the record has it."""

    identity: Identity
    text: str


LineResult = UnsavedResult | RecordedLine | InvalidLine | GyroBlock | TrackedLine
ComputeMany = Callable[[Sequence[Submission]], Sequence[UnsavedResult | AcquisitionError]]


def line_results(
    lines: TelemetryLines, compute: ComputeMany, asks_for_last: Callable[[ObservationBatch], bool]
) -> list[LineResult]:
    """The result of each line, in order; `compute` is given all new submissions.

    Except those for which `asks_for_last` is true: they need what is recorded before them.
    """
    read = [_read(text, lines.run) for text in lines.texts]
    tracked = {
        place
        for place, each in enumerate(read)
        if isinstance(each, Submission) and place not in lines.known and asks_for_last(each.batch)
    }
    fresh = [
        each
        for place, each in enumerate(read)
        if isinstance(each, Submission) and place not in lines.known | tracked
    ]
    computed = iter(compute(fresh))
    found: list[LineResult] = []
    for place, each in enumerate(read):
        if isinstance(each, InvalidLine | GyroBlock):
            found.append(each)
        elif place in lines.known:
            found.append(RecordedLine(identity_of(each.batch), each.fingerprint))
        elif place in tracked:
            found.append(TrackedLine(identity_of(each.batch), each.text))
        else:
            match next(computed):
                case AcquisitionError() as error:
                    found.append(InvalidLine(each.batch.spacecraft, error))
                case made:
                    found.append(made)
    return found


def _read(text: bytes, run: str) -> Submission | GyroBlock | InvalidLine:
    try:
        if is_gyro_line(text):
            return block_from_line(text, run)
        return submission_from_json(text, run=run)
    except AcquisitionError as error:
        return InvalidLine(None, error)


_Name = Annotated[str, msgspec.Meta(min_length=1, max_length=128, pattern=r"^[^\x00-\x1f\x7f]+\Z")]


class _NamedBatch(msgspec.Struct):
    """As much of a batch as names it."""

    spacecraft: _Name
    batch: _Name


_NAMED = msgspec.json.Decoder(_NamedBatch)


def identity_in(text: bytes, run: str) -> Identity | None:
    """The identity in a line, without checking the rest; None where it cannot be read."""
    try:
        named = _NAMED.decode(text)
    except (msgspec.MsgspecError, UnicodeError, RecursionError):
        return None
    return named.spacecraft, run, named.batch
