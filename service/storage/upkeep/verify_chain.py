"""Check of the record's chain: heads, leaves and facts against the rows of the tables.

It needs no secret: signatures are checked with a public key, and heads noted outside of the
database reveal a record that was rolled back, cut or made anew.
"""

import json
import re
import sys
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import sqlalchemy as sa

from service.errors import BadConfiguration
from service.storage.projections import heads
from service.storage.recording import chain
from service.storage.recording.chain import Statement
from service.storage.recording.signing import PublicKey
from service.storage.sql.chain_tables import record_facts, record_heads, record_leaves
from service.storage.sql.columns import Row
from service.storage.sql.statements import rows_of
from service.storage.sql.tables import results

AT_ONCE = 500
MOST_NAMED = 20
"""Largest number of faulty results that are named one by one."""
_ANCHOR = re.compile(r"\b(\d+) ([0-9a-f]{64})\b")

UNBOUND = {
    "access_sessions": "ends by itself, after hours at most",
    "archived_batches": "of the archive, which `archive verify` checks",
    "archived_hours": "of the archive",
    "archived_parts": "of the archive, which `archive verify` checks",
    "archived_what_ifs": "of the archive",
    "event_counter": "made again from results",
    "events": "made again from results; older ones are deleted",
    "idempotency_keys": "of clients' retries; says nothing of what was recorded",
    "projector": "how far the projections are",
    "replays": "how far uploads are; their batches are bound",
    "rollups_daily": "verified against a recount",
    "rollups_hourly": "verified against a recount",
    "runs": "whether limits are evaluated; changes are in the audit list",
    "seals": "verified against the results",
    "tracker_rollups_daily": "verified against a recount",
    "tracker_rollups_hourly": "verified against a recount",
    "tracker_splits": "how far an upgrade is",
    "tracker_values": "verified against the stars, and by a digest",
}
"""Tables outside the chain, with the reason; those of features declare it themselves."""
BY_LEAVES = frozenset({"batches", "results", "star_results", "solutions", "frames"})
"""Tables whose rows are covered by the leaves of results."""
OF_OTHERS = frozenset({"graded_blocks"})
"""Tables whose rows are covered by a digest in the row that they belong to."""


@dataclass(frozen=True)
class Anchor:
    """Head of the record that was noted outside of the database."""

    number: int
    sha256: str


def anchors_in(text: str) -> list[Anchor]:
    """Find heads in a text, such as a log: a number and 64 hexadecimal digits each.

    Raises `BadConfiguration` for a text without any.
    """
    found = [Anchor(int(number), sha256) for number, sha256 in _ANCHOR.findall(text)]
    if not found:
        raise BadConfiguration("--head: holds no head: a number and 64 hexadecimal digits")
    return found


def faults_of_the_chain(
    engine: sa.Engine, public_key: PublicKey | None = None, anchors: Sequence[Anchor] = ()
) -> Iterator[str]:
    """Check the chain of the record as of one moment; yields a sentence for each fault."""
    with engine.begin() as connection:
        stored = rows_of(connection, sa.select(record_heads).order_by(record_heads.c.number))
        yield from _of_the_heads(stored, public_key)
        yield from _of_the_anchors(stored, anchors)
        statements = _statements(stored)
        last = statements[-1] if statements else heads.NOTHING
        yield from _of_the_roots(connection, statements)
        yield from _of_the_results(connection, last)
        if statements:
            yield from _of_the_facts(connection)


def _statements(stored: Sequence[Row]) -> list[Statement]:
    """Decode the statements of heads, without unreadable ones, which `_of_the_heads` reports."""
    found = []
    for row in stored:
        try:
            found.append(msgspec.json.decode(row["statement"], type=Statement))
        except msgspec.MsgspecError:
            continue
    return found


