"""Recorded results as the projections take them, in the order of the record."""

from collections.abc import Sequence
from functools import cached_property

from msgspec import Struct
from sqlalchemy import Connection, bindparam, literal_column, select

from service.storage.recording.unsaved_result import AHEAD_NS, LIVE
from service.storage.sql.columns import Row
from service.storage.sql.statements import prepared
from service.storage.sql.tables import COUNTED, MEASURED, batches, results, tracker_values
from service.times import HOUR_S, recorded_utc

_TAKEN = (
    *("id", "batch_id", "current", "seq", "spacecraft", "run", "time_ns", "mission_digest"),
    *COUNTED,
    *("status", "reason", *MEASURED, "answer"),
)
_AFTER = prepared(
    select(
        *(results.c[name] for name in _TAKEN),
        *(batches.c.batch, batches.c.time, batches.c.received),
    )
    .join_from(results, batches, results.c.batch_id == batches.c.id)
    .where(results.c.seq > bindparam("position"))
    .order_by(results.c.seq)
    .limit(bindparam("count"))
    .offset(literal_column("0"))
)
_TRACKERS = prepared(
    select(tracker_values)
    .join_from(tracker_values, results, tracker_values.c.batch_id == results.c.id)
    .where(results.c.seq > bindparam("position"), results.c.seq <= bindparam("last"))
)


class RecordedResult(Struct, eq=False, dict=True):
    """A result with its batch, and what each tracker contributed where there are several."""

    result: Row
    """The columns of `results`, and the name, time and moment of receipt of the batch."""
    trackers: Sequence[Row] = ()

    @property
    def seq(self) -> int:
        """The result's place in the record."""
        return int(self.result["seq"])

    @property
    def is_first(self) -> bool:
        """True for the first result of a batch, False for a what-if."""
        return bool(self.result["id"] == self.result["batch_id"])

    @property
    def owner(self) -> tuple[str, str]:
        """(run, spacecraft)."""
        return self.result["run"], self.result["spacecraft"]

    @property
    def hour(self) -> tuple[str, str, int]:
        """(spacecraft, run, number of the UTC hour of the batch)."""
        row = self.result
        return row["spacecraft"], row["run"], recorded_utc(row["time"]).bucket(HOUR_S)

    @cached_property
    def received_ns(self) -> int:
        """When the batch came, as `Utc.tai_ns`."""
        return recorded_utc(self.result["received"]).tai_ns

    @property
    def is_ahead(self) -> bool:
        """True for a live batch dated so far ahead that its time cannot be believed."""
        row = self.result
        return bool(row["run"] == LIVE and row["time_ns"] > self.received_ns + AHEAD_NS)


def recorded_after(connection: Connection, position: int, count: int) -> list[RecordedResult]:
    """The results after a place in the record, in order, at most so many."""
    rows = _AFTER.read(connection, {"position": position, "count": count})
    if not rows:
        return []
    trackers: dict[str, list[Row]] = {}
    for row in _TRACKERS.read(connection, {"position": position, "last": rows[-1]["seq"]}):
        trackers.setdefault(row["batch_id"], []).append(row)
    return [RecordedResult(row, trackers.get(row["id"], ())) for row in rows]
