"""Recording of results: all rows of a result in one transaction; trends follow (`projections`)."""

import json
from collections.abc import Mapping, Sequence

from sqlalchemy import BigInteger, Connection, and_, bindparam, delete, insert, select, update

from service.errors import AcquisitionError, Busy
from service.observations.schema import LIVE
from service.storage.recording import events
from service.storage.recording.identity import (
    ExistingResult,
    PredictionOutdated,
    Registry,
    digest_of_row,
    key_row,
    look_up,
    require_not_archived,
    stored_answers,
)
from service.storage.recording.result_metrics import split_anew
from service.storage.recording.unsaved_result import Answered, PredictedFrom, UnsavedResult
from service.storage.sql import tables
from service.storage.sql.chain_tables import record_leaves
from service.storage.sql.columns import Row
from service.storage.sql.dialects import dialect_of
from service.storage.sql.statements import (
    execute,
    insert_all,
    insert_missing,
    insert_runs,
    prepared,
)
from service.storage.sql.tables import audit

RecordOutcome = Answered | AcquisitionError

_LOCK_SEQUENCE = (
    "SELECT pg_advisory_xact_lock(hashtextextended(%(pair)s, 'batches'::regclass::oid::int8))"
)
_LAST_GOOD = prepared(
    select(tables.results.c.id)
    .where(
        tables.results.c.current,
        tables.results.c.spacecraft == bindparam("spacecraft"),
        tables.results.c.run == bindparam("run"),
        tables.results.c.time_ns >= bindparam("since_ns", type_=BigInteger),
        tables.results.c.time_ns <= bindparam("until_ns", type_=BigInteger),
        tables.results.c.status == "good",
    )
    .order_by(tables.results.c.time_ns.desc(), tables.results.c.batch_id.desc())
    .limit(2)
)
_RUNS = "runs"
"""Key of a connection's `info` for the set of runs known to be in the database."""
_REMEMBERED = 1_000
"""Number of run names above which a connection forgets them: clients choose the names freely."""


def register(connection: Connection, mission_rows: Sequence[Row], catalog_row: Row) -> None:
    """Store the settings and the catalog that results will refer to, unless already known."""
    for table, rows in ((tables.missions, mission_rows), (tables.catalogs, [catalog_row])):
        digested = [row | {"row_digest": digest_of_row(table, row)} for row in rows]
        insert_missing(connection, table, digested)
    uses, mission = tables.mission_uses.c, tables.missions.c
    for row in mission_rows:
        latest = select(uses.digest).where(uses.spacecraft == row["spacecraft"])
        before = connection.scalar(latest.order_by(uses.id.desc()).limit(1))
        if before == row["digest"]:
            continue
        if before is not None and _trackers(row["settings"]) > 1:
            query = select(mission.settings).where(mission.digest == before)
            if _trackers(connection.execute(query).scalar_one()) == 1:
                split_anew(connection, row["spacecraft"])
        use = {"spacecraft": row["spacecraft"], "digest": row["digest"], "since": row["first_used"]}
        use["row_digest"] = digest_of_row(tables.mission_uses, use)
        connection.execute(insert(tables.mission_uses), use)


def _trackers(settings: str) -> int:
    """Number of trackers in a mission's settings, given as JSON."""
    return len(json.loads(settings)["trackers"])


def set_run_alarms(connection: Connection, run: str, watched: bool, now: str) -> None:
    """Switch the evaluation of limits for a run on or off; creates the run if there is none."""
    insert_runs(connection, {run: now}, alarms=watched)
    connection.execute(update(tables.runs).where(tables.runs.c.name == run).values(alarms=watched))


def runs_with_alarms(connection: Connection, names: set[str]) -> set[str]:
    """Runs, out of `names`, whose limits are evaluated: the live one, and those switched on."""
    others = names - {LIVE}
    if not others:
        return names
    c = tables.runs.c
    query = select(c.name).where(c.name.in_(sorted(others)), c.alarms)
    return set(connection.scalars(query)) | (names & {LIVE})


