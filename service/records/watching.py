"""Holding limits against batches as they are recorded, each exactly once.

It is part of the transaction that records them: a batch that is sent again is
not new and is not looked at again, and after a crash either both are there or
neither.  The row of a watch is locked, so that of several processes one after
the other looks.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec
from msgspec import Struct
from sqlalchemy import Connection, bindparam, insert, select, update

from service.alarms import latch
from service.alarms.limits import LimitSettings, Severity
from service.alarms.quantities import QUANTITIES, QuantityName
from service.alarms.window import Moment, Point, Sample, Window
from service.missions.mission import Mission
from service.records.ahead import LIVE
from service.records.alarms import change, note
from service.records.draft import Draft, Row
from service.records.ids import Ulids
from service.records.limits import limits_of
from service.records.measures import VALUE_OF
from service.records.prepared import prepared
from service.records.statements import insert_missing
from service.records.tables import alarms, batches, missions, results, runs, watches
from service.times import Utc, recorded_utc, shifted

_IDS = Ulids()
SILENCE: QuantityName = "silence_s"

# Each is run with every batch of a live spacecraft, or with a few of them.
_PLACE = (
    watches.c.spacecraft == bindparam("of_spacecraft"),
    watches.c.run == bindparam("of_run"),
)
_LOCKED = prepared(select(watches).where(*_PLACE).with_for_update())
_KEPT = ("time", "time_ns", "batch_id", "received", "state")
_KEEP = prepared(update(watches).where(*_PLACE).values({name: bindparam(name) for name in _KEPT}))
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
# What an active alarm that meets a value changes without anything to note.
_MET = (
    *(f"{which}_{part}" for which in ("latest", "worst") for part in ("value", "time", "batch_id")),
    "current_severity",
    "returned_at",
)
_MEET = prepared(
    update(alarms)
    .where(alarms.c.id == bindparam("of_id"))
    .values({name: bindparam(name) for name in _MET})
)


def watch(connection: Connection, new: Sequence[Draft]) -> None:
    """Hold the limits against new batches of live and of the runs that ask for it."""
    groups: dict[tuple[str, str], list[Draft]] = {}
    for draft in new:
        spacecraft, run, _ = draft.identity
        if draft.batch is not None and not draft.is_ahead:
            groups.setdefault((run, spacecraft), []).append(draft)
    watched = _watched(connection, {run for run, _ in groups})
    for run, spacecraft in sorted(groups):
        if run in watched:
            drafts = sorted(groups[run, spacecraft], key=lambda each: each.result["time_ns"])
            _Watch(connection, spacecraft, run, drafts).look()


def _watched(connection: Connection, names: set[str]) -> set[str]:
    asked = names - {LIVE}
    if not asked:
        return names
    query = select(runs.c.name).where(runs.c.name.in_(sorted(asked)), runs.c.alarms)
    return set(connection.scalars(query)) | (names & {LIVE})


def latest_inputs(connection: Connection) -> Sequence[str]:
    """The latest batch of every live spacecraft, as it was sent."""
    query = select(batches.c.input).join_from(watches, batches, watches.c.batch_id == batches.c.id)
    return connection.scalars(query.where(watches.c.run == LIVE)).all()


class _Watch:
    """What is watched of one spacecraft in one run, its row locked."""

    def __init__(
        self, connection: Connection, spacecraft: str, run: str, drafts: Sequence[Draft]
    ) -> None:
        self._connection = connection
        self._run = run
        self._drafts = drafts
        self._limits = limits_of(connection, _mission(connection, drafts[0]))
        first = drafts[0]
        assert first.batch is not None
        fresh = {
            "spacecraft": spacecraft,
            "run": run,
            **_latest_of(first.batch),
            "state": "{}",
        }
        self._row = _locked(connection, spacecraft, run)
        if self._row is None:
            insert_missing(connection, watches, [fresh])
            self._row = _locked(connection, spacecraft, run)
        assert self._row is not None
        self._seen = _LATEST.pop((spacecraft, run), _NOTHING_SEEN)
        self._windows = self._seen.windows_of(self._row["state"])
        self._board = Board(connection, spacecraft, run)

    def look(self) -> None:
        """Look at every batch in order of time, and keep what was found."""
        assert self._row is not None
        alert = self._alert()
        row, newest = self._row, None
        latest_ns, received = row["time_ns"], row["received"]
        received_ns = self._seen.ns_of(received)
        for draft in self._drafts:
            batch = draft.batch
            assert batch is not None
            gap_ns = batch["time_ns"] - latest_ns
            if gap_ns >= 0:
                newest, latest_ns = batch, batch["time_ns"]
            # In a run an older batch that comes late follows upon none.
            if self._run == LIVE or gap_ns >= 0:
                since_ns = draft.received_ns - received_ns if self._run == LIVE else gap_ns
                moment = _moment(newest) if newest else (row["time"], row["batch_id"])
                self._mind_the_gap(since_ns * 1e-9, moment, batch["received"])
            if alert:
                self._judge(draft, alert)
            if draft.received_ns > received_ns:
                received, received_ns = batch["received"], draft.received_ns
        latest = row | (_latest_of(newest) if newest else {}) | {"received": received}
        kept = {name: window.to_json() for name, window in self._windows.items()}
        latest["state"] = msgspec.json.encode(kept).decode()
        seen = _Seen(latest["state"], self._windows, received, received_ns)
        _remember(latest["spacecraft"], self._run, seen)
        place = {"of_spacecraft": latest["spacecraft"], "of_run": self._run}
        _KEEP.run(self._connection, [place | {name: latest[name] for name in _KEPT}])
        self._board.save()

    def _mind_the_gap(self, gap_s: float, latest: Moment, now: str) -> None:
        """Silence: live by the clock, elsewhere by the batches' own time; over with this batch.

        `latest` is the latest batch, which this one is if it does not come late.
        """
        low_s, high_s = self._limits[SILENCE].calm
        if low_s <= gap_s <= high_s and not self._board.has(SILENCE):
            return
        limits = self._limits[SILENCE]
        severity = silence(self._limits, gap_s)
        if severity is not None:
            self._board.observe(SILENCE, severity, limits, Point(gap_s, *latest), now)
        if self._board.has(SILENCE):
            self._board.observe(SILENCE, None, limits, Point(0.0, *latest), now)

    def _alert(self) -> list[tuple[QuantityName, LimitSettings]]:
        """The quantities that a batch may bring out of limits or back; the others are done with.

        Most are in limits all the time, and judging each batch by itself takes
        as long as recording it.  An alarm that is back in limits meets the latest
        value alone: of those before it nothing would be kept.
        """
        alert = []
        new = [draft.result for draft in self._drafts]
        for name, limits in self._limits.items():
            sample_of = _SAMPLE_OF[name]
            samples = [sample for each in new if (sample := sample_of(each))]
            if not samples:
                continue
            window = self._windows.setdefault(name, Window())
            if self._board.is_out(name) or not window.pass_over(samples, limits):
                alert.append((name, limits))
            elif self._board.has(name) and (value := window.value(limits)) is not None:
                batch = self._latest_with(name)
                point = Point(value, *self._latest_moment(batch, window.samples[-1][0]))
                self._board.observe(name, None, limits, point, batch["received"])
        return alert

    def _latest_with(self, name: QuantityName) -> Row:
        """The latest batch that has a value of a quantity."""
        sample_of = _SAMPLE_OF[name]
        return next(
            draft.batch
            for draft in reversed(self._drafts)
            if draft.batch and sample_of(draft.result)
        )

    def _latest_moment(self, batch: Row, latest_ns: int) -> Moment:
        """The moment of the latest batch of a window: of this one, unless it comes late."""
        if batch["time_ns"] >= latest_ns:
            return _moment(batch)
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
        return (found[0], found[1]) if found else _moment(batch)

    def _judge(self, draft: Draft, alert: Sequence[tuple[QuantityName, LimitSettings]]) -> None:
        assert draft.batch is not None
        for name, limits in alert:
            sample = _SAMPLE_OF[name](draft.result)
            if sample is None:
                continue
            window = self._windows[name]
            latest_ns = window.samples[-1][0] if window.samples else 0
            moment = self._latest_moment(draft.batch, latest_ns)
            judged = window.add(sample, limits, moment)
            if judged and (judged.severity is not None or self._board.has(name)):
                point = Point(judged.value, *moment)
                now = draft.batch["received"]
                self._board.observe(name, judged.severity, limits, point, now, judged.worst)


class _Seen(Struct):
    """A watch as this process last wrote it.

    Where that is still what is kept, it need not be made of its text again.
    """

    state: str
    windows: dict[str, Window]
    received: str
    received_ns: int

    def windows_of(self, state: str) -> dict[str, Window]:
        """The windows that a text keeps."""
        if self.state == state:
            return self.windows
        kept = msgspec.json.decode(state)
        return {name: Window.from_json(each) for name, each in kept.items()}

    def ns_of(self, received: str) -> int:
        """A moment of receipt as `Utc.tai_ns`."""
        return self.received_ns if self.received == received else recorded_utc(received).tai_ns


_NOTHING_SEEN = _Seen("", {}, "", 0)
_LATEST: dict[tuple[str, str], _Seen] = {}
_REMEMBERED = 64


def _remember(spacecraft: str, run: str, seen: _Seen) -> None:
    if len(_LATEST) >= _REMEMBERED:
        _LATEST.clear()
    _LATEST[spacecraft, run] = seen


def _mission(connection: Connection, draft: Draft) -> Mission:
    """The mission that a draft was made with; one from another process brings its digest alone."""
    if draft.mission is not None:
        return draft.mission
    query = select(missions.c.settings).where(missions.c.digest == draft.result["mission_digest"])
    return Mission.model_validate_json(connection.execute(query).scalar_one())


class Board:
    """The active alarms of one spacecraft in one run, as they change in a transaction."""

    def __init__(self, connection: Connection, spacecraft: str, run: str) -> None:
        self._connection = connection
        self._place = {"spacecraft": spacecraft, "run": run}
        place = {"of_spacecraft": spacecraft, "of_run": run}
        rows = _ACTIVE.read(connection, place)
        self._alarms: dict[str, Row] = {row["quantity"]: row for row in rows}
        self._latest: dict[str, Row] = {}

    def has(self, quantity: str) -> bool:
        """Whether a quantity has an active alarm."""
        return quantity in self._alarms

    def is_out(self, quantity: str) -> bool:
        """Whether a quantity has an active alarm and is out of limits."""
        return self.has(quantity) and self._alarms[quantity]["current_severity"] is not None

    def observe(
        self,
        quantity: str,
        severity: Severity | None,
        limits: LimitSettings,
        point: Point,
        now: str,
        worst: Point | None = None,
    ) -> None:
        """Let a quantity's alarm meet a new value, or raise one."""
        alarm = self._alarms.get(quantity)
        if alarm is None:
            if severity is not None:
                columns, actions = latch.raised(severity, limits, point, now, worst)
                alarm = {"id": _IDS.new(), "quantity": quantity, **self._place, **columns}
                self._connection.execute(insert(alarms), alarm)
                note(self._connection, alarm, actions, now)
                self._alarms[quantity] = alarm
            return
        changes, actions = latch.observed(alarm, severity, limits, point, now, worst)
        if actions:
            pending = self._latest.pop(quantity, {})
            alarm = change(self._connection, alarm, pending | changes, actions, now)
        else:
            # Values alone are written once, at the end.
            self._latest[quantity] = self._latest.get(quantity, {}) | changes
            alarm = alarm | changes
        self._alarms[quantity] = alarm
        if alarm["cleared_at"] is not None:
            del self._alarms[quantity]

    def save(self) -> None:
        """Write the latest values of the alarms that did not change otherwise."""
        if self._latest:
            found = [self._alarms[quantity] for quantity in self._latest]
            rows = [
                {name: alarm[name] for name in _MET} | {"of_id": alarm["id"]} for alarm in found
            ]
            _MEET.run(self._connection, rows)
            self._latest.clear()


