"""Carry attitudes along a replay: the attitude of one batch is the a priori of the next.

It goes into the next batch's `a_priori` before that is sent, so the recorded
batch explains its answer.
"""

import json
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from service.observations.schema import submission_from_json
from service.replay.items import Item, LineOutcome, Report
from service.times import Utc
from service.vectors import (
    Matrix,
    Vector,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotate_about,
)

CARRIED_WITHIN_S = 3600.0
"""After more than an hour a batch keeps its own a priori knowledge."""


@dataclass(frozen=True)
class _KnownAttitude:
    """The attitude (3, 3), inertial to body, found for a batch."""

    attitude: Matrix
    time: Utc
    rates_deg_per_s: Vector


class AttitudeCarrier:
    """Remembers the last good attitude of every spacecraft and writes it into its next batch.

    Between the two batches the body turns with the mean of their rates where both
    give rates, else with the given ones.  A suspect or missing attitude is not
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
        given = [each for each in (known.rates_deg_per_s, batch.body_rates_deg_per_s) if each.any()]
        rates_deg_per_s = np.mean(given, axis=0) if given else np.zeros(3)
        body = json.loads(item.submission.text)
        quaternion = quaternion_from_matrix(turned(known.attitude, rates_deg_per_s, passed_s))
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
            matrix_from_quaternion(attitude["quaternion"]), batch.time, batch.body_rates_deg_per_s
        )


def reporting_to_carrier(report: Report, carrier: AttitudeCarrier) -> Report:
    """A report that passes every outcome to the carrier too."""

    def both(outcome: LineOutcome) -> None:
        carrier.note(outcome)
        report(outcome)

    return both


def turned(attitude: Matrix, rates_deg_per_s: Vector, seconds: float) -> Matrix:
    """The attitude after the body has turned with constant rates, in body axes, for a time."""
    # A direction fixed in inertial space turns the other way in the body.
    return rotate_about(-np.radians(rates_deg_per_s) * seconds, attitude.T).T
