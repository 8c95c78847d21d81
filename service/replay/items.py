"""The lines of telemetry files to replay, and the outcome of each."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from service.errors import BadInput, Fault, problem_of, problem_of_faults, shown_value
from service.gyro import GyroBlock, block_from_line, is_gyro_line
from service.observations.readers.decompress import Line
from service.observations.readers.telemetry import read_lines
from service.observations.schema import RunName, Submission, submission_from_json
from service.packets.reader import PacketReader, file_lines
from service.times import Utc

Problem = dict[str, Any]


@dataclass(frozen=True)
class Item:
    """One line of a file: the batch or the gyro block in it, or the problem with it."""

    file: Path
    number: int
    submission: Submission | None
    problem: Problem | None = None
    gyro: GyroBlock | None = None

    @property
    def time(self) -> Utc | None:
        """The time of the batch, or of the last sample of the gyro block."""
        if self.submission is not None:
            return self.submission.batch.time
        return None if self.gyro is None else self.gyro.end


@dataclass(frozen=True)
class LineOutcome:
    """The outcome of a line: the answer's own bytes, or a problem.

    Of a gyro block the answer is the recorded block.  `replayed` tells that the batch or the
    block was already recorded.
    """

    item: Item
    answer: bytes | None
    replayed: bool = False
    problem: Problem | None = None


Report = Callable[[LineOutcome], None]


def items_of(files: Sequence[Path], run: str) -> Iterator[Item]:
    """Every line of the files, in order, checked as a batch or a gyro block of that run."""
    for file in files:
        for line in read_lines(file):
            yield _item(file, line, run)


def packet_items(reader: PacketReader, files: Sequence[Path], run: str) -> Iterator[Item]:
    """Every batch that files of space packets hold, as `items_of` gives those of telemetry."""
    for file, line in file_lines(reader, files):
        yield _item(file, line, run)


def _item(file: Path, line: Line, run: str) -> Item:
    if line.body is None:
        assert line.fault is not None
        return Item(file, line.number, None, problem_of_faults([line.fault]))
    try:
        if is_gyro_line(line.body):
            return Item(file, line.number, None, gyro=block_from_line(line.body, run))
        return Item(file, line.number, submission_from_json(line.body, run))
    except BadInput as error:
        return Item(file, line.number, None, problem_of(error))


def run_name(files: Sequence[Path], run: str | None) -> str:
    """The run that takes every batch: the one asked for, else the first file's stem.

    Raises `BadInput` for a name that no run can have.
    """
    name = files[0].stem if run is None else run
    try:
        return TypeAdapter(RunName).validate_python(name)
    except ValidationError:
        where = "--run" if run is not None else f"{files[0].name}, whose stem would name the run"
        message = "a run has 1 to 64 of A-Z a-z 0-9 _ . : -, a letter or digit first"
        hint = "" if run is not None else "; give --run NAME"
        raise BadInput(Fault(where, message + hint, shown_value(name))) from None


class Pace:
    """When each item is due: at its own time, sped up by a factor, or at once without one."""

    def __init__(self, factor: float | None = None) -> None:
        self.factor = factor
        self._first: tuple[int, float] | None = None

    def wait_s(self, item: Item, now_s: float) -> float:
        """Seconds until the item is due; the first is due now."""
        time = item.time
        if self.factor is None or time is None:
            return 0.0
        if self._first is None:
            self._first = (time.tai_ns, now_s)
        first_ns, start_s = self._first
        return max(0.0, start_s + (time.tai_ns - first_ns) * 1e-9 / self.factor - now_s)
