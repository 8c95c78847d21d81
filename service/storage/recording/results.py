"""Writing results: every row of a result, its part in the trends included, in one transaction."""

from collections.abc import Sequence

from sqlalchemy import Connection, and_, insert, select, update

from service.errors import AcquisitionError
from service.storage.recording import events, rollups
from service.storage.recording.alarm_evaluation import evaluate_limits
from service.storage.recording.identity import (
    ExistingResult,
    Registry,
    key_row,
    look_up,
    stored_answers,
)
from service.storage.recording.unsaved_result import Answered, Draft, Row
from service.storage.sql.access_tables import audit
from service.storage.sql.statements import insert_all, insert_missing
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
)

Outcome = Answered | AcquisitionError

_RUNS = "runs"
"""Where a connection remembers the runs that it has inserted, or found there."""
_REMEMBERED = 1_000
"""Runs: their names are the clients' own."""


def register(connection: Connection, mission_rows: Sequence[Row], catalog_row: Row) -> None:
    """Note the settings and the catalog that results will name, unless they are known already."""
    insert_missing(connection, missions, mission_rows)
    insert_missing(connection, catalogs, [catalog_row])
    for row in mission_rows:
        latest = (
            select(mission_uses.c.digest)
            .where(mission_uses.c.spacecraft == row["spacecraft"])
            .order_by(mission_uses.c.id.desc())
            .limit(1)
        )
        if connection.execute(latest).scalar() != row["digest"]:
            use = {"spacecraft": row["spacecraft"], "digest": row["digest"]}
            connection.execute(insert(mission_uses), use | {"since": row["first_used"]})


def set_run_alarms(connection: Connection, run: str, watched: bool, now: str) -> None:
    """Let limits be held against a run, or no longer; the run is made where there is none."""
    insert_missing(connection, runs, [{"name": run, "created": now, "alarms": watched}])
    connection.execute(update(runs).where(runs.c.name == run).values(alarms=watched))


def record(
    connection: Connection, drafts: Sequence[Draft], assume_new: bool = False
) -> list[Outcome]:
    """Record what is new among the drafts; one outcome each, in order.

    Look, then insert: a submission that is already there, in the tables or
    earlier among the drafts, gets the stored answer, and one whose identity or
    key is taken by another body gets the error.  On PostgreSQL another process
    may still insert between the two: then an `IntegrityError` is raised, and
    to call again is to look again.

    Who expects none of them to be there, having looked, calls them `assume_new`: the
    tables are not asked.  Where one is there after all the same error is raised, for
    identities and keys are unique.
    """
    registry = Registry()
    if not assume_new:
        registry = look_up(
            connection,
            {draft.identity for draft in drafts if draft.batch is not None},
            {draft.key for draft in drafts if draft.key is not None},
        )
    keys_before = set(registry.keys)
    holders: list[ExistingResult | AcquisitionError] = [
        _holder(draft, registry) for draft in drafts
    ]
    fresh = [
        (draft, draft.to_json(len(drafts)))
        for draft, holder in zip(drafts, holders, strict=True)
        if isinstance(holder, ExistingResult) and holder.result_id == draft.id
    ]
    _insert(connection, fresh, assume_new)
    insert_all(
        connection,
        idempotency_keys,
        [
            key_row(key, taken)
            for key, taken in sorted(registry.keys.items())
            if key not in keys_before
        ],
    )
    answers = {draft.id: body for draft, body in fresh}
    missing = {h.result_id for h in holders if isinstance(h, ExistingResult)} - answers.keys()
    if missing:
        answers |= stored_answers(connection, missing)
    return [
        Answered(holder.result_id, answers[holder.result_id], holder.result_id != draft.id)
        if isinstance(holder, ExistingResult)
        else holder
        for draft, holder in zip(drafts, holders, strict=True)
    ]


def _holder(draft: Draft, registry: Registry) -> ExistingResult | AcquisitionError:
    """Who holds what the draft asks for: an earlier result, or from now on the draft itself."""
    if draft.batch is None:
        return ExistingResult(draft.id, "")
    try:
        first = registry.first(draft.identity, draft.key, draft.batch["fingerprint"])
    except AcquisitionError as error:
        return error
    taken = first or ExistingResult(draft.id, draft.batch["fingerprint"])
    registry.enter(draft.identity, draft.key, taken)
    return taken


