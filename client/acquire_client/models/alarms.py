"""Records of alarms, limits, and annotations, which are notes of people."""
# Written by `make client` from service/contract/alarms.py and
# service/features/alarms/records.py.

from collections.abc import Sequence
from typing import Any

from ..base import Model


class Limit(Model, frozen=True, kw_only=True):
    """Limit of one quantity of a spacecraft or a tracker."""

    spacecraft: str
    quantity: str
    tracker: str | None = None
    """None: of the spacecraft as a whole."""
    unit: str
    is_default: bool
    """True if the limit is the shipped one; for a tracker, if it is that of its spacecraft."""
    since: str | None
    """None: it was never changed."""
    who: str | None
    comment: str | None
    settings: dict[str, Any]


class AlarmValue(Model, frozen=True, kw_only=True):
    """Value of a quantity that a limit was evaluated for, with its time and batch."""

    value: float
    time: str
    """Time of the batch; for silence, of the batch before it."""
    batch_id: str | None


class AlarmRaised(AlarmValue, frozen=True, kw_only=True):
    """Value of a quantity that raised an alarm."""

    at: str
    bound: float
    """The bound of the worst severity so far."""


class Acted(Model, frozen=True, kw_only=True):
    """Author and time of an action on an alarm."""

    at: str
    who: str


class Shelved(Acted, frozen=True, kw_only=True):
    """Author, time and end of the shelving of an alarm."""

    until: str


class Alarm(Model, frozen=True, kw_only=True):
    """Alarm, kept until it is acknowledged and its quantity is back in limits."""

    id: str
    spacecraft: str
    run: str
    quantity: str
    tracker: str | None = None
    """Tracker that the alarm is about; None: the spacecraft as a whole."""
    unit: str
    state: str
    severity: str
    """The worst severity so far."""
    current_severity: str | None
    """None: the value is back in limits."""
    in_limits: bool
    raised: AlarmRaised
    worst: AlarmValue
    latest: AlarmValue
    returned_at: str | None
    acknowledged: Acted | None
    shelved: Shelved | None
    cleared_at: str | None


class Annotation(Model, frozen=True, kw_only=True):
    """Annotation: a note about a time or a period, signed by its author."""

    id: str
    spacecraft: str | None
    """None: it is about every spacecraft."""
    start: str
    """Telemetry time."""
    end: str | None
    """None: the note is about a moment."""
    text: str
    who: str
    created: str


class AnnotationChange(Annotation, frozen=True, kw_only=True):
    """Data of an event about an annotation that was written or deleted."""

    deleted: bool


class AlarmAction(Model, frozen=True, kw_only=True):
    """An entry in the history of an alarm, caused by a new value or by a user."""

    at: str
    action: str
    who: str | None
    comment: str | None
    severity: str | None
    value: float | None
    time: str | None


class AlarmWithActions(Alarm, frozen=True, kw_only=True):
    """An alarm with the history of its actions."""

    actions: Sequence[AlarmAction]
    """Oldest first."""
