"""What a file adds to the batches of a replay: a priori attitudes, or positions and velocities."""

import json
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any

import numpy as np

from service.errors import BadInput, Fault, shown_value
from service.observations.batch import ObservationBatch
from service.observations.schema import submission_from_json
from service.products.reading.known import Ephemeris, KnownAttitudes
from service.replay.items import Item


class FromFile(ABC):
    """Writes what a file says of a batch's time into the batch, before it is sent.

    The recorded batch then holds it.  `given` counts the batches that got something.
    """

    option: str
    """The option of the command that names the file."""
    key: str
    """The name of the count in the command's JSON."""
    title: str
    """The name of the count for people."""

    def __init__(self) -> None:
        self._spacecraft: str | None = None
        self.given = 0

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
        self.given += 1
        body = json.loads(item.submission.text) | added
        return replace(item, submission=submission_from_json(json.dumps(body)))

    @abstractmethod
    def added_to(self, batch: ObservationBatch) -> dict[str, Any]:
        """The fields of the batch that the file fills."""


class FilePrior(FromFile):
    """The attitude of an AEM or C-kernel, as `a_priori`.

    A batch outside the segments of the file keeps its own.
    """

    option, key, title = "--a-priori", "a_priori_from_file", "a priori of file"

    def __init__(self, known: KnownAttitudes) -> None:
        super().__init__()
        self._known = known

    def added_to(self, batch: ObservationBatch) -> dict[str, Any]:
        """The a priori attitude."""
        (quaternion,) = self._known.at(np.array([batch.time.tai_ns]))
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
