"""Events about new batches, and about states of tracking: acquiring, tracking, lost.

The state of a spacecraft in a run is that of its latest batch, where that asks for the last
attitude.
"""

from collections.abc import Sequence

from sqlalchemy import Connection, select

from service.storage.projections.recorded import RecordedResult
from service.storage.queries.pages import PLACE
from service.storage.recording import events
from service.storage.recording.answer import state_in
from service.storage.recording.unsaved_result import AHEAD_NS, LIVE, STARS
from service.storage.sql.columns import Row, unpack
from service.storage.sql.tables import results


def apply(connection: Connection, new: Sequence[RecordedResult]) -> None:
    """Add one event for the new batches of each spacecraft and run, and one for each new state."""
    of_owner: dict[tuple[str, str], list[RecordedResult]] = {}
    for each in new:
        if each.is_first:
            of_owner.setdefault(each.owner, []).append(each)
    for (run, spacecraft), some in of_owner.items():
        latest = max(some, key=lambda each: int(each.result["time_ns"])).result
        newest: Row = {name: latest[name] for name in ("id", "batch", "time", "status", "reason")}
        newest["counts"] = {name: latest[name] for name in STARS}
        note: Row = {"spacecraft": spacecraft, "run": run, "batches": len(some), "latest": newest}
        events.add_event(connection, "batches", note, run=run, spacecraft=spacecraft)
        _note_states(connection, spacecraft, run, some)


def _note_states(
    connection: Connection, spacecraft: str, run: str, new: Sequence[RecordedResult]
) -> None:
    """Add an event for each new batch of a spacecraft and a run that changes the state.

    A late batch changes none, and neither does a live one that is dated ahead.
    """
    states = {each.seq: state_in(unpack(each.result["answer"])) for each in new}
    tracked = [each for each in new if states[each.seq] is not None and not each.is_ahead]
    if not tracked:
        return
    query = select(results.c.time_ns, results.c.answer).where(
        results.c.current,
        results.c.spacecraft == spacecraft,
        results.c.run == run,
        results.c.seq < new[0].seq,
    )
    if run == LIVE:
        received_ns = max(each.received_ns for each in tracked)
        query = query.where(results.c.time_ns <= received_ns + AHEAD_NS)
    latest = query.order_by(*(column.desc() for column in PLACE)).limit(1)
    row = connection.execute(latest).first()
    before = None if row is None else state_in(row.answer)
    for each in sorted(tracked, key=lambda each: int(each.result["time_ns"])):
        if row is not None and row.time_ns > each.result["time_ns"]:
            continue
        state = states[each.seq]
        if state != before:
            note: Row = {"spacecraft": spacecraft, "run": run}
            note |= {name: each.result[name] for name in ("id", "batch", "time")}
            note |= {"state": state, "before": before}
            events.add_event(connection, "tracking", note, run=run, spacecraft=spacecraft)
        before = state
