"""Reading results: lists of them, and one with all that belongs to it."""

import json
from typing import Any, Literal

import msgspec
from sqlalchemy import Connection, Select, select

from service.errors import NotFound, shown_value
from service.records.draft import Row
from service.records.pages import Page, Stretch, newest_first, page_of
from service.records.tables import batches, results

OutcomeName = Literal["unique", "ambiguous", "unmatched"]
Status = Literal["good", "suspect", "none"]

_COUNTS = ("observed", "unique", "ambiguous", "unmatched")


def list_batches(
    connection: Connection,
    stretch: Stretch,
    *,
    outcome: OutcomeName | None,
    status: Status | None,
    limit: int,
    cursor: str | None,
) -> Page:
    """Current results, newest batch time first.

    `outcome` keeps batches with at least one star of it; `status` those whose
    attitude is good or suspect, or that have none.
    """
    chosen = stretch.conditions()
    if outcome is not None:
        chosen.append(results.c[outcome] > 0)
    if status is not None:
        chosen.append(results.c.status == (None if status == "none" else status))
    query = newest_first(summaries().where(*chosen), cursor)
    return page_of(connection, query, limit, summary_of)


def one_result(connection: Connection, id: str) -> Row:
    """A result by its id with its batch's input; raises `NotFound`."""
    query = select(results, batches.c.input).join_from(results, batches).where(results.c.id == id)
    row = connection.execute(query).mappings().first()
    if row is None:
        raise NotFound(f"there is no batch with the id {shown_value(id)}")
    return dict(row)


def whole_record(connection: Connection, id: str) -> Row:
    """A result as the interface shows it, with input, standing, and the what-ifs of its batch."""
    row = one_result(connection, id)
    what_ifs = (
        summaries()
        .where(results.c.batch_id == row["batch_id"], results.c.parent_id.is_not(None))
        .order_by(results.c.id)
    )
    return {
        "answer": msgspec.json.decode(row["answer"]),
        "input": json.loads(row["input"]),
        "options": json.loads(row["options"]),
        "current": row["current"],
        "parent": row["parent_id"],
        "what_ifs": [summary_of(each) for each in connection.execute(what_ifs).mappings()],
    }


def summaries() -> Select[Any]:
    """The query for what `summary_of` shows."""
    kept = [column for column in results.c if column.name not in ("answer", "spacecraft", "run")]
    named = [batches.c[name] for name in ("spacecraft", "run", "batch", "time", "received")]
    return select(*kept, *named).join_from(results, batches)


def summary_of(row: Any) -> Row:
    """A result in a list: all but its stars and its attitude."""
    taken = ("id", "spacecraft", "batch", "run", "time", "received", "created", "identifier")
    return {
        **{name: row[name] for name in taken},
        "options": json.loads(row["options"]),
        "counts": {name: row[name] for name in _COUNTS},
        "status": row["status"],
        "reason": row["reason"],
        "parent": row["parent_id"],
        "current": row["current"],
    }
