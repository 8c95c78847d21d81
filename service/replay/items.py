"""The lines of telemetry files to replay, what is added to their batches, and the outcome of each.

Added are attitudes that are carried along, or data of a file.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np
from pydantic import TypeAdapter, ValidationError

from service import vectors
from service.ephemerides.known import Ephemeris, KnownAttitudes
from service.errors import BadInput, Fault, problem_of, problem_of_faults, shown_value
from service.gyro.blocks import GyroBlock, block_from_line, is_gyro_line
from service.interpolation import LARGEST_ERROR_RAD, QUARTER_TURN_RAD
from service.observations.batch import ObservationBatch
from service.observations.decompress import Line
from service.observations.schema import RunName, Submission, submission_from_json
from service.observations.telemetry import read_lines
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
            yield item_of(file, line, run)


class OtherFiles(Protocol):
    """Files of another form than lines, which a feature reads; see `service.feature`."""

    files: Sequence[Path]
    spacecraft: str | None
    """The mission of the files, where it is named."""

    def items(self, run: str) -> Iterator[Item]:
        """Every batch and gyro block in the files, read in this process."""

    def counts(self) -> dict[str, Any] | None:
        """The counts of what was read in this process; None where nothing was."""

    def __iter__(self) -> Iterator[bytes]:
        """The files as they are sent to a service."""

    def item(self, number: int) -> Item:
        """The place of a batch that the service refused by its number."""


def item_of(file: Path, line: Line, run: str) -> Item:
    """A line of a file, checked as a batch or a gyro block of that run."""
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


class FromFile(ABC):
    """Writes what a file says of a batch's time into the batch, before it is sent.

    The recorded batch then holds it.  `supplied` counts the batches that got something.
    """

    option: str
    """The option of the command that names the file."""
    key: str
    """The name of the count in the command's JSON."""
    title: str
    """The name of the count for people."""

    def __init__(self) -> None:
        self._spacecraft: str | None = None
        self.supplied = 0

    def prepared(self, item: Item) -> Item:
        """The item with what the file says, unchanged where that is nothing.

        Raises `BadInput` for a batch of another spacecraft than the one before.
        """
        if item.submission is None:
            return item
        batch = item.submission.batch
        if self._spacecraft not in (None, batch.spacecraft):
            message = f"is of one spacecraft, but the batches are of {self._spacecraft} and others"
            raise BadInput(Fault(self.option, message, shown_value(batch.spacecraft)))
        self._spacecraft = batch.spacecraft
        added = self.added_to(batch)
        if not added:
            return item
        self.supplied += 1
        body = json.loads(item.submission.text) | added
        return replace(item, submission=submission_from_json(json.dumps(body)))

    @abstractmethod
    def added_to(self, batch: ObservationBatch) -> dict[str, Any]:
        """The fields of the batch that the file fills."""


class FilePrior(FromFile):
    """The attitude of an AEM or C-kernel, as `a_priori`.

    A batch keeps its own outside the segments of the file, and where the body may have turned any
    way between two of its attitudes.
    """

    option, key, title = "--a-priori", "a_priori_from_file", "a priori of file"

    def __init__(self, known: KnownAttitudes) -> None:
        super().__init__()
        self._known = known

    def added_to(self, batch: ObservationBatch) -> dict[str, Any]:
        """The a priori attitude."""
        rates = batch.body_rates_deg_per_s
        own = np.radians(rates)[None] if rates.any() else None
        (quaternion,) = self._known.at(np.array([batch.time.tai_ns]), own)
        if np.isnan(quaternion[0]):
            return {}
        if quaternion[3] < 0:
            quaternion = -quaternion
        return {"a_priori": {"quaternion": quaternion.tolist(), "frame": "EME2000"}}


