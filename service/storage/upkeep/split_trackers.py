"""Splits older batches by tracker: what recording does by itself since schema 0008.

Also the thread that does this, and what else an upgrade leaves to be done.

A few batches at a time: they are read and computed beside the writer, and written
in one short transaction, which also notes how far it came.  Killed, it has split
whole steps; the next call goes on from there.  A batch that another process split,
or whose result was replaced meanwhile, is left as it is.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from sqlalchemy import Connection, Select, bindparam, select, tuple_, update
from sqlalchemy import delete as deleted

from service.contract.answers import Answer
from service.errors import BadInput, Busy
from service.missions.mission import Mission
from service.observations.calibrate import correct
from service.observations.schema import submission_from_json
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.model import SkyModel
from service.storage.projections import rollups, seals
from service.storage.queries.pages import PLACE, newest_first
from service.storage.queries.results import answer_from_json, recorded_mission
from service.storage.recording.identity import SETTINGS, digest_of, digest_of_row, made_later
from service.storage.recording.result_metrics import catalog_rows, tracker_rows
from service.storage.sql.columns import Row
from service.storage.sql.statements import insert_all, owned_rows, rows_of
from service.storage.sql.tables import (
    batches,
    frames,
    results,
    solutions,
    star_results,
    tracker_splits,
    tracker_values,
)
from service.storage.store import Store
from service.times import HOUR_S, parse_utc
from service.trends.measures import BatchStars

log = logging.getLogger(__name__)

AT_ONCE = 50
PAUSE_S = 0.25
"""The pause between two steps of the service, each of which takes the writer some milliseconds."""
RETRY_S = 30.0
LOG_EVERY_S = 60.0
Owner = tuple[str, str]
"""(spacecraft, run)."""
Place = tuple[int | None, str | None]
"""The `time_ns` and id of the batch that was looked at last; None at the beginning."""


@dataclass
class TrackerSplitter:
    """Splits the older batches of missions with several trackers."""

    store: Store
    sky: SkyModel
    missions: Mapping[str, Mission]
    _recorded: dict[str, Mission] = field(default_factory=dict)
    _catalogs: dict[str, tuple[RunCatalog, dict[str, int]]] = field(default_factory=dict)

    def waiting(self) -> list[Owner]:
        """The runs of spacecraft with several trackers whose batches are still to be split."""
        several = [each.name for each in self.missions.values() if len(each.trackers) > 1]
        columns = tracker_splits.c.spacecraft, tracker_splits.c.run
        query = select(*columns).where(tracker_splits.c.spacecraft.in_(several))
        with self.store.reading_record() as connection:
            return [(row[0], row[1]) for row in connection.execute(query.order_by(*columns))]

    def split(
        self,
        step: Callable[[int], object] = lambda done: None,
        *,
        pause_s: float = 0.0,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> int:
        """Split all that is waiting; how many batches were looked at, see `_in_steps`."""
        work = [partial(self._step, owner) for owner in self.waiting()]
        return _in_steps(work, step, pause_s, is_stopped)

    def _step(self, owner: Owner) -> int:
        """Split the next batches of a run; 0 when it is done."""
        with self.store.reading_record() as connection:
            place = _place(connection, owner)
            if place is None:
                return 0
            rows = rows_of(connection, _next(owner, place))
            for digest in {row["mission_digest"] for row in rows} - self._recorded.keys():
                self._recorded[digest] = recorded_mission(connection, digest)
        split = {row["id"]: self._split(row) for row in rows}
        self.store.writer.change(lambda connection: _write(connection, owner, place, rows, split))
        return len(rows)

    def _split(self, row: Row) -> list[Row]:
        """The values of the trackers of a recorded batch, as its answer gives them."""
        answer = answer_from_json(row["answer"])
        mission = self._recorded[row["mission_digest"]]
        try:
            batch = submission_from_json(row["input"]).batch
            corrected = correct(batch, mission)
        except BadInput:
            # `verify` tells of an input that cannot be read.
            return []
        catalog, place = self._catalog(answer, mission, row["time"])
        stars = BatchStars(
            batch, corrected, catalog_rows(answer, place), catalog, answer.attitude is not None
        )
        return tracker_rows(row["batch_id"], answer, stars)

    def _catalog(
        self, answer: Answer, mission: Mission, time: str
    ) -> tuple[RunCatalog, Mapping[str, int]]:
        """A run catalog with its rows by star; no row if the answer's is no longer there."""
        digest = answer.provenance.run_catalog
        if digest not in self._catalogs:
            catalog = self.sky.run_catalog(mission, parse_utc(time))
            same = catalog.digest == digest
            place = {id: row for row, id in enumerate(catalog.star_id)} if same else {}
            self._catalogs[digest] = catalog, place
        return self._catalogs[digest]