def silence(limits: Mapping[QuantityName, LimitSettings], gap_s: float) -> Severity | None:
    """How bad a silence is."""
    passed = limits[SILENCE].passed(gap_s)
    return passed[-1] if passed else None


def sweep(connection: Connection, missions: Mapping[str, Mission], now: Utc) -> None:
    """What no batch tells of: live spacecraft that are silent, shelves whose time is over."""
    for spacecraft in sorted(_silent(connection, missions, now)):
        row = _locked(connection, spacecraft, LIVE)
        if row is None:
            continue
        board = Board(connection, spacecraft, LIVE)
        gap_s = _seconds(row["received"], now.text)
        limits = limits_of(connection, missions[spacecraft])
        severity = silence(limits, gap_s)
        if severity is not None:
            point = Point(gap_s, row["time"], row["batch_id"])
            board.observe(SILENCE, severity, limits[SILENCE], point, now.text)
            board.save()
    over = connection.execute(_shelved_until(now).with_for_update()).mappings().all()
    for alarm in map(dict, over):
        changes, actions = latch.expired(alarm, now.text)
        change(connection, alarm, changes, actions, now.text)


def is_due(connection: Connection, missions: Mapping[str, Mission], now: Utc) -> bool:
    """Whether `sweep` would find something to do; it only reads."""
    if connection.execute(_shelved_until(now).limit(1)).first() is not None:
        return True
    return bool(_silent(connection, missions, now))


