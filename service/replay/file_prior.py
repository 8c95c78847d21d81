"""A priori attitudes of a replay that a file gives: an AEM or a C-kernel."""

import json
from dataclasses import replace

import numpy as np

from service.errors import BadInput, Fault, shown_value
from service.observations.schema import submission_from_json
from service.products.reading.known_attitudes import KnownAttitudes
from service.replay.items import Item


class FilePrior:
    """Writes the attitude that a file gives for a batch's time into its `a_priori`.

    A batch outside the segments of the file keeps its own.  `given` counts the others.
    """

    def __init__(self, known: KnownAttitudes) -> None:
        self._known = known
        self._spacecraft: str | None = None
        self.given = 0

    def prepared(self, item: Item) -> Item:
        """The item with the attitude in its `a_priori`, unchanged where the file has none.

        Raises `BadInput` for a batch of another spacecraft than the one before.
        """
        if item.submission is None:
            return item
        batch = item.submission.batch
        if self._spacecraft not in (None, batch.spacecraft):
            message = f"is of one spacecraft, but the batches are of {self._spacecraft} and others"
            raise BadInput(Fault("--a-priori", message, shown_value(batch.spacecraft)))
        self._spacecraft = batch.spacecraft
        (quaternion,) = self._known.at(np.array([batch.time.tai_ns]))
        if np.isnan(quaternion[0]):
            return item
        if quaternion[3] < 0:
            quaternion = -quaternion
        self.given += 1
        body = json.loads(item.submission.text)
        body["a_priori"] = {"quaternion": quaternion.tolist(), "frame": "EME2000"}
        return replace(item, submission=submission_from_json(json.dumps(body)))
