"""Writing results: every row of a result in one transaction; trends follow (`projections`)."""

import json
from collections.abc import Mapping, Sequence

from sqlalchemy import Connection, and_, delete, insert, select, update

from service.errors import AcquisitionError, Busy
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
from service.storage.recording.unsaved_result import Answered, UnsavedResult
from service.storage.sql.access_tables import audit
from service.storage.sql.columns import Row
from service.storage.sql.statements import execute, insert_all, insert_missing, insert_runs
from service.storage.sql.tables import (
    batches,
    catalogs,
    frames,
    idempotency_keys,
    mission_uses,
    missions,
    results,
    runs,
    solutions,
    star_results,
    tracker_values,
)

RecordOutcome = Answered | AcquisitionError

_LOCK_SEQUENCE = (
    "SELECT pg_advisory_xact_lock(hashtextextended(%(pair)s, 'batches'::regclass::oid::int8))"
)
_RUNS = "runs"
"""The key under which a connection remembers the runs that it has inserted, or found there."""
_REMEMBERED = 1_000
"""Runs: their names are the clients' own."""


def register(connection: Connection, mission_rows: Sequence[Row], catalog_row: Row) -> None:
    """Note the settings and the catalog that results will name, unless they are known already."""
    for table, rows in ((missions, mission_rows), (catalogs, [catalog_row])):
        insert_missing(
            connection, table, [row | {"row_digest": digest_of_row(table, row)} for row in rows]
        )
    for row in mission_rows:
        latest = (
            select(mission_uses.c.digest)
            .where(mission_uses.c.spacecraft == row["spacecraft"])
            .order_by(mission_uses.c.id.desc())
            .limit(1)
        )
        before = connection.execute(latest).scalar()
        if before != row["digest"]:
            if before is not None and _trackers(row["settings"]) > 1:
                query = select(missions.c.settings).where(missions.c.digest == before)
                if _trackers(connection.execute(query).scalar_one()) == 1:
                    split_anew(connection, row["spacecraft"])
            use = {
                "spacecraft": row["spacecraft"],
                "digest": row["digest"],
                "since": row["first_used"],
            }
            use["row_digest"] = digest_of_row(mission_uses, use)
            connection.execute(insert(mission_uses), use)


def _trackers(settings: str) -> int:
    """The number of a mission's trackers."""
    return len(json.loads(settings)["trackers"])


def set_run_alarms(connection: Connection, run: str, watched: bool, now: str) -> None:
    """Let limits be held against a run, or no longer; the run is made where there is none."""
    insert_runs(connection, {run: now}, alarms=watched)
    connection.execute(update(runs).where(runs.c.name == run).values(alarms=watched))