def record(
    connection: Connection, unsaved_results: Sequence[UnsavedResult], assume_new: bool = False
) -> list[RecordOutcome]:
    """Record the results that are new; one outcome each, in order.

    The database is searched first, then rows are inserted: a submission that is already in the
    tables, or earlier among the unsaved results, gets the stored answer, and one whose identity or
    key belongs to another body gets the error.  On PostgreSQL another process may insert a row
    between search and insert: an `IntegrityError` is raised then, and another call searches again.

    A result predicted from an attitude that is no longer the last one gets the error
    `PredictionOutdated`.

    With `assume_new` the tables are not searched first: the caller has done so and found none of
    the results.  If one is in the tables after all, the same error is raised, since identities and
    keys are unique.
    """
    registry = Registry()
    if not assume_new:
        registry = look_up(
            connection,
            {unsaved.identity for unsaved in unsaved_results if unsaved.batch is not None},
            {unsaved.key for unsaved in unsaved_results if unsaved.key is not None},
        )
    keys_before = set(registry.keys)
    outdated = _outdated(connection, unsaved_results)
    holders: list[ExistingResult | AcquisitionError] = [
        outdated.get(unsaved.id) or _holder(unsaved, registry) for unsaved in unsaved_results
    ]
    fresh = [
        unsaved
        for unsaved, holder in zip(unsaved_results, holders, strict=True)
        if isinstance(holder, ExistingResult) and holder.result_id == unsaved.id
    ]
    answers = {unsaved.id: unsaved.to_json(len(unsaved_results)) for unsaved in fresh}
    _insert(connection, fresh, answers, assume_new)
    new_keys = [
        key_row(key, taken)
        for key, taken in sorted(registry.keys.items())
        if key not in keys_before and not taken.archived
    ]
    insert_all(connection, tables.idempotency_keys, new_keys)
    missing = {h.result_id for h in holders if isinstance(h, ExistingResult)} - answers.keys()
    if missing:
        answers |= stored_answers(connection, missing)
    return [
        _outcome(unsaved, holder, answers)
        for unsaved, holder in zip(unsaved_results, holders, strict=True)
    ]


def _outdated(
    connection: Connection, unsaved_results: Sequence[UnsavedResult]
) -> Mapping[str, PredictionOutdated]:
    """Errors by id for results whose prediction no longer starts from the last attitude.

    Until the transaction ends no other service records one that asks for the last attitude of the
    same spacecraft and run.  All locks are taken first, and in order.
    """
    asked = [
        (unsaved, unsaved.predicted_from)
        for unsaved in unsaved_results
        if unsaved.predicted_from is not None
    ]
    if not asked:
        return {}
    for pair in sorted({"\n".join(unsaved.identity[:2]) for unsaved, _ in asked}):
        execute(connection, _LOCK_SEQUENCE, {"pair": pair})
    return {
        unsaved.id: PredictionOutdated("another attitude was recorded meanwhile")
        for unsaved, last in asked
        if last_good_results(connection, last) != last.results
    }


def last_good_results(connection: Connection, period: PredictedFrom) -> tuple[str, ...]:
    """Ids of the two last good results in the period of a prediction's start, latest first."""
    asked = {name: getattr(period, name) for name in ("spacecraft", "run", "since_ns", "until_ns")}
    return tuple(row["id"] for row in _LAST_GOOD.read(connection, asked))


def _outcome(
    unsaved: UnsavedResult,
    holder: ExistingResult | AcquisitionError,
    answers: Mapping[str, bytes],
) -> RecordOutcome:
    if not isinstance(holder, ExistingResult):
        return holder
    if holder.archived:
        # The batch was archived after it was looked up.  Sent again, it gets the archived answer.
        return Busy("the batch was just archived")
    return Answered(holder.result_id, answers[holder.result_id], holder.result_id != unsaved.id)


def _holder(unsaved: UnsavedResult, registry: Registry) -> ExistingResult | AcquisitionError:
    """Find the result with an unsaved one's identity and key, else itself; or a conflict error."""
    if unsaved.batch is None:
        return ExistingResult(unsaved.id, "")
    fingerprint = unsaved.batch["fingerprint"]
    holder = registry.holder(unsaved.identity, unsaved.key, fingerprint)
    if isinstance(holder, AcquisitionError):
        return holder
    taken = holder or ExistingResult(unsaved.id, fingerprint)
    registry.enter(unsaved.identity, unsaved.key, taken)
    return taken


