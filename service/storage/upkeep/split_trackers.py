"""Splitting by tracker of batches that were recorded before their spacecraft had several trackers.

The module also has the thread that does this, after it has given results of earlier versions their
digests.

Batches are split in small steps: read and computed beside the writer, then written in one short
transaction, which also notes the position.  If the process is killed, whole steps are done; the
next call continues from there.  A batch that another process split, or whose result was replaced
meanwhile, is left unchanged.
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
"""Pause in seconds between two steps, each of which takes the writer some milliseconds."""
RETRY_S = 30.0
LOG_EVERY_S = 60.0
Owner = tuple[str, str]
"""Key of a run to be split: spacecraft and run."""
Place = tuple[int | None, str | None]
"""Position of a batch in a run: its `time_ns` and id; None twice before the first."""


@dataclass
class TrackerSplitter:
    """Splitter of recorded batches by tracker, for missions that got further trackers."""

    store: Store
    sky: SkyModel
    missions: Mapping[str, Mission]
    _recorded: dict[str, Mission] = field(default_factory=dict)
    _catalogs: dict[str, tuple[RunCatalog, dict[str, int]]] = field(default_factory=dict)

    def waiting(self) -> list[Owner]:
        """Runs of spacecraft with several trackers that have batches to be split."""
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
        """Split all remaining batches; returns the number of batches examined, see `_in_steps`."""
        work = [partial(self._step, owner) for owner in self.waiting()]
        return _in_steps(work, step, pause_s, is_stopped)

    def _step(self, owner: Owner) -> int:
        """Split the next batches of a run by tracker; returns their number, 0 at the end."""
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
        """Rows of `tracker_values` for a recorded batch, computed from its answer."""
        answer = answer_from_json(row["answer"])
        mission = self._recorded[row["mission_digest"]]
        try:
            batch = submission_from_json(row["input"]).batch
            corrected = correct(batch, mission)
        except BadInput:
            # `verify` reports an input that cannot be read.
            return []
        catalog, place = self._catalog(answer, mission, row["time"])
        stars = BatchStars(
            batch, corrected, catalog_rows(answer, place), catalog, answer.attitude is not None
        )
        return tracker_rows(row["batch_id"], answer, stars)

    def _catalog(
        self, answer: Answer, mission: Mission, time: str
    ) -> tuple[RunCatalog, Mapping[str, int]]:
        """Run catalog of an answer, and indices by star id: none if the catalog has changed."""
        digest = answer.provenance.run_catalog
        if digest not in self._catalogs:
            catalog = self.sky.run_catalog(mission, parse_utc(time))
            same = catalog.digest == digest
            place = {id: row for row, id in enumerate(catalog.star_id)} if same else {}
            self._catalogs[digest] = catalog, place
        return self._catalogs[digest]


class BackgroundUpgrade:
    """Thread that completes what was recorded earlier, once.

    It gives results their digests, then splits batches by tracker.
    """

    def __init__(self, splitter: TrackerSplitter) -> None:
        self.splitter, self.digests = splitter, OlderDigests(splitter.store)
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the upgrade thread if there is work to do."""
        if self._thread is None and (self.digests.waiting() or self.splitter.waiting()):
            self._thread = threading.Thread(target=self._run, name="upgrade")
            self._thread.start()

    def stop(self) -> None:
        """Stop the upgrade after the present step; the next start continues."""
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
                # The remaining work stays undone and is logged; everything else continues.
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
    """Call each function until it returns zero; returns the sum of all return values.

    `step` is called with that sum as it grows.  The pause after each step lets batches through that
    are sent meanwhile.
    """
    done = 0
    for function in work:
        while not is_stopped() and (made := function()):
            done += made
            step(done)
            time.sleep(pause_s)
    return done


def _place(connection: Connection, owner: Owner, *, lock: bool = False) -> Place | None:
    """Position up to which the batches of a run were split by tracker; None if all are."""
    query = select(tracker_splits.c.time_ns, tracker_splits.c.batch_id).where(_is(owner))
    row = connection.execute(query.with_for_update() if lock else query).first()
    return None if row is None else (row[0], row[1])


def _is(owner: Owner) -> Any:
    return tuple_(tracker_splits.c.spacecraft, tracker_splits.c.run) == tuple_(*owner)


def _next(owner: Owner, place: Place) -> Select[Any]:
    """Query for the next batches of a run to be split, newest first, with the columns needed."""
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
        # Another process has split these batches.
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
    # The projector adds the results that it has not reached yet.
    passed = [(id, values) for id, values in new if current[id] <= position]
    rollups.add(connection, (((*owner, hours[id]), values) for id, values in passed))
    last = {"time_ns": rows[-1]["time_ns"], "batch_id": rows[-1]["batch_id"]}
    connection.execute(update(tracker_splits).where(_is(owner)).values(last))


# Digests for results of earlier versions, which recording now computes by itself.
#
# Results get digests in small steps, each in one short transaction with the seals of their hours.
# If the process is killed, whole steps are done; the next call continues from there.  These digests
# are marked as made later: they prove nothing about the time before.


@dataclass(frozen=True)
class OlderDigests:
    """Calculator of digests that are missing in a database of an earlier version."""

    store: Store

    def waiting(self) -> bool:
        """True if the digest of any result, or of any row of `SETTINGS`, is missing."""
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
        """Compute all missing digests; returns the number of results changed, see `_in_steps`."""
        self.store.writer.change(_give_to_settings)
        work = [lambda: self.store.writer.change(_give)]
        return _in_steps(work, step, pause_s, is_stopped)


def _give(connection: Connection) -> int:
    """Compute the digests of a portion of results; returns its size."""
    # Deleting results takes this lock as well.
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
