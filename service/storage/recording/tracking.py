"""The states of tracking in the records: acquiring, tracking, lost, and events when they change.

The state of a spacecraft in a run is that of its latest batch, where that asks for the last
attitude.
"""

from collections.abc import Sequence

import msgspec
from sqlalchemy import Connection, select

from service.storage.queries.future_dated import AHEAD_NS, LIVE
from service.storage.queries.pages import PLACE
from service.storage.recording import events
from service.storage.recording.unsaved_result import UnsavedResult
from service.storage.sql.columns import Row
from service.storage.sql.tables import results


class _State(msgspec.Struct):
    state: str | None = None


class _Tracked(msgspec.Struct):
    """As much of an answer as tells the state."""

    tracking: _State | None = None


_TRACKED = msgspec.json.Decoder(_Tracked)


def state_in(answer: str | bytes) -> str | None:
    """The state that an answer tells; None of a batch that did not ask for the last attitude."""
    tracking = _TRACKED.decode(answer).tracking
    return None if tracking is None else tracking.state


def note_states(
    connection: Connection, spacecraft: str, run: str, fresh: Sequence[UnsavedResult]
) -> None:
    """Add an event for each new batch of a spacecraft and a run that changes the state.

    A late batch changes none, and neither does a live one that is dated ahead.
    """
    tracked = [each for each in fresh if each.tracking is not None and not each.is_ahead]
    if not tracked:
        return
    query = select(results.c.time_ns, results.c.answer).where(
        results.c.current,
        results.c.spacecraft == spacecraft,
        results.c.run == run,
        results.c.id.not_in([each.id for each in fresh]),
    )
    if run == LIVE:
        received_ns = max(each.received_ns for each in tracked)
        query = query.where(results.c.time_ns <= received_ns + AHEAD_NS)
    latest = query.order_by(*(column.desc() for column in PLACE)).limit(1)
    row = connection.execute(latest).first()
    before = None if row is None else state_in(row.answer)
    for unsaved in sorted(tracked, key=lambda each: int(each.result["time_ns"])):
        if row is not None and row.time_ns > unsaved.result["time_ns"]:
            continue
        if unsaved.tracking != before:
            assert unsaved.batch is not None
            told: Row = {"spacecraft": spacecraft, "run": run, "id": unsaved.id}
            told |= {name: unsaved.batch[name] for name in ("batch", "time")}
            told |= {"state": unsaved.tracking, "before": before}
            events.add_event(connection, "tracking", told, run=run, spacecraft=spacecraft)
        before = unsaved.tracking
