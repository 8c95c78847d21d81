"""Heads of the record: statements by which the projector adds new rows to the chain.

A head is made once a minute, or as soon as there are many new leaves, in a transaction of its own.
Results recorded by an earlier version, which have no leaf yet, get one here, some at a time.
"""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import msgspec
from msgspec import structs
from sqlalchemy import (
    ColumnElement,
    Connection,
    Table,
    Text,
    and_,
    bindparam,
    cast,
    func,
    insert,
    literal,
    select,
    update,
)

from service.contract.events import RecordHead
from service.errors import NotFound
from service.storage.recording import chain, events
from service.storage.recording.chain import Statement
from service.storage.recording.identity import encoded_rows
from service.storage.sql.chain_tables import record_facts, record_heads, record_leaves
from service.storage.sql.columns import Row
from service.storage.sql.statements import owned_rows, rows_of
from service.storage.sql.tables import batches, frames, results, solutions, star_results
from service.times import utc_now

log = logging.getLogger(__name__)

EVERY_S = 60.0
"""Longest time in seconds until a recorded fact is covered by a head, while the service runs."""
MOST_LEAVES = 2_000
"""Approximate number of leaves of one head; further ones go to the next, in a new transaction."""
ADOPTED_AT_ONCE = 500
"""Number of results of earlier versions that get a leaf of the chain in one transaction."""
_HOUR = len("2026-03-01T12")
"""Length of a time's text up to its hour; the first head of each hour is sent as an event."""
LATE_S = 3_600.0
"""Longest duration in seconds of a transaction that adds a row to a bound table."""

Sign = Callable[[bytes], str]


@dataclass
class HeadMaker:
    """Maker of a database's heads; runs in one process at a time, in its projector's turns."""

    sign: Sign | None = None
    _due_s: float = 0.0
    _bound: int = 0
    """Position up to which results are bound into the chain, as far as this process knows."""
    _seen: dict[Table, tuple[float, object]] = field(default_factory=dict)
    """Greatest key in each table up to which all rows are facts, and the time of that finding."""
    _seen_now: dict[Table, tuple[float, object]] = field(default_factory=dict)

    def is_due(self, position: int) -> bool:
        """True if a head of the record is due: by time, or since enough results were added."""
        return time.monotonic() >= self._due_s or position - self._bound >= MOST_LEAVES

    def make(self, connection: Connection, position: int) -> Statement | None:
        """Make a head of everything new up to the projector's position; None if nothing is new.

        The caller holds the lock on the position.
        """
        self._due_s = time.monotonic() + EVERY_S
        if _adopt(connection) == ADOPTED_AT_ONCE:
            self._due_s = 0.0
        before = last_head(connection)
        position = self._bound = _give_leaves(connection, before.last, position)
        self._find_facts(connection)
        rows = new_leaves(connection, before, position, MOST_LEAVES)
        facts = rows_of(
            connection,
            select(record_facts)
            .where(record_facts.c.head.is_(None))
            .order_by(record_facts.c.id)
            .limit(MOST_LEAVES),
        )
        if not (rows or facts):
            return None
        places = [place for place, _ in rows]
        counts: dict[str, int] = {chain.RESULTS: len(rows)} if rows else {}
        for each in facts:
            counts[each["kind"]] = counts.get(each["kind"], 0) + 1
        made = Statement(
            number=before.number + 1,
            previous=chain.sha256_of(before) if before.number else "",
            made=utc_now().text,
            first=min([before.first, *places]),
            last=max([before.last, *places]),
            counts=counts,
            root=chain.root_of(leaves_of(rows, facts)).hex(),
        )
        self._store(connection, before, made, facts)
        if len(rows) >= MOST_LEAVES or len(facts) >= MOST_LEAVES:
            self._due_s = 0.0
        self._bound = made.last
        return made

    def _store(
        self, connection: Connection, before: Statement, made: Statement, facts: Sequence[Row]
    ) -> None:
        statement = made.encoded()
        head = RecordHead(
            number=made.number,
            made=made.made,
            statement=statement.decode(),
            sha256=chain.sha256_of(made),
            signature=None if self.sign is None else self.sign(statement),
        )
        connection.execute(insert(record_heads), structs.asdict(head))
        if facts:
            bound = update(record_facts).where(record_facts.c.id == bindparam("of"))
            own = [{"of": each["id"]} for each in facts]
            connection.execute(bound.values(head=made.number), own)
        log.info("record head %s", head.text)
        if before.number and before.made[:_HOUR] != made.made[:_HOUR]:
            events.add_event(connection, "head", head)

    def _find_facts(self, connection: Connection) -> None:
        """Add a fact to the chain for each new or newly closed row of the bound tables."""
        now = time.monotonic()
        for table, bound in chain.bound_tables().items():
            chosen = self._not_seen(table) if bound.rises and not bound.closed_by else None
            if "row_digest" in table.c:
                # A row of an earlier version gets its digest first.
                is_digested = table.c.row_digest.is_not(None)
                chosen = is_digested if chosen is None else and_(chosen, is_digested)
            found = _without_fact(connection, table, table.name, chosen)
            _note(connection, table, table.name, found, closed=False)
            if bound.closed_by is not None:
                kind = f"{table.name}.{bound.closed_by}"
                closed = table.c[bound.closed_by].is_not(None)
                found = _without_fact(connection, table, kind, closed)
                _note(connection, table, kind, found, closed=True)
            elif bound.rises and now - self._seen_now.get(table, (0.0, None))[0] > LATE_S:
                if table in self._seen_now:
                    self._seen[table] = self._seen_now[table]
                (key,) = table.primary_key
                greatest = connection.scalar(select(func.max(key)))
                self._seen_now[table] = (now, greatest)

    def _not_seen(self, table: Table) -> ColumnElement[bool] | None:
        # A transaction may commit after one with later keys, but not an hour after it.
        _, greatest = self._seen.get(table, (0.0, None))
        (key,) = table.primary_key
        return None if greatest is None else key > greatest


