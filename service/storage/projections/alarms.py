"""Evaluating limits against batches in the order of the record, each batch exactly once.

The evaluation is part of the transaction that moves the projector on: after a crash either
both are stored or neither.  The row in `watches` is locked, so that several
processes evaluate one after the other.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence

import msgspec
from msgspec import Struct
from sqlalchemy import Connection, bindparam, select, update

from service.alarms.limits import LimitSettings
from service.alarms.quantities import SILENCE
from service.alarms.subjects import Subject, sampler
from service.alarms.window import BatchRef, Point, Sample, SampleWindow
from service.missions.mission import Mission
from service.storage.projections.active_alarms import ActiveAlarms
from service.storage.projections.recorded import RecordedResult
from service.storage.projections.silence import silence_severity
from service.storage.queries.limits import limits_of
from service.storage.recording.unsaved_result import LIVE
from service.storage.sql.alarm_tables import watches
from service.storage.sql.columns import Row
from service.storage.sql.statements import insert_missing, prepared
from service.storage.sql.tables import batches, missions, results, runs
from service.times import recorded_utc

# Run with every batch of a live spacecraft, or with a few of them.
_PLACE = (
    watches.c.spacecraft == bindparam("of_spacecraft"),
    watches.c.run == bindparam("of_run"),
)
_LOCK = prepared(select(watches).where(*_PLACE).with_for_update())
_COLUMNS = ("time", "time_ns", "batch_id", "received", "state")
_SAVE = prepared(
    update(watches).where(*_PLACE).values({name: bindparam(name) for name in _COLUMNS})
)


def apply(connection: Connection, new: Sequence[RecordedResult]) -> None:
    """Evaluate the limits against new batches of the live run and of runs with alarms."""
    groups: dict[tuple[str, str], list[RecordedResult]] = {}
    for each in new:
        if each.is_first and not each.is_ahead:
            groups.setdefault(each.owner, []).append(each)
    evaluated = runs_with_alarms(connection, {run for run, _ in groups})
    for run, spacecraft in sorted(groups):
        if run in evaluated:
            LimitEvaluator(connection, spacecraft, run, groups[run, spacecraft]).evaluate()


def runs_with_alarms(connection: Connection, names: set[str]) -> set[str]:
    """Those of some runs whose limits are evaluated: the live one, and others that ask for it."""
    others = names - {LIVE}
    if not others:
        return names
    query = select(runs.c.name).where(runs.c.name.in_(sorted(others)), runs.c.alarms)
    return set(connection.scalars(query)) | (names & {LIVE})


def latest_inputs(connection: Connection, spacecraft: Collection[str]) -> Sequence[str]:
    """The latest live batch of each of these spacecraft, as it was sent."""
    query = select(batches.c.input).join_from(watches, batches, watches.c.batch_id == batches.c.id)
    chosen = watches.c.run == LIVE, watches.c.spacecraft.in_(spacecraft)
    return connection.scalars(query.where(*chosen)).all()


class LimitEvaluator:
    """Evaluates new batches of one spacecraft in one run; its row in `watches` is locked."""

    def __init__(
        self, connection: Connection, spacecraft: str, run: str, new: Sequence[RecordedResult]
    ) -> None:
        self._connection = connection
        self._spacecraft, self._run = spacecraft, run
        self._new = new
        self._limits = limits_of(connection, _mission(connection, new[0]))
        row = self._locked()
        if row is None:
            first = {"spacecraft": spacecraft, "run": run, "state": "{}"}
            insert_missing(connection, watches, [first | _columns_of(new[0].result)])
            row = self._locked()
        assert row is not None
        self._row = row
        saved = _LAST_SAVED.pop((spacecraft, run), _NOTHING_SAVED)
        self._windows = saved.windows_of(row["state"])
        self._active = ActiveAlarms(connection, spacecraft, run)

    def evaluate(self) -> None:
        """Evaluate every batch in the order of the record and save the state of the windows."""
        due = self._due()
        row, newest = self._row, None
        latest_ns, received = row["time_ns"], row["received"]
        received_ns = recorded_utc(received).tai_ns
        for each in self._new:
            batch = each.result
            gap_ns = batch["time_ns"] - latest_ns
            if gap_ns >= 0:
                newest, latest_ns = batch, batch["time_ns"]
            # In another run an older batch that comes late ends no silence.
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

        The gap is measured by the clock for live batches, elsewhere by the
        batches' own times.  `latest` is the latest batch: this one, unless it
        comes late.
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
        """The subjects that need an evaluation batch by batch; the others are done here.

        Most quantities are in limits all the time, and evaluating each batch by
        itself takes as long as recording it.  An alarm that is back in limits
        needs the latest value alone: of those before it nothing would be stored.
        """
        due = []
        for name, limits in self._limits.items():
            samples = list(filter(None, self._samples(name, self._new)))
            if not samples:
                continue
            window = self._windows.setdefault(name, SampleWindow())
            if self._active.is_out(name) or not window.add_if_within(samples, limits):
                due.append((name, limits))
            elif self._active.has(name) and (value := window.value(limits)) is not None:
                batch = self._latest_with(name)
                point = Point(value, *self._latest_in_window(batch, window.samples[-1][0]))
                self._active.observe(name, None, limits, point, batch["received"])
        return due

    def _latest_with(self, name: Subject) -> Row:
        """The latest new batch that has a value of a subject."""
        latest_first = sorted(self._new, key=lambda each: -each.result["time_ns"])
        samples = self._samples(name, latest_first)
        return next(
            each.result for each, sample in zip(latest_first, samples, strict=True) if sample
        )

    @staticmethod
    def _samples(subject: Subject, new: Sequence[RecordedResult]) -> Iterator[Sample | None]:
        """What each of the results adds to the value of a subject; None: nothing."""
        sample_of = sampler(subject)
        for each in new:
            trackers = each.trackers and _by_tracker(each)
            yield sample_of(each.result, trackers or {})

    def _latest_in_window(self, batch: Row, latest_ns: int) -> BatchRef:
        """The latest batch of a window: the one given, unless it comes late."""
        if batch["time_ns"] >= latest_ns:
            return _reference(batch)
        query = (
            select(batches.c.time, batches.c.id)
            .join_from(results, batches, results.c.batch_id == batches.c.id)
            .where(
                results.c.spacecraft == batch["spacecraft"],
                results.c.run == batch["run"],
                results.c.time_ns == latest_ns,
                results.c.current,
            )
            .order_by(batches.c.id.desc())
            .limit(1)
        )
        found = self._connection.execute(query).first()
        # It may have been pruned.
        return (found[0], found[1]) if found else _reference(batch)

    def _evaluate_batch(
        self, new: RecordedResult, due: Sequence[tuple[Subject, LimitSettings]]
    ) -> None:
        for name, limits in due:
            (sample,) = self._samples(name, [new])
            if sample is None:
                continue
            window = self._windows[name]
            latest_ns = window.samples[-1][0] if window.samples else 0
            latest = self._latest_in_window(new.result, latest_ns)
            found = window.add(sample, limits, latest)
            if found and (found.severity is not None or self._active.has(name)):
                point = Point(found.value, *latest)
                now = new.result["received"]
                self._active.observe(name, found.severity, limits, point, now, found.worst)

    def _locked(self) -> Row | None:
        place = {"of_spacecraft": self._spacecraft, "of_run": self._run}
        return next(iter(_LOCK.read(self._connection, place)), None)

    def _save(self, newest: Row | None, received: str) -> None:
        windows = {name: window.to_json() for name, window in self._windows.items()}
        state = msgspec.json.encode(windows).decode()
        row = self._row | (_columns_of(newest) if newest else {})
        row |= {"received": received, "state": state}
        place = {"of_spacecraft": self._spacecraft, "of_run": self._run}
        _SAVE.run(self._connection, [place | {name: row[name] for name in _COLUMNS}])
        if len(_LAST_SAVED) >= _MAX_SAVED:
            _LAST_SAVED.clear()
        _LAST_SAVED[self._spacecraft, self._run] = _SavedWindows(state, self._windows)


class _SavedWindows(Struct):
    """The windows of one spacecraft and run as this process last wrote them.

    Where the database still holds the same text, it is not decoded again.
    """

    state: str
    windows: dict[str, SampleWindow]

    def windows_of(self, state: str) -> dict[str, SampleWindow]:
        """The windows that a stored text holds."""
        if self.state == state:
            return self.windows
        stored = msgspec.json.decode(state)
        return {name: SampleWindow.from_json(each) for name, each in stored.items()}


_NOTHING_SAVED = _SavedWindows("", {})
_LAST_SAVED: dict[tuple[str, str], _SavedWindows] = {}
_MAX_SAVED = 64


def _by_tracker(new: RecordedResult) -> Mapping[str, Row]:
    """The values of each tracker of a result as those of a result of its own."""
    time_ns = {"time_ns": new.result["time_ns"]}
    return {row["tracker"]: row | time_ns for row in new.trackers}


def _mission(connection: Connection, new: RecordedResult) -> Mission:
    """The mission that a result was computed with; what a digest stands for never changes."""
    digest = new.result["mission_digest"]
    mission = _MISSIONS.get(digest)
    if mission is None:
        query = select(missions.c.settings).where(missions.c.digest == digest)
        mission = Mission.model_validate_json(connection.execute(query).scalar_one())
        if len(_MISSIONS) >= _MAX_SAVED:
            _MISSIONS.clear()
        _MISSIONS[digest] = mission
    return mission


_MISSIONS: dict[str, Mission] = {}


def _columns_of(batch: Row) -> Row:
    names = {"time": "time", "time_ns": "time_ns", "batch_id": "id", "received": "received"}
    return {name: batch[column] for name, column in names.items()}


def _reference(batch: Row) -> BatchRef:
    return batch["time"], batch["id"]