class BackgroundUpgrade:
    """Brings what earlier versions recorded up to date, in a thread, once.

    Gives results their digests, then splits batches by tracker.
    """

    def __init__(self, splitter: TrackerSplitter) -> None:
        self.splitter, self.digests = splitter, OlderDigests(splitter.store)
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin, if anything is waiting."""
        if self._thread is None and (self.digests.waiting() or self.splitter.waiting()):
            self._thread = threading.Thread(target=self._run, name="upgrade")
            self._thread.start()

    def stop(self) -> None:
        """End after the present step; the next start goes on."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        self._finish(self.digests.give, "older results were given digests")
        self._finish(self.splitter.split, "older batches were looked at and split by tracker")

    def _finish(self, work: Callable[..., int], outcome: str) -> None:
        logged_s = time.monotonic()

        def log_progress(done: int) -> None:
            nonlocal logged_s
            if time.monotonic() - logged_s > LOG_EVERY_S:
                logged_s = time.monotonic()
                log.info("%d %s so far", done, outcome)

        while not self._stopping.is_set():
            try:
                done = work(log_progress, pause_s=PAUSE_S, is_stopped=self._stopping.is_set)
            except Busy:
                self._stopping.wait(RETRY_S)
                continue
            except Exception:
                # What is missing stays so, and is told of; everything else goes on.
                log.exception("not all %s", outcome)
                return
            if done and not self._stopping.is_set():
                log.info("%d %s", done, outcome)
            return


def _in_steps(
    work: Iterable[Callable[[], int]],
    step: Callable[[int], object],
    pause_s: float,
    is_stopped: Callable[[], bool],
) -> int:
    """Call each function until it gives zero; the sum of what they gave.

    `step` is called with that sum as it grows.  After each step it pauses, so that batches that
    are sent meanwhile do not wait.
    """
    done = 0
    for function in work:
        while not is_stopped() and (made := function()):
            done += made
            step(done)
            time.sleep(pause_s)
    return done


def _place(connection: Connection, owner: Owner, *, lock: bool = False) -> Place | None:
    """How far the batches of a run were looked at; None if all are."""
    query = select(tracker_splits.c.time_ns, tracker_splits.c.batch_id).where(_is(owner))
    row = connection.execute(query.with_for_update() if lock else query).first()
    return None if row is None else (row[0], row[1])


def _is(owner: Owner) -> Any:
    return tuple_(tracker_splits.c.spacecraft, tracker_splits.c.run) == tuple_(*owner)


def _next(owner: Owner, place: Place) -> Select[Any]:
    """The next batches to be looked at, the newest first, with what their values need."""
    spacecraft, run = owner
    query = (
        select(
            *(results.c[name] for name in ("id", "batch_id", "mission_digest", "time_ns")),
            results.c.answer,
            batches.c.input,
            batches.c.time,
        )
        .join_from(results, batches, results.c.batch_id == batches.c.id)
        .where(results.c.current, results.c.spacecraft == spacecraft, results.c.run == run)
    )
    if place != (None, None):
        query = query.where(tuple_(*PLACE) < tuple_(*place))
    return newest_first(query).limit(AT_ONCE)