class FileEphemeris(FromFile):
    """Position and velocity of an OEM or TLE, for batches that carry none.

    A batch outside the span of the file gets nothing.
    """

    option, key, title = "--ephemeris", "state_from_file", "velocity of file"

    def __init__(self, known: Ephemeris) -> None:
        super().__init__()
        self._known = known

    def added_to(self, batch: ObservationBatch) -> dict[str, Any]:
        """The velocity and the position, each where the batch has none."""
        wanted = {
            name: part
            for name, own, part in (
                ("velocity_km_per_s", batch.velocity_km_per_s, slice(3, 6)),
                ("position_km", batch.position_km, slice(0, 3)),
            )
            if own is None
        }
        state = self._known.at(batch.time) if wanted else None
        if state is None:
            return {}
        return {name: state[part].tolist() for name, part in wanted.items()}


# Carry attitudes along a replay: the attitude of one batch is the a priori of the next.
#
# It goes into the next batch's `a_priori` before that is sent, so the recorded
# batch explains its answer.

CARRIED_WITHIN_S = 3600.0
"""The age of the last attitude above which a batch keeps its own a priori knowledge."""


@dataclass(frozen=True)
class _KnownAttitude:
    """The attitude (3, 3), inertial to body, found for a batch."""

    attitude: vectors.Matrix
    time: Utc
    rates_deg_per_s: vectors.Vector


class AttitudeCarrier:
    """Remembers the last good attitude of every spacecraft and writes it into its next batch.

    Between the two batches the body turns with the mean of their rates where both
    give rates, else with the given ones; where these differ and it turns far, nothing is carried.
    A suspect or missing attitude is not
    carried: the last good one is.
    """

    def __init__(self) -> None:
        self._known: dict[str, _KnownAttitude] = {}

    def prepared(self, item: Item) -> Item:
        """The item with the attitude in its `a_priori`, unchanged where none is known."""
        if item.submission is None or item.submission.batch.measurement is not None:
            return item
        batch = item.submission.batch
        known = self._known.get(batch.spacecraft)
        if known is None:
            return item
        passed_s = (batch.time.tai_ns - known.time.tai_ns) * 1e-9
        if abs(passed_s) > CARRIED_WITHIN_S:
            return item
        rates = [each for each in (known.rates_deg_per_s, batch.body_rates_deg_per_s) if each.any()]
        rates_deg_per_s = np.mean(rates, axis=0) if rates else np.zeros(3)
        if _is_unsteady(rates, passed_s):
            return item
        body = json.loads(item.submission.text)
        quaternion = vectors.quaternion_from_matrix(
            turned(known.attitude, rates_deg_per_s, passed_s)
        )
        body["a_priori"] = {"quaternion": quaternion.tolist(), "frame": "EME2000"}
        return replace(item, submission=submission_from_json(json.dumps(body)))

    def note(self, outcome: LineOutcome) -> None:
        """Remember the attitude of an answer, if it is a good one."""
        if outcome.answer is None or outcome.item.submission is None:
            return
        attitude = msgspec.json.decode(outcome.answer)["attitude"]
        if attitude is None or attitude["status"] != "good":
            return
        batch = outcome.item.submission.batch
        self._known[batch.spacecraft] = _KnownAttitude(
            vectors.matrix_from_quaternion(attitude["quaternion"]),
            batch.time,
            batch.body_rates_deg_per_s,
        )


def _is_unsteady(rates_deg_per_s: Sequence[vectors.Vector], passed_s: float) -> bool:
    """True if a body that turns far has rates at both ends that lead to different attitudes."""
    if len(rates_deg_per_s) < 2:
        return False
    one, other = np.radians(rates_deg_per_s) * abs(passed_s)
    far = max(float(np.linalg.norm(one)), float(np.linalg.norm(other)))
    apart = float(np.linalg.norm(other - one))
    return far > QUARTER_TURN_RAD and apart > LARGEST_ERROR_RAD


def reporting_to_carrier(report: Report, carrier: AttitudeCarrier) -> Report:
    """A report that passes every outcome to the carrier too."""

    def both(outcome: LineOutcome) -> None:
        carrier.note(outcome)
        report(outcome)

    return both


def turned(
    attitude: vectors.Matrix, rates_deg_per_s: vectors.Vector, seconds: float
) -> vectors.Matrix:
    """The attitude after the body has turned with constant rates, in body axes, for a time."""
    # A direction fixed in inertial space turns the other way in the body.
    return vectors.rotate_about(-np.radians(rates_deg_per_s) * seconds, attitude.T).T
