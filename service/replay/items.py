"""Lines of telemetry files for a replay, additions to their batches, and their outcomes.

Additions are attitudes carried along from earlier batches, or data from a file.
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
    """Line of a telemetry file: its batch or gyro block, or its problem."""

    file: Path
    number: int
    submission: Submission | None
    problem: Problem | None = None
    gyro: GyroBlock | None = None

    @property
    def time(self) -> Utc | None:
        """Time of the batch, or of the last sample of the gyro block; None for a problem."""
        if self.submission is not None:
            return self.submission.batch.time
        return None if self.gyro is None else self.gyro.end


@dataclass(frozen=True)
class LineOutcome:
    """Outcome of a replayed line: the answer's own bytes, or a problem.

    The answer to a gyro block is the recorded block.  `replayed` is True if the batch or the block
    was already recorded.
    """

    item: Item
    answer: bytes | None
    replayed: bool = False
    problem: Problem | None = None


Report = Callable[[LineOutcome], None]


def items_of(files: Sequence[Path], run: str) -> Iterator[Item]:
    """Read every line of files, in order, and check it as a batch or a gyro block of a run."""
    for file in files:
        for line in read_lines(file):
            yield item_of(file, line, run)


class OtherFiles(Protocol):
    """Telemetry files without lines, which a feature reads; see `service.feature`."""

    files: Sequence[Path]
    spacecraft: str | None
    """Name of the files' mission; None if not named."""

    def items(self, run: str) -> Iterator[Item]:
        """Read every batch and gyro block in the files, in this process."""

    def counts(self) -> dict[str, Any] | None:
        """Counts of the data read in this process; None if nothing was read."""

    def __iter__(self) -> Iterator[bytes]:
        """Iterate over the bytes of the files as sent to a service."""

    def item(self, number: int) -> Item:
        """Place in the files of a batch that the service refused, by its number."""


def item_of(file: Path, line: Line, run: str) -> Item:
    """Check a line of a file as a batch or a gyro block of a run."""
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
    """Name of the run for all batches: the requested one, else the first file's stem.

    Raises `BadInput` for an invalid name.
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
    """Pace of a replay: items wait for their own time, sped up by a factor, or are sent at once."""

    def __init__(self, factor: float | None = None) -> None:
        self.factor = factor
        self._first: tuple[int, float] | None = None

    def wait_s(self, item: Item, now_s: float) -> float:
        """Seconds until an item is due; the first is due now."""
        time = item.time
        if self.factor is None or time is None:
            return 0.0
        if self._first is None:
            self._first = (time.tai_ns, now_s)
        first_ns, start_s = self._first
        return max(0.0, start_s + (time.tai_ns - first_ns) * 1e-9 / self.factor - now_s)


class FromFile(ABC):
    """Source that adds data from a file to batches by their time, before they are sent.

    The recorded batch then includes the data.  `supplied` counts the batches with added data.
    """

    option: str
    """Option of `acquire replay` that names the file with the data."""
    key: str
    """Name of the count of supplied batches in the command's JSON."""
    title: str
    """Name of the count of supplied batches in the command's table."""

    def __init__(self) -> None:
        self._spacecraft: str | None = None
        self.supplied = 0

    def prepared(self, item: Item) -> Item:
        """Add the file's data to the batch of an item, if the file has any for its time.

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
        """Fields of a batch that the file supplies, by name."""


class FilePrior(FromFile):
    """Source of a priori attitudes from an AEM or C-kernel.

    A batch keeps its own outside the segments of the file, and where the attitude between two of
    the file's entries is ambiguous.
    """

    option, key, title = "--a-priori", "a_priori_from_file", "a priori of file"

    def __init__(self, known: KnownAttitudes) -> None:
        super().__init__()
        self._known = known

    def added_to(self, batch: ObservationBatch) -> dict[str, Any]:
        """A priori attitude for a batch from the file, as fields of the batch."""
        rates = batch.body_rates_deg_per_s
        own = np.radians(rates)[None] if rates.any() else None
        (quaternion,) = self._known.at(np.array([batch.time.tai_ns]), own)
        if np.isnan(quaternion[0]):
            return {}
        if quaternion[3] < 0:
            quaternion = -quaternion
        return {"a_priori": {"quaternion": quaternion.tolist(), "frame": "EME2000"}}


class FileEphemeris(FromFile):
    """Source of position and velocity from an OEM or TLE, for batches without them.

    A batch outside the span of the file gets none.
    """

    option, key, title = "--ephemeris", "state_from_file", "velocity of file"

    def __init__(self, known: Ephemeris) -> None:
        super().__init__()
        self._known = known

    def added_to(self, batch: ObservationBatch) -> dict[str, Any]:
        """Position and velocity for a batch from the file, each only if the batch has none."""
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
# The attitude goes into the next batch's `a_priori` before that is sent, so the recorded batch
# explains its answer.

CARRIED_WITHIN_S = 3600.0
"""Largest age in seconds of a carried attitude; older, a batch keeps its own a priori knowledge."""


@dataclass(frozen=True)
class _KnownAttitude:
    """Attitude matrix (3, 3), inertial to body, found for a batch."""

    attitude: vectors.Matrix
    time: Utc
    rates_deg_per_s: vectors.Vector


class AttitudeCarrier:
    """Carrier of the last good attitude of every spacecraft to its next batch.

    Between the two batches the body turns with the mean of their rates where both give rates, else
    with the given ones; where these differ and it turns far, nothing is carried.  Suspect attitudes
    are skipped: the last good one is carried.
    """

    def __init__(self) -> None:
        self._known: dict[str, _KnownAttitude] = {}

    def prepared(self, item: Item) -> Item:
        """Set an item's `a_priori` to the attitude carried to its time, if that can be trusted."""
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
        """Remember the attitude of an answer, if it is good."""
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
    """True if rates at both ends of a large turn lead to different attitudes."""
    if len(rates_deg_per_s) < 2:
        return False
    one, other = np.radians(rates_deg_per_s) * abs(passed_s)
    far = max(float(np.linalg.norm(one)), float(np.linalg.norm(other)))
    apart = float(np.linalg.norm(other - one))
    return far > QUARTER_TURN_RAD and apart > LARGEST_ERROR_RAD


def reporting_to_carrier(report: Report, carrier: AttitudeCarrier) -> Report:
    """Wrap a report so that outcomes also go to the carrier of attitudes to later batches."""

    def both(outcome: LineOutcome) -> None:
        carrier.note(outcome)
        report(outcome)

    return both


def turned(
    attitude: vectors.Matrix, rates_deg_per_s: vectors.Vector, seconds: float
) -> vectors.Matrix:
    """Attitude after a rotation of the body with constant rates, in body axes, for `seconds`."""
    # A direction fixed in inertial space turns the other way in the body.
    return vectors.rotate_about(-np.radians(rates_deg_per_s) * seconds, attitude.T).T
