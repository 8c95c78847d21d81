"""Evaluation of limits: against batches in the order of recording, and against the clock.

The evaluation is part of the transaction that advances the projector: after a crash either both are
stored or neither.  The row in `watches` is locked, so that several processes evaluate one after the
other.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec
from sqlalchemy import Connection, bindparam, insert, select, update

from service.features.alarms import state_machine
from service.features.alarms.state import change, limits_of
from service.features.alarms.tables import alarms, watches
from service.features.alarms.windows import BatchRef, Point, SampleWindow
from service.missions.mission import Mission
from service.observations.schema import LIVE
from service.storage.projections.rollups import RecordedResult
from service.storage.queries.pages import ResultFilter, newest
from service.storage.queries.results import recorded_mission
from service.storage.recording.ids import Ulids
from service.storage.recording.results import runs_with_alarms
from service.storage.sql.columns import Row
from service.storage.sql.statements import insert_missing, prepared
from service.storage.sql.tables import batches, results
from service.times import Utc, recorded_utc, utc_now
from service.trends.limits import LimitSettings, Sample, Severity
from service.trends.quantities import SILENCE, Subject, quantity_and_tracker, sampler, subject_of

# This query runs with every batch of a live spacecraft, or with a few of them.
_PLACE = (watches.c.spacecraft == bindparam("of_spacecraft"), watches.c.run == bindparam("of_run"))
_LOCK = prepared(select(watches).where(*_PLACE).with_for_update())
_COLUMNS = ("time", "time_ns", "batch_id", "received", "state")
_SAVE = prepared(
    update(watches).where(*_PLACE).values({name: bindparam(name) for name in _COLUMNS})
)


def wants(connection: Connection, run: str) -> bool:
    """True if limits are evaluated for the batches of a run."""
    return bool(runs_with_alarms(connection, {run}))


def apply(connection: Connection, new: Sequence[RecordedResult]) -> None:
    """Evaluate limits against newly recorded batches of the live run and other runs with alarms."""
    groups: dict[tuple[str, str], list[RecordedResult]] = {}
    for each in new:
        if each.is_first and not each.is_ahead:
            groups.setdefault(each.owner, []).append(each)
    evaluated = runs_with_alarms(connection, {run for run, _ in groups})
    for run, spacecraft in sorted(groups):
        if run in evaluated:
            LimitEvaluator(connection, spacecraft, run, groups[run, spacecraft]).evaluate()


class LimitEvaluator:
    """Evaluates limits against new batches of a spacecraft and run; locks its row in `watches`."""

    def __init__(
        self, connection: Connection, spacecraft: str, run: str, new: Sequence[RecordedResult]
    ) -> None:
        self._connection = connection
        self._spacecraft, self._run = spacecraft, run
        self._new = new
        self._latest: dict[Subject, tuple[int, BatchRef]] = {}
        """Time and reference of the latest batch in a subject's sample window, as far as known."""
        self._earlier: dict[int, BatchRef | None] = {}
        mission = recorded_mission(connection, new[0].result["mission_digest"])
        self._limits = limits_of(connection, mission)
        row = _locked(connection, spacecraft, run)
        if row is None:
            first = {"spacecraft": spacecraft, "run": run, "state": "{}"}
            insert_missing(connection, watches, [first | _columns_of(new[0].result)])
            row = _locked(connection, spacecraft, run)
        assert row is not None
        self._row = row
        state, self._windows = _LAST_SAVED.pop((spacecraft, run), ("", {}))
        if state != row["state"]:
            stored = msgspec.json.decode(row["state"])
            self._windows = {name: SampleWindow.from_json(each) for name, each in stored.items()}
        self._active = ActiveAlarms(connection, spacecraft, run)

    def evaluate(self) -> None:
        """Evaluate all new batches in the order of recording, and save the sample windows."""
        due = self._due()
        row, newest = self._row, None
        latest_ns, received = row["time_ns"], row["received"]
        received_ns = recorded_utc(received).tai_ns
        first = self._new[0]
        if self._run == LIVE and silence_severity(
            self._limits, (first.received_ns - received_ns) * 1e-9
        ):
            received = _last_received(
                self._connection, row, batches.c.received < first.result["received"]
            )
            received_ns = recorded_utc(received).tai_ns
        for each in self._new:
            batch = each.result
            gap_ns = batch["time_ns"] - latest_ns
            if gap_ns >= 0:
                newest, latest_ns = batch, batch["time_ns"]
            # Outside the live run a late, older batch ends no silence.
            if self._run == LIVE or gap_ns >= 0:
                since_ns = each.received_ns - received_ns if self._run == LIVE else gap_ns
                latest = _reference(newest) if newest else (row["time"], row["batch_id"])
                self._check_silence(since_ns * 1e-9, latest, batch["received"])
            if due:
                self._evaluate_batch(each, due)
            if each.received_ns > received_ns:
                received, received_ns = batch["received"], each.received_ns
        self._save(newest, received)
        self._active.save()

    def _check_silence(self, gap_s: float, latest: BatchRef, now: str) -> None:
        """Raise an alarm for the silence before a batch, and end it with the batch.

        The gap is measured by the clock for live batches, in other runs by the times of the
        batches.  `latest` is the latest batch: the new one, unless it comes late.
        """
        limits = self._limits[SILENCE]
        low_s, high_s = limits.inner_bounds
        if low_s <= gap_s <= high_s and not self._active.has(SILENCE):
            return
        severity = silence_severity(self._limits, gap_s)
        if severity is not None:
            self._active.observe(SILENCE, severity, limits, Point(gap_s, *latest), now)
        if self._active.has(SILENCE):
            self._active.observe(SILENCE, None, limits, Point(0.0, *latest), now)

    def _due(self) -> list[tuple[Subject, LimitSettings]]:
        """Subjects to be evaluated batch by batch, with their limits; evaluates all others at once.

        Most quantities stay in limits, and evaluating every batch by itself takes as long as
        recording it.  An alarm that is back in limits needs only the latest value: nothing is
        stored of earlier ones.
        """
        due = []
        for name, limits in self._limits.items():
            every = list(self._samples(name, self._new))
            samples = list(filter(None, every))
            if not samples:
                continue
            window = self._windows.setdefault(name, SampleWindow())
            if self._active.is_out(name) or not window.add_if_within(samples, limits):
                due.append((name, limits))
            elif self._active.has(name) and (value := window.value(limits)) is not None:
                present = [each.result for each, one in zip(self._new, every, strict=True) if one]
                latest_ns = window.samples[-1][0]
                for batch in present:
                    if batch["time_ns"] >= latest_ns:
                        self._latest[name] = batch["time_ns"], _reference(batch)
                point = Point(value, *self._latest_in_window(name, present[-1], latest_ns))
                self._active.observe(name, None, limits, point, present[-1]["received"])
        return due

    @staticmethod
    def _samples(subject: Subject, new: Sequence[RecordedResult]) -> Iterator[Sample | None]:
        """Contribution of each result to the value of a monitored subject; None if it has none."""
        sample_of = sampler(subject)
        for each in new:
            trackers = each.trackers and _by_tracker(each)
            yield sample_of(each.result, trackers or {})

    def _latest_in_window(self, subject: Subject, batch: Row, latest_ns: int) -> BatchRef:
        """Latest batch in the sample window of a subject: the new batch, unless it comes late."""
        if batch["time_ns"] >= latest_ns:
            self._latest[subject] = batch["time_ns"], _reference(batch)
            return _reference(batch)
        known_ns, known = self._latest.get(subject, (None, None))
        if known is None or known_ns != latest_ns:
            # The latest batch was recorded before the new ones, or has been pruned since.
            known = self._recorded_at(latest_ns) or _reference(batch)
            self._latest[subject] = latest_ns, known
        return known

    def _recorded_at(self, time_ns: int) -> BatchRef | None:
        """Last batch of a given time that was recorded before the new batches; cached."""
        if time_ns not in self._earlier:
            query = (
                select(batches.c.time, batches.c.id)
                .join_from(results, batches, results.c.batch_id == batches.c.id)
                .where(
                    results.c.spacecraft == self._spacecraft,
                    results.c.run == self._run,
                    results.c.time_ns == time_ns,
                    results.c.current,
                    results.c.seq < self._new[0].seq,
                )
                .order_by(results.c.seq.desc())
                .limit(1)
            )
            found = self._connection.execute(query).first()
            self._earlier[time_ns] = (found[0], found[1]) if found else None
        return self._earlier[time_ns]

    def _evaluate_batch(
        self, new: RecordedResult, due: Sequence[tuple[Subject, LimitSettings]]
    ) -> None:
        for name, limits in due:
            (sample,) = self._samples(name, [new])
            if sample is None:
                continue
            window = self._windows[name]
            latest_ns = window.samples[-1][0] if window.samples else new.result["time_ns"]
            latest = self._latest_in_window(name, new.result, latest_ns)
            found = window.add(sample, limits, latest)
            if found and (found.severity is not None or self._active.has(name)):
                point = Point(found.value, *latest)
                now = new.result["received"]
                self._active.observe(name, found.severity, limits, point, now, found.worst)

    def _save(self, newest: Row | None, received: str) -> None:
        windows = {name: window.to_json() for name, window in self._windows.items()}
        state = msgspec.json.encode(windows).decode()
        row = self._row | (_columns_of(newest) if newest else {})
        row |= {"received": received, "state": state}
        place = {"of_spacecraft": self._spacecraft, "of_run": self._run}
        _SAVE.run(self._connection, [place | {name: row[name] for name in _COLUMNS}])
        if len(_LAST_SAVED) >= _MAX_SAVED:
            _LAST_SAVED.clear()
        _LAST_SAVED[self._spacecraft, self._run] = state, self._windows