def record(
    connection: Connection, unsaved_results: Sequence[UnsavedResult], assume_new: bool = False
) -> list[RecordOutcome]:
    """Record those results that are new; one outcome each, in order.

    Look, then insert: a submission that is already there, in the tables or
    earlier among the unsaved results, gets the stored answer, and one whose identity or
    key is taken by another body gets the error.  On PostgreSQL another process
    may still insert between the two: then an `IntegrityError` is raised, and
    to call again is to look again.

    One that was predicted from an attitude that is not the last one any more gets the error
    `PredictionOutdated`.

    With `assume_new` the tables are not searched first: the caller has done so and
    found none of them.  If one is there after all, the same error is raised, since
    identities and keys are unique.
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
        (unsaved, unsaved.to_json(len(unsaved_results)))
        for unsaved, holder in zip(unsaved_results, holders, strict=True)
        if isinstance(holder, ExistingResult) and holder.result_id == unsaved.id
    ]
    _insert(connection, fresh, assume_new)
    insert_all(
        connection,
        idempotency_keys,
        [
            key_row(key, taken)
            for key, taken in sorted(registry.keys.items())
            if key not in keys_before and not taken.archived
        ],
    )
    answers = {unsaved.id: body for unsaved, body in fresh}
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
    """Errors by id, one for each result whose prediction is not from the last attitude any more.

    Until the transaction ends no other service records one that asks for the last attitude of
    the same spacecraft and run.  All locks are taken first, and in order.
    """
    asked = [unsaved for unsaved in unsaved_results if unsaved.is_outdated is not None]
    if not asked:
        return {}
    for pair in sorted({"\n".join(unsaved.identity[:2]) for unsaved in asked}):
        execute(connection, _LOCK_SEQUENCE, {"pair": pair})
    return {
        unsaved.id: PredictionOutdated("another attitude was recorded meanwhile")
        for unsaved in asked
        if unsaved.is_outdated is not None and unsaved.is_outdated(connection)
    }


def _outcome(
    unsaved: UnsavedResult,
    holder: ExistingResult | AcquisitionError,
    answers: Mapping[str, bytes],
) -> RecordOutcome:
    if not isinstance(holder, ExistingResult):
        return holder
    if holder.archived:
        # Between looking it up and recording it.  Sent again, it gets the archived answer.
        return Busy("the batch was just archived")
    return Answered(holder.result_id, answers[holder.result_id], holder.result_id != unsaved.id)


def _holder(unsaved: UnsavedResult, registry: Registry) -> ExistingResult | AcquisitionError:
    """The holder of an identity and key: an earlier result, or from now on the unsaved one."""
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
    connection: Connection, fresh: Sequence[tuple[UnsavedResult, bytes]], assume_new: bool
) -> None:
    # Sorted, so that two processes that insert the same batches do not wait in a circle.
    firsts = sorted(
        ((unsaved, body) for unsaved, body in fresh if unsaved.batch is not None),
        key=lambda each: each[0].identity,
    )
    names = {
        unsaved.identity[1]: unsaved.batch["received"] for unsaved, _ in firsts if unsaved.batch
    }
    # Also those of a transaction that was taken back.  The foreign key then refuses their batches,
    # and `transact`, to which nothing is `assume_new`, inserts the run.
    known: set[str] = connection.info.setdefault(_RUNS, set())
    if len(known) > _REMEMBERED:
        known.clear()
    missing = [name for name in sorted(names) if not assume_new or name not in known]
    if missing:
        insert_runs(connection, {name: names[name] for name in missing})
        known.update(missing)
    insert_all(connection, batches, [unsaved.batch for unsaved, _ in firsts if unsaved.batch])
    require_not_archived(connection, [unsaved.identity for unsaved, _ in firsts])
    insert_all(connection, frames, [unsaved.frame for unsaved, _ in firsts if unsaved.frame])
    _insert_results(connection, firsts)
    insert_all(connection, tracker_values, [row for each, _ in firsts for row in each.trackers])
    # What-ifs go one by one: of two that are adopted, the second supersedes the first.
    for unsaved, body in fresh:
        if unsaved.batch is None:
            if unsaved.result["current"]:
                _supersede(connection, unsaved)
            _insert_results(connection, [(unsaved, body)])
    insert_all(
        connection, audit, [unsaved.audit for unsaved, _ in fresh if unsaved.audit is not None]
    )


def _insert_results(
    connection: Connection, unsaved_results: Sequence[tuple[UnsavedResult, bytes]]
) -> None:
    # In order of their ids, which rise: each goes to the end of its table.
    in_order = sorted(unsaved_results, key=lambda each: each[0].id)
    places = next_seqs(connection, len(in_order))
    rows = [
        unsaved.result_row(body, seq) for (unsaved, body), seq in zip(in_order, places, strict=True)
    ]
    insert_all(connection, results, rows)
    insert_all(connection, star_results, [row for unsaved, _ in in_order for row in unsaved.stars])
    insert_all(connection, solutions, [d.solution for d, _ in in_order if d.solution is not None])


def _supersede(connection: Connection, unsaved: UnsavedResult) -> None:
    """Mark the current result of a batch as superseded by an unsaved one, tracker by tracker."""
    batch_id = unsaved.result["batch_id"]
    # The lock on the batch orders the adoptions of several processes.
    connection.execute(select(batches.c.id).where(batches.c.id == batch_id).with_for_update())
    current = and_(results.c.batch_id == batch_id, results.c.current)
    connection.execute(update(results).where(current).values(current=False))
    connection.execute(delete(tracker_values).where(tracker_values.c.batch_id == batch_id))
    insert_all(connection, tracker_values, unsaved.trackers)
    spacecraft, run, _ = unsaved.identity
    about = {"spacecraft": spacecraft, "run": run, "id": unsaved.id, "batch_id": batch_id}
    events.add_event(connection, "adopted", about, run=run, spacecraft=spacecraft)


def next_seqs(connection: Connection, count: int) -> list[int]:
    """The next places in the record's order, for so many results of this transaction.

    On PostgreSQL a transaction may commit after one with later places.  It has its number before
    it takes places: whoever sees a later place, and finds that no transaction of that moment is
    left, knows that the missing ones will not come.
    """
    rows = execute(connection, _NEXT_SEQS[connection.dialect.name], {"count": count})
    return [int(place) for *_, place in rows]


_NEXT_SEQS = {
    # Of results that were deleted before they were projected nothing is left to tell.
    "sqlite": """
        WITH RECURSIVE next(seq, n) AS (
            SELECT max(ifnull((SELECT max(seq) FROM results), 0), (SELECT seq FROM projector)), 0
            UNION ALL SELECT seq + 1, n + 1 FROM next WHERE n < :count
        ) SELECT seq FROM next WHERE n > 0
    """,
    "postgresql": """
        SELECT pg_current_xact_id()::text, nextval('results_seq')
        FROM generate_series(1, %(count)s)
    """,
}