NOTHING = Statement(number=0, previous="", made="", first=0, last=0, counts={}, root="")
"""Empty statement with the number 0, in the place before the first head of the record."""


def last_head(connection: Connection) -> Statement:
    """Statement of the newest head of the record; `NOTHING` without one."""
    newest = newest_head(connection)
    return NOTHING if newest is None else msgspec.json.decode(newest.statement, type=Statement)


def newest_head(connection: Connection) -> RecordHead | None:
    """Newest head of the record, in its published form; None if there is none."""
    query = select(record_heads).order_by(record_heads.c.number.desc()).limit(1)
    return next((RecordHead(**row) for row in rows_of(connection, query)), None)


def require_head(connection: Connection) -> RecordHead:
    """Newest head of the record; raises `NotFound` if there is none."""
    if (newest := newest_head(connection)) is None:
        raise NotFound("the record has no head yet: the service makes one each minute")
    return newest


def new_leaves(
    connection: Connection, before: Statement, position: int, most: int
) -> list[tuple[int, bytes]]:
    """Leaves after a head with their places, in the chain's order; pre-chain ones last."""
    place = record_leaves.c.seq
    query = select(place, record_leaves.c.leaf).where(place > before.last, place <= position)
    found = [tuple(row) for row in connection.execute(query.order_by(place).limit(most))]
    if len(found) < most:
        older = select(place, record_leaves.c.leaf).where(place < min(before.first, 0))
        older = older.order_by(place.desc()).limit(most - len(found))
        found += [tuple(row) for row in connection.execute(older)]
    return [(int(seq), bytes(leaf)) for seq, leaf in found]


def leaves_of(rows: Sequence[tuple[int, bytes]], facts: Sequence[Row]) -> list[bytes]:
    """Leaves of a head's tree: those of results, then those of facts."""
    of_facts = (chain.leaf_of_fact(each["kind"], each["key"], each["sha256"]) for each in facts)
    return [*(leaf for _, leaf in rows), *of_facts]


def contents(connection: Connection, made: Sequence[Row]) -> Iterator[tuple[Row, bytes]]:
    """Pair each row of `results` with the encoding of all rows of that result."""
    ids = [row["id"] for row in made]
    stars = owned_rows(connection, star_results, "result_id", ids)
    others = [
        owned_rows(connection, table, owner, ids)
        for table, owner in ((solutions, "result_id"), (batches, "id"), (frames, "batch_id"))
    ]
    for row in made:
        own = [next(iter(rows[row["id"]]), None) for rows in others]
        yield row, encoded_rows(row, stars[row["id"]], *own)


def _adopt(connection: Connection) -> int:
    """Give some results without a place in the record a negative place; returns their number."""
    # Results without a digest get one first.
    chosen = select(results).where(results.c.seq == 0, results.c.digest.is_not(None))
    made = rows_of(connection, chosen.limit(ADOPTED_AT_ONCE))
    if not made:
        return 0
    least = int(connection.scalar(select(func.min(record_leaves.c.seq))) or 0)
    place = min(least, 0)
    one = update(results).where(results.c.id == bindparam("of")).values(seq=bindparam("place"))
    places = []
    for row in made:
        place -= 1
        row["seq"] = place
        places.append({"of": row["id"], "place": place})
    connection.execute(one, places)
    _insert_leaves(connection, made)
    return len(made)


def _give_leaves(connection: Connection, last: int, position: int) -> int:
    """Add missing leaves of some results that an earlier version recorded after a place.

    Returns the place up to which every result has a leaf, at most the position.
    """
    known = select(record_leaves.c.seq).where(record_leaves.c.seq == results.c.seq).exists()
    place = results.c.seq
    query = select(results).where(place > last, place <= position, ~known).order_by(place)
    made = rows_of(connection, query.limit(ADOPTED_AT_ONCE))
    if made:
        _insert_leaves(connection, made)
    return int(made[-1]["seq"]) if len(made) == ADOPTED_AT_ONCE else position


def _insert_leaves(connection: Connection, made: Sequence[Row]) -> None:
    leaves = [
        {
            "seq": row["seq"],
            "leaf": chain.leaf_of(row["id"], row["answer"], content, bool(row["current"])),
        }
        for row, content in contents(connection, made)
    ]
    connection.execute(insert(record_leaves), leaves)


def _without_fact(
    connection: Connection, table: Table, kind: str, chosen: ColumnElement[bool] | None
) -> list[Row]:
    (key,) = table.primary_key
    text = key if isinstance(key.type, Text) else cast(key, Text)
    known = select(literal(1)).where(record_facts.c.kind == kind, record_facts.c.key == text)
    query = select(table).where(~known.exists())
    if chosen is not None:
        query = query.where(chosen)
    return rows_of(connection, query.order_by(key).limit(MOST_LEAVES))


def _note(
    connection: Connection, table: Table, kind: str, rows: Sequence[Row], *, closed: bool
) -> None:
    facts = [
        {
            "kind": kind,
            "key": chain.key_of(table, row),
            "sha256": chain.content_of(table, row, closed=closed),
        }
        for row in rows
    ]
    if facts:
        connection.execute(insert(record_facts), facts)
