"""Alarms and what was done with them."""

from collections.abc import Sequence

from ..base import Model


class AlarmValue(Model, frozen=True):
    """An evaluated value with its time and its batch."""

    value: float
    time: str
    batch_id: str | None


class AlarmRaised(AlarmValue, frozen=True):
    """The value that raised an alarm, and the bound that it passed."""

    at: str
    bound: float


class Acted(Model, frozen=True):
    """The author and the time of an action."""

    at: str
    who: str


class Shelved(Acted, frozen=True):
    """Shelved until a time."""

    until: str


class Alarm(Model, frozen=True, kw_only=True):
    """An alarm.  It stays until it is acknowledged and its quantity is back in limits.

    `severity` is the worst so far; `current_severity` is None while the value is in limits.
    `tracker` is None for the spacecraft as a whole.
    """

    id: str
    spacecraft: str
    run: str
    quantity: str
    tracker: str | None = None
    unit: str
    state: str
    severity: str
    current_severity: str | None
    in_limits: bool
    raised: AlarmRaised
    worst: AlarmValue
    latest: AlarmValue
    returned_at: str | None
    acknowledged: Acted | None
    shelved: Shelved | None
    cleared_at: str | None


class AlarmAction(Model, frozen=True):
    """A change of an alarm, by its value or by a person."""

    at: str
    action: str
    who: str | None
    comment: str | None
    severity: str | None
    value: float | None
    time: str | None


class AlarmWithActions(Alarm, frozen=True, kw_only=True):
    """An alarm with its history, oldest first."""

    actions: Sequence[AlarmAction]