def _write(
    connection: Connection,
    owner: Owner,
    place: Place,
    rows: list[Row],
    split: Mapping[str, list[Row]],
) -> None:
    if _place(connection, owner, lock=True) != place:
        # Another process was here.
        return
    if not rows:
        connection.execute(deleted(tracker_splits).where(_is(owner)))
        return
    hours = {row["id"]: parse_utc(row["time"]).bucket(HOUR_S) for row in rows}
    position = rollups.lock_position(connection)
    ids = [row["id"] for row in rows]
    query = select(results.c.id, results.c.seq).where(results.c.id.in_(ids), results.c.current)
    current = dict(map(tuple, connection.execute(query)))
    of_batches = tracker_values.c.batch_id.in_([row["batch_id"] for row in rows])
    present = set(connection.scalars(select(tracker_values.c.batch_id).where(of_batches)))
    new = [
        (row["id"], values)
        for row in rows
        if row["id"] in current and row["batch_id"] not in present
        for values in split[row["id"]]
    ]
    insert_all(connection, tracker_values, [values for _, values in new])
    # The projector adds those that it has not come to yet.
    passed = [(id, values) for id, values in new if current[id] <= position]
    rollups.add(connection, (((*owner, hours[id]), values) for id, values in passed))
    last = {"time_ns": rows[-1]["time_ns"], "batch_id": rows[-1]["batch_id"]}
    connection.execute(update(tracker_splits).where(_is(owner)).values(last))


# Gives results of earlier versions their digests: what recording does by itself since schema 0017.
#
# A few at a time, each step in one short transaction with the seals of their hours.  Killed, it has
# done whole steps; the next call goes on from there.  These digests are marked as made later: they
# say nothing of what happened to a result before.


@dataclass(frozen=True)
class OlderDigests:
    """Makes the digests that are missing in a database."""

    store: Store

    def waiting(self) -> bool:
        """True if any is missing."""
        with self.store.reading_record() as connection:
            return any(
                connection.execute(select(column).where(digest.is_(None)).limit(1)).first()
                for column, digest in (
                    (results.c.id, results.c.digest),
                    *((table.c.digest, table.c.row_digest) for table in SETTINGS),
                )
            )

    def give(
        self,
        step: Callable[[int], object] = lambda done: None,
        *,
        pause_s: float = 0.0,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> int:
        """Make all that are missing; how many results got one, see `_in_steps`."""
        self.store.writer.change(_give_to_settings)
        work = [lambda: self.store.writer.change(_give)]
        return _in_steps(work, step, pause_s, is_stopped)


def _give(connection: Connection) -> int:
    """Give some results their digests; how many."""
    # Whoever deletes results takes this lock, too.
    rollups.lock_position(connection)
    query = select(results).where(results.c.digest.is_(None)).order_by(results.c.id).limit(AT_ONCE)
    made = rows_of(connection, query)
    if not made:
        return 0
    ids = [row["id"] for row in made]
    stars = owned_rows(connection, star_results, "result_id", ids)
    others = [
        owned_rows(connection, table, owner, ids)
        for table, owner in ((solutions, "result_id"), (batches, "id"), (frames, "batch_id"))
    ]
    digests = []
    for row in made:
        own = (next(iter(rows[row["id"]]), None) for rows in others)
        digest = made_later(digest_of(row, stars[row["id"]], *own))
        digests.append({"of": row["id"], "given": digest})
    chosen = results.c.id.in_(ids)
    seals.add(connection, chosen, -1)
    one = update(results).where(results.c.id == bindparam("of"))
    connection.execute(one.values(digest=bindparam("given")), digests)
    seals.add(connection, chosen)
    return len(digests)


def _give_to_settings(connection: Connection) -> None:
    for table in SETTINGS:
        query = select(table).where(table.c.row_digest.is_(None))
        for row in rows_of(connection, query):
            own = [column == row[column.name] for column in table.primary_key]
            digest = made_later(digest_of_row(table, row))
            connection.execute(update(table).where(*own).values(row_digest=digest))
