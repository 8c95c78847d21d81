"""Gives results of earlier versions their digests: what recording does by itself since schema 0017.

A few at a time, each step in one short transaction with the seals of their hours.  Killed, it has
done whole steps; the next call goes on from there.  These digests are marked as made later: they
say nothing of what happened to a result before.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

from sqlalchemy import Connection, Table, bindparam, select, update

from service.storage.projections import rollups, seals
from service.storage.recording.digests import SETTINGS, digest_of, digest_of_row, made_later
from service.storage.sql.columns import Row
from service.storage.sql.tables import batches, frames, results, solutions, star_results
from service.storage.store import Store

AT_ONCE = 50


@dataclass(frozen=True)
class OlderDigests:
    """Makes the digests that are missing in a database."""

    store: Store

    def waiting(self) -> bool:
        """Whether any is missing."""
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
        """Make all that are missing; how many results got one.

        `step` is called with that number as it grows.  After each step it pauses, so that
        batches that are sent meanwhile do not wait.
        """
        self.store.writer.change(_give_to_settings).result()
        done = 0
        while not is_stopped() and (given := self.store.writer.change(_give).result()):
            done += given
            step(done)
            time.sleep(pause_s)
        return done


def _give(connection: Connection) -> int:
    """Give some results their digests; how many."""
    # Whoever deletes results takes this lock, too.
    rollups.lock_position(connection)
    query = select(results).where(results.c.digest.is_(None)).order_by(results.c.id).limit(AT_ONCE)
    made = [dict(row) for row in connection.execute(query).mappings()]
    if not made:
        return 0
    ids = [row["id"] for row in made]
    stars: dict[str, list[Row]] = {id: [] for id in ids}
    for row in _rows(connection, star_results, "result_id", ids):
        stars[row["result_id"]].append(row)
    solved = {row["result_id"]: row for row in _rows(connection, solutions, "result_id", ids)}
    sent = {row["id"]: row for row in _rows(connection, batches, "id", ids)}
    framed = {row["batch_id"]: row for row in _rows(connection, frames, "batch_id", ids)}
    given = [
        {
            "of": id,
            "given": made_later(
                digest_of(row, stars[id], solved.get(id), sent.get(id), framed.get(id))
            ),
        }
        for row, id in zip(made, ids, strict=True)
    ]
    chosen = results.c.id.in_(ids)
    seals.add(connection, chosen, -1)
    one = update(results).where(results.c.id == bindparam("of"))
    connection.execute(one.values(digest=bindparam("given")), given)
    seals.add(connection, chosen)
    return len(given)


def _give_to_settings(connection: Connection) -> None:
    for table in SETTINGS:
        query = select(table).where(table.c.row_digest.is_(None))
        for row in connection.execute(query).mappings().all():
            own = [column == row[column.name] for column in table.primary_key]
            digest = made_later(digest_of_row(table, dict(row)))
            connection.execute(update(table).where(*own).values(row_digest=digest))


def _rows(connection: Connection, table: Table, owner: str, ids: list[str]) -> list[Row]:
    query = select(table).where(table.c[owner].in_(ids))
    return [dict(row) for row in connection.execute(query).mappings()]