# Windows of a spacecraft and run with their text as last written by this process: if the database
# still has this text, it is not decoded again.
_LAST_SAVED: dict[tuple[str, str], tuple[str, dict[str, SampleWindow]]] = {}
_MAX_SAVED = 64


def _by_tracker(new: RecordedResult) -> Mapping[str, Row]:
    """Values of each tracker in a result, as rows with the time of the result."""
    time_ns = {"time_ns": new.result["time_ns"]}
    return {row["tracker"]: row | time_ns for row in new.trackers}


def _columns_of(batch: Row) -> Row:
    names = {"time": "time", "time_ns": "time_ns", "batch_id": "id", "received": "received"}
    return {name: batch[column] for name, column in names.items()}


def _reference(batch: Row) -> BatchRef:
    return batch["time"], batch["id"]


def silence_severity(limits: Mapping[Subject, LimitSettings], gap_s: float) -> Severity | None:
    """Highest severity whose limit a gap between batches exceeds; None within limits."""
    exceeded = limits[SILENCE].severities_out(gap_s)
    return exceeded[-1] if exceeded else None


def evaluate_by_clock(connection: Connection, missions: Mapping[str, Mission], now: Utc) -> None:
    """Raise alarms of live spacecraft that are silent, and end expired shelving."""
    for spacecraft in sorted(_silent(connection, missions, now)):
        row = _locked(connection, spacecraft, LIVE)
        if row is None:
            continue
        active = ActiveAlarms(connection, spacecraft, LIVE)
        gap_s = _seconds(_last_received(connection, row), now)
        limits = limits_of(connection, missions[spacecraft])
        severity = silence_severity(limits, gap_s)
        if severity is not None:
            point = Point(gap_s, row["time"], row["batch_id"])
            active.observe(SILENCE, severity, limits[SILENCE], point, now.text)
            active.save()
    expired = connection.execute(_expired(now).with_for_update()).mappings().all()
    for alarm in map(dict, expired):
        changes, actions = state_machine.expired(alarm, now.text)
        change(connection, alarm, changes, actions, now.text)