def _insert(connection: Connection, fresh: Sequence[tuple[Draft, bytes]], assume_new: bool) -> None:
    # Sorted, so that two processes that insert the same batches do not wait in a circle.
    firsts = sorted(
        ((draft, body) for draft, body in fresh if draft.batch is not None),
        key=lambda each: each[0].identity,
    )
    names = {draft.identity[1]: draft.batch["received"] for draft, _ in firsts if draft.batch}
    # Also those of a transaction that was taken back.  The foreign key then refuses their batches,
    # and `transact`, to which nothing is `assume_new`, inserts the run.
    known: set[str] = connection.info.setdefault(_RUNS, set())
    if len(known) > _REMEMBERED:
        known.clear()
    missing = [name for name in sorted(names) if not assume_new or name not in known]
    insert_missing(
        connection,
        runs,
        [{"name": name, "created": names[name], "alarms": False} for name in missing],
    )
    known.update(missing)
    insert_all(connection, batches, [draft.batch for draft, _ in firsts if draft.batch])
    insert_all(connection, frames, [draft.frame for draft, _ in firsts if draft.frame])
    _insert_results(connection, firsts)
    rollups.add(connection, ((draft.buckets, draft.result) for draft, _ in firsts))
    # What-ifs go one by one: of two that are adopted, the second supersedes the first.
    adopted = []
    for draft, body in fresh:
        if draft.batch is None:
            if draft.result["current"]:
                _supersede(connection, draft)
                where = draft.buckets
                adopted.append((where.spacecraft, where.run, where.hour))
            _insert_results(connection, [(draft, body)])
    rollups.renew(connection, adopted)
    insert_all(connection, audit, [draft.audit for draft, _ in fresh if draft.audit is not None])
    evaluate_limits(connection, [draft for draft, _ in firsts])
    _note_events(connection, [draft for draft, _ in fresh])


def _note_events(connection: Connection, fresh: Sequence[Draft]) -> None:
    """Note what came: new batches once for each spacecraft and run, adopted results each."""
    new: dict[tuple[str, str], list[Draft]] = {}
    for draft in fresh:
        spacecraft, run, _ = draft.identity
        if draft.batch is not None:
            new.setdefault((run, spacecraft), []).append(draft)
        elif draft.result["current"]:
            about = {"spacecraft": spacecraft, "run": run, "id": draft.id}
            about["batch_id"] = draft.result["batch_id"]
            events.note(connection, "adopted", about, run=run, spacecraft=spacecraft)
    for (run, spacecraft), drafts in new.items():
        latest = max(drafts, key=lambda draft: int(draft.result["time_ns"]))
        assert latest.batch is not None
        newest: Row = {name: latest.batch[name] for name in ("id", "batch", "time")}
        newest |= {name: latest.result[name] for name in ("status", "reason")}
        newest["counts"] = latest.counts
        note: Row = {"spacecraft": spacecraft, "run": run, "batches": len(drafts)}
        note["latest"] = newest
        events.note(connection, "batches", note, run=run, spacecraft=spacecraft)


def _insert_results(connection: Connection, drafts: Sequence[tuple[Draft, bytes]]) -> None:
    # In order of their ids, which rise: each goes to the end of its table.
    in_order = sorted(drafts, key=lambda each: each[0].id)
    rows = [draft.result | {"answer": body.decode()} for draft, body in in_order]
    insert_all(connection, results, rows)
    insert_all(connection, star_results, [row for draft, _ in in_order for row in draft.stars])
    insert_all(connection, solutions, [d.solution for d, _ in in_order if d.solution is not None])


def _supersede(connection: Connection, draft: Draft) -> None:
    """Let the current result of a batch stand no longer, so that the draft can take its place."""
    batch_id = draft.result["batch_id"]
    # The lock on the batch orders the adoptions of several processes.
    connection.execute(select(batches.c.id).where(batches.c.id == batch_id).with_for_update())
    current = and_(results.c.batch_id == batch_id, results.c.current)
    connection.execute(update(results).where(current).values(current=False))
