"""The active alarms of one spacecraft in one run, read, changed and written in one transaction."""

from sqlalchemy import Connection, bindparam, insert, select, update

from service.alarms import state_machine
from service.alarms.limits import LimitSettings, Severity
from service.alarms.subjects import Subject, quantity_and_tracker, subject_of
from service.alarms.window import Point
from service.storage.queries.alarms import change, record_action
from service.storage.recording.ids import Ulids
from service.storage.sql.alarm_tables import alarms
from service.storage.sql.columns import Row
from service.storage.sql.statements import prepared

_IDS = Ulids()

# Run with every batch of a live spacecraft.
_ACTIVE = prepared(
    select(alarms)
    .where(
        alarms.c.run == bindparam("of_run"),
        alarms.c.spacecraft == bindparam("of_spacecraft"),
        alarms.c.cleared_at.is_(None),
    )
    .order_by(alarms.c.id)
    .with_for_update()
)
_VALUES = (
    *(f"{which}_{part}" for which in ("latest", "worst") for part in ("value", "time", "batch_id")),
    "current_severity",
    "returned_at",
)
"""The columns that a new value can change without an action to note."""
_UPDATE_VALUES = prepared(
    update(alarms)
    .where(alarms.c.id == bindparam("of_id"))
    .values({name: bindparam(name) for name in _VALUES})
)


class ActiveAlarms:
    """The alarms that are not cleared, by subject; their rows stay locked until the commit."""

    def __init__(self, connection: Connection, spacecraft: str, run: str) -> None:
        self._connection = connection
        self._place = {"spacecraft": spacecraft, "run": run}
        rows = _ACTIVE.read(connection, {"of_spacecraft": spacecraft, "of_run": run})
        self._alarms: dict[Subject, Row] = {
            subject_of(row["quantity"], row["tracker"]): row for row in rows
        }
        self._unsaved: set[Subject] = set()

    def has(self, subject: Subject) -> bool:
        """Whether a subject has an active alarm."""
        return subject in self._alarms

    def is_out(self, subject: Subject) -> bool:
        """Whether a subject has an active alarm and is out of limits."""
        return self.has(subject) and self._alarms[subject]["current_severity"] is not None

    def observe(
        self,
        subject: Subject,
        severity: Severity | None,
        limits: LimitSettings,
        point: Point,
        now: str,
        worst: Point | None = None,
    ) -> None:
        """Apply a new value to the subject's alarm, or raise an alarm if it has none."""
        alarm = self._alarms.get(subject)
        if alarm is None:
            if severity is not None:
                columns, actions = state_machine.raised(severity, limits, point, now, worst)
                quantity, tracker = quantity_and_tracker(subject)
                what = {"quantity": quantity, "tracker": tracker}
                alarm = {"id": _IDS.new(), **what, **self._place, **columns}
                self._connection.execute(insert(alarms), alarm)
                record_action(self._connection, alarm, actions, now)
                self._alarms[subject] = alarm
            return
        changes, actions = state_machine.observed(alarm, severity, limits, point, now, worst)
        if actions:
            # The changes that were not written yet go with it.
            values = {name: alarm[name] for name in _VALUES}
            alarm = change(self._connection, alarm, values | changes, actions, now)
            self._unsaved.discard(subject)
        else:
            # Values alone are written once, by `save`.
            alarm = alarm | changes
            self._unsaved.add(subject)
        self._alarms[subject] = alarm
        if alarm["cleared_at"] is not None:
            del self._alarms[subject]

    def save(self) -> None:
        """Write the latest values of the alarms that did not change otherwise."""
        if self._unsaved:
            found = [self._alarms[subject] for subject in sorted(self._unsaved)]
            rows = [
                {name: alarm[name] for name in _VALUES} | {"of_id": alarm["id"]} for alarm in found
            ]
            _UPDATE_VALUES.run(self._connection, rows)
            self._unsaved.clear()