def is_due_by_clock(connection: Connection, missions: Mapping[str, Mission], now: Utc) -> bool:
    """True if an alarm of silence or an expired shelving is due; reads only."""
    if connection.execute(_expired(now).limit(1)).first() is not None:
        return True
    return bool(_silent(connection, missions, now))


def _silent(connection: Connection, missions: Mapping[str, Mission], now: Utc) -> set[str]:
    """Live spacecraft whose silence is more severe than their alarm states."""
    found = set()
    query = select(watches.c.spacecraft, watches.c.received).where(watches.c.run == LIVE)
    for row in connection.execute(query).mappings():
        spacecraft = row["spacecraft"]
        mission = missions.get(spacecraft)
        if mission is None:
            continue
        limits = limits_of(connection, mission)
        severity = silence_severity(limits, _seconds(row["received"], now))
        if severity is None:
            continue
        noted = select(alarms.c.current_severity).where(
            alarms.c.run == LIVE,
            alarms.c.spacecraft == spacecraft,
            alarms.c.quantity == SILENCE,
            alarms.c.cleared_at.is_(None),
        )
        if connection.execute(noted).scalar() == severity.word:
            continue
        if silence_severity(limits, _seconds(_last_received(connection, row), now)) is not None:
            found.add(spacecraft)
    return found