def _silent(connection: Connection, missions: Mapping[str, Mission], now: Utc) -> set[str]:
    """The live spacecraft whose silence is worse than their alarm says so far."""
    found = set()
    query = select(watches.c.spacecraft, watches.c.received).where(watches.c.run == LIVE)
    for spacecraft, received in connection.execute(query):
        mission = missions.get(spacecraft)
        if mission is None:
            continue
        gap_s = _seconds(received, now.text)
        severity = silence(limits_of(connection, mission), gap_s)
        if severity is None:
            continue
        noted = select(alarms.c.current_severity).where(
            alarms.c.run == LIVE,
            alarms.c.spacecraft == spacecraft,
            alarms.c.quantity == SILENCE,
            alarms.c.cleared_at.is_(None),
        )
        if connection.execute(noted).scalar() != severity.word:
            found.add(spacecraft)
    return found


def shelf_end(now: Utc, minutes: int) -> str:
    """The moment some minutes from now, as its text."""
    return shifted(now, 60.0 * minutes).text


def _shelved_until(now: Utc) -> Any:
    return (
        select(alarms)
        .where(alarms.c.cleared_at.is_(None), alarms.c.shelved_until <= now.text)
        .order_by(alarms.c.id)
    )


def _sampling(name: QuantityName) -> Callable[[Row], Sample | None]:
    """What makes of a batch's result its sample of a quantity; None without one."""

    def share_of_stars(result: Row) -> Sample | None:
        whole = result["observed"]
        return (result["time_ns"], result[part], whole) if whole else None

    def suspect(result: Row) -> Sample:
        return result["time_ns"], int(result["status"] == "suspect"), 1

    def without_attitude(result: Row) -> Sample:
        return result["time_ns"], int(result["status"] is None), 1

    def value(result: Row) -> Sample | None:
        found = VALUE_OF[name](result)
        return None if found is None else (result["time_ns"], found, 1)

    part = name.removesuffix("_share")
    match QUANTITIES[name].of:
        case "stars":
            return share_of_stars
        case "batches":
            return suspect if name == "suspect_share" else without_attitude
        case "value":
            return value
        case _:
            return lambda result: None


_SAMPLE_OF = {name: _sampling(name) for name in QUANTITIES}


def _locked(connection: Connection, spacecraft: str, run: str) -> Row | None:
    place = {"of_spacecraft": spacecraft, "of_run": run}
    return next(iter(_LOCKED.read(connection, place)), None)


def _latest_of(batch: Row) -> Row:
    names = {"time": "time", "time_ns": "time_ns", "batch_id": "id", "received": "received"}
    return {name: batch[column] for name, column in names.items()}


def _moment(batch: Row) -> Moment:
    return batch["time"], batch["id"]


def _seconds(earlier: str, later: str) -> float:
    return (recorded_utc(later).tai_ns - recorded_utc(earlier).tai_ns) * 1e-9