def _of_the_heads(stored: Sequence[Row], public_key: PublicKey | None) -> Iterator[str]:
    before, previous = 0, ""
    for row in stored:
        name = f"record head {row['number']}"
        if row["number"] != before + 1:
            yield f"{name}: the head before it is missing"
        before = row["number"]
        try:
            statement = msgspec.json.decode(row["statement"], type=Statement)
        except msgspec.MsgspecError:
            yield f"{name}: its statement cannot be read"
            continue
        sha256 = chain.sha256_of(statement)
        is_own = statement.encoded().decode() == row["statement"]
        if not is_own or sha256 != row["sha256"] or statement.number != row["number"]:
            yield f"{name}: it is not what was stated"
        if statement.previous != previous:
            yield f"{name}: it does not follow the head before it"
        previous = sha256
        if public_key is not None:
            if row["signature"] is None:
                yield f"{name}: it is not signed"
            elif not public_key.has_signed(row["statement"].encode(), row["signature"]):
                yield f"{name}: its signature is not of this key"


def _of_the_anchors(stored: Sequence[Row], anchors: Sequence[Anchor]) -> Iterator[str]:
    known = {row["number"]: row["sha256"] for row in stored}
    agreeing = [each.number for each in anchors if known.get(each.number) == each.sha256]
    others = sorted(
        (each for each in anchors if known.get(each.number) != each.sha256),
        key=lambda each: each.number,
    )
    if not others:
        return
    first = others[0]
    agreed = [number for number in agreeing if number < first.number]
    until = f"the last head that agrees is {max(agreed)}" if agreed else "no earlier head is given"
    if first.number not in known:
        newest = max(known, default=0)
        yield f"the record ends at head {newest}, and head {first.number} was given; {until}"
    else:
        yield f"head {first.number} is another than the one that was given; {until}"


def _of_the_roots(connection: sa.Connection, statements: Sequence[Statement]) -> Iterator[str]:
    before = heads.NOTHING
    for each in statements:
        leaves = heads.leaves_of(*bound_by(connection, before, each))
        if chain.root_of(leaves).hex() != each.root:
            yield f"record head {each.number}: leaves or facts that it binds were changed"
        before = each


def bound_by(
    connection: sa.Connection, before: Statement, head: Statement
) -> tuple[list[tuple[int, bytes]], list[Row]]:
    """Leaves with their places, and rows of facts, that a head covers beyond the one before."""
    place = record_leaves.c.seq
    query = sa.select(place, record_leaves.c.leaf)
    later = query.where(place > before.last, place <= head.last).order_by(place)
    older = query.where(place < min(before.first, 0), place >= head.first).order_by(place.desc())
    rows = [(int(seq), bytes(leaf)) for q in (later, older) for seq, leaf in connection.execute(q)]
    facts = sa.select(record_facts).where(record_facts.c.head == head.number)
    return rows, rows_of(connection, facts.order_by(record_facts.c.id))


def _of_the_results(connection: sa.Connection, last: Statement) -> Iterator[str]:
    """Faults of results: changed since their leaf was made, deleted, or without a leaf."""
    removed = _removed(connection)
    place = record_leaves.c.seq
    joined = sa.outerjoin(record_leaves, results, results.c.seq == place)
    gone = sa.select(place).select_from(joined).where(results.c.id.is_(None)).order_by(place)
    missing = [seq for seq in connection.scalars(gone) if not _is_in(seq, removed)]
    for seq in missing[:MOST_NAMED]:
        yield f"the result of place {seq}: it was recorded, and is gone"
    if len(missing) > MOST_NAMED:
        yield f"{len(missing) - MOST_NAMED} further results were recorded, and are gone"
    query = sa.select(results, record_leaves.c.leaf).join_from(
        results, record_leaves, results.c.seq == place, isouter=True
    )
    query = query.where(results.c.seq != 0).order_by(results.c.id).limit(AT_ONCE)
    beyond = query
    while rows := rows_of(connection, beyond):
        for row, content in heads.contents(connection, rows):
            yield from _of_a_result(row, content, last)
        beyond = query.where(results.c.id > rows[-1]["id"])
    yield from _of_the_current(connection)