def _insert(
    connection: Connection,
    fresh: Sequence[UnsavedResult],
    answers: Mapping[str, bytes],
    assume_new: bool,
) -> None:
    # Sort, so that two processes that insert the same batches cannot deadlock.
    firsts = sorted(
        (unsaved for unsaved in fresh if unsaved.batch is not None), key=lambda each: each.identity
    )
    rows = [unsaved.batch for unsaved in firsts if unsaved.batch is not None]
    names = {row["run"]: row["received"] for row in rows}
    # May hold runs of a transaction that was rolled back.  The foreign key then refuses their
    # batches, and `transact`, to which nothing is `assume_new`, inserts the run.
    known: set[str] = connection.info.setdefault(_RUNS, set())
    if len(known) > _REMEMBERED:
        known.clear()
    missing = [name for name in sorted(names) if not assume_new or name not in known]
    if missing:
        insert_runs(connection, {name: names[name] for name in missing})
        known.update(missing)
    insert_all(connection, tables.batches, rows)
    require_not_archived(connection, [unsaved.identity for unsaved in firsts])
    insert_all(connection, tables.frames, [each.frame for each in firsts if each.frame is not None])
    _insert_results(connection, firsts, answers)
    trackers = [row for unsaved in firsts for row in unsaved.trackers]
    insert_all(connection, tables.tracker_values, trackers)
    # Insert what-ifs one by one: the second of two adopted ones supersedes the first.
    for unsaved in fresh:
        if unsaved.batch is None:
            if unsaved.result["current"]:
                _supersede(connection, unsaved)
            _insert_results(connection, [unsaved], answers)
    insert_all(connection, audit, [each.audit for each in fresh if each.audit is not None])


def _insert_results(
    connection: Connection, unsaved_results: Sequence[UnsavedResult], answers: Mapping[str, bytes]
) -> None:
    # Insert by rising id, so that each row goes to the end of its table.
    in_order = sorted(unsaved_results, key=lambda each: each.id)
    places = zip(in_order, next_seqs(connection, len(in_order)), strict=True)
    rows = [unsaved.rows(answers[unsaved.id], seq) for unsaved, seq in places]
    stars = [row for unsaved in in_order for row in unsaved.stars]
    insert_all(connection, tables.results, [row for row, _ in rows])
    insert_all(connection, record_leaves, [leaf for _, leaf in rows])
    insert_all(connection, tables.star_results, stars)
    attitudes = [each.solution for each in in_order if each.solution is not None]
    insert_all(connection, tables.solutions, attitudes)


def _supersede(connection: Connection, unsaved: UnsavedResult) -> None:
    """Mark the current result of a batch as superseded, and replace its tracker values."""
    batch_id, batch = unsaved.result["batch_id"], tables.batches.c
    # Lock the batch: the lock orders the adoptions of several processes.
    connection.execute(select(batch.id).where(batch.id == batch_id).with_for_update())
    current = and_(tables.results.c.batch_id == batch_id, tables.results.c.current)
    connection.execute(update(tables.results).where(current).values(current=False))
    of_batch = tables.tracker_values.c.batch_id == batch_id
    connection.execute(delete(tables.tracker_values).where(of_batch))
    insert_all(connection, tables.tracker_values, unsaved.trackers)
    spacecraft, run, _ = unsaved.identity
    about = {"spacecraft": spacecraft, "run": run, "id": unsaved.id, "batch_id": batch_id}
    events.add_event(connection, "adopted", about, run=run, spacecraft=spacecraft)


def next_seqs(connection: Connection, count: int) -> list[int]:
    """Take the next `count` places in the record's order, for results of this transaction.

    On PostgreSQL a transaction may commit after one with later places.  It has its number before it
    takes places: a reader that sees a later place, after all transactions of that moment have
    ended, knows that missing places stay empty.
    """
    rows = execute(connection, dialect_of(connection).next_seqs, {"count": count})
    return [int(place) for *_, place in rows]