def _last_received(connection: Connection, watch: Mapping[Any, Any], *before: Any) -> str:
    """Arrival time of the last live batch of a spacecraft, evaluated against limits or only
    recorded.

    Batches that arrived while alarms were off are recorded, but were not evaluated.
    """
    query = select(batches.c.received).join_from(
        results, batches, results.c.batch_id == batches.c.id
    )
    selected = ResultFilter(LIVE, watch["spacecraft"])
    row = newest(connection, query.where(*before), selected, utc_now())
    evaluated = str(watch["received"])
    if row is None or recorded_utc(row["received"]).tai_ns < recorded_utc(evaluated).tai_ns:
        return evaluated
    return str(row["received"])


def _locked(connection: Connection, spacecraft: str, run: str) -> Row | None:
    place = {"of_spacecraft": spacecraft, "of_run": run}
    return next(iter(_LOCK.read(connection, place)), None)


def _expired(now: Utc) -> Any:
    return (
        select(alarms)
        .where(alarms.c.cleared_at.is_(None), alarms.c.shelved_until <= now.text)
        .order_by(alarms.c.id)
    )


def _seconds(received: str, now: Utc) -> float:
    return (now.tai_ns - recorded_utc(received).tai_ns) * 1e-9


_IDS = Ulids()

# This query runs with every batch of a live spacecraft.
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
"""Columns of an alarm that a new value may change without a recorded action."""
_UPDATE_VALUES = prepared(
    update(alarms)
    .where(alarms.c.id == bindparam("of_id"))
    .values({name: bindparam(name) for name in _VALUES})
)


class ActiveAlarms:
    """Uncleared alarms of a spacecraft and run by subject; rows are locked until commit."""

    def __init__(self, connection: Connection, spacecraft: str, run: str) -> None:
        self._connection = connection
        self._place = {"spacecraft": spacecraft, "run": run}
        rows = _ACTIVE.read(connection, {"of_spacecraft": spacecraft, "of_run": run})
        self._alarms: dict[Subject, Row] = {
            subject_of(row["quantity"], row["tracker"]): row for row in rows
        }
        self._unsaved: set[Subject] = set()

    def has(self, subject: Subject) -> bool:
        """True if a quantity, of a tracker or of the spacecraft, has an alarm not yet cleared."""
        return subject in self._alarms

    def is_out(self, subject: Subject) -> bool:
        """True if a quantity has an alarm not yet cleared, and is out of limits now."""
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
        """Apply a new value to the alarm of a subject; raise an alarm if needed."""
        alarm = self._alarms.get(subject)
        if alarm is None:
            if severity is not None:
                columns, actions = state_machine.raised(severity, limits, point, now, worst)
                quantity, tracker = quantity_and_tracker(subject)
                what = {"quantity": quantity, "tracker": tracker}
                alarm = {"id": _IDS.new(), **what, **self._place, **columns}
                self._connection.execute(insert(alarms), alarm)
                change(self._connection, alarm, {}, actions, now)
                self._alarms[subject] = alarm
            return
        changes, actions = state_machine.observed(alarm, severity, limits, point, now, worst)
        if actions:
            # Pending changes of the alarm are written together with it.
            values = {name: alarm[name] for name in _VALUES}
            alarm = change(self._connection, alarm, values | changes, actions, now)
            self._unsaved.discard(subject)
        else:
            # Changed values without a change of state are written once, by `save`.
            alarm = alarm | changes
            self._unsaved.add(subject)
        self._alarms[subject] = alarm
        if alarm["cleared_at"] is not None:
            del self._alarms[subject]

    def save(self) -> None:
        """Write the latest values of alarms that changed in nothing else."""
        if self._unsaved:
            found = [self._alarms[subject] for subject in sorted(self._unsaved)]
            rows = [
                {name: alarm[name] for name in _VALUES} | {"of_id": alarm["id"]} for alarm in found
            ]
            _UPDATE_VALUES.run(self._connection, rows)
            self._unsaved.clear()