def _of_a_result(row: Row, content: bytes, last: Statement) -> Iterator[str]:
    name = f"result {row['id']} of batch {row['batch_id']}"
    if row["leaf"] is None:
        if last.first <= row["seq"] <= last.last:
            yield f"{name}: the chain has no leaf of it"
    elif bytes(row["leaf"]) not in _leaves_of(row, content):
        yield f"{name}: it is not what the chain has at its place {row['seq']}"


def _leaves_of(row: Row, content: bytes) -> tuple[bytes, bytes]:
    """Both leaves that a result can have: as not current when recorded, and as current."""
    later, at_once = (
        chain.leaf_of(row["id"], row["answer"], content, mark) for mark in (False, True)
    )
    return later, at_once


def _of_the_current(connection: sa.Connection) -> Iterator[str]:
    """Faults of batches whose current result is not the latest adopted one."""
    what_ifs = sa.select(results.c.batch_id).where(results.c.parent_id.is_not(None)).distinct()
    chosen = sa.select(results, record_leaves.c.leaf).join_from(
        results, record_leaves, results.c.seq == record_leaves.c.seq
    )
    rows = rows_of(connection, chosen.where(results.c.batch_id.in_(what_ifs)))
    adopted: dict[str, tuple[int, Row]] = {}
    for row, content in heads.contents(connection, rows):
        if bytes(row["leaf"]) == _leaves_of(row, content)[1]:
            place = row["seq"]
            if place > adopted.get(row["batch_id"], (place - 1, row))[0]:
                adopted[row["batch_id"]] = place, row
    for batch_id, (_, row) in adopted.items():
        if not row["current"]:
            yield f"batch {batch_id}: its current result is not {row['id']}, the last adopted"


def _removed(connection: sa.Connection) -> list[tuple[int, int]]:
    facts = sa.select(record_facts.c.key).where(record_facts.c.kind == chain.REMOVED)
    merged: list[tuple[int, int]] = []
    for first, last in sorted(
        (a, b) for key in connection.scalars(facts) for a, b in json.loads(key)
    ):
        if merged and first <= merged[-1][1] + 1:
            merged[-1] = merged[-1][0], max(last, merged[-1][1])
        else:
            merged.append((first, last))
    return merged


def _is_in(place: int, ranges: Sequence[tuple[int, int]]) -> bool:
    """True if a place lies in one of the ranges, which are sorted and disjoint."""
    at = bisect_right(ranges, (place, sys.maxsize)) - 1
    return at >= 0 and place <= ranges[at][1]


def _of_the_facts(connection: sa.Connection) -> Iterator[str]:
    """Faults of rows in other tables that differ from the latest fact about them."""
    latest: dict[str, dict[str, str]] = {}
    c = record_facts.c
    for kind, key, sha256 in connection.execute(sa.select(c.kind, c.key, c.sha256).order_by(c.id)):
        latest.setdefault(kind, {})[key] = sha256
    for table, bound in chain.bound_tables().items():
        facts = latest.get(table.name, {})
        closed = latest.get(f"{table.name}.{bound.closed_by}", {})
        columns = [each for each in table.columns if not isinstance(each.type, sa.LargeBinary)]
        rows = {chain.key_of(table, row): row for row in rows_of(connection, sa.select(*columns))}
        yield from _of_a_table(table, rows, facts, closed)


def _of_a_table(
    table: sa.Table, rows: Mapping[str, Row], facts: Mapping[str, str], closed: Mapping[str, str]
) -> Iterator[str]:
    for key, sha256 in facts.items():
        row = rows.get(key)
        if row is None and sha256:
            yield f"{table.name}, {key}: it was recorded, and is gone"
        elif row is not None and not sha256:
            yield f"{table.name}, {key}: it was removed, and is there again"
        elif row is not None and chain.content_of(table, row) != sha256:
            yield f"{table.name}, {key}: it is not what was recorded"
        elif row is not None and "row_digest" in row and row["row_digest"] is None:
            yield f"{table.name}, {key}: it has no digest"
    for key, sha256 in closed.items():
        row = rows.get(key)
        if row is not None and chain.content_of(table, row, closed=True) != sha256:
            yield f"{table.name}, {key}: its end is not what was recorded"
