"""Seals: the number of results of each hour, and the sum of their digests.

They reveal a result that was removed, added or exchanged by anybody but the service.  The projector
adds new results.  `prune`, `archive`, `restore` and `forget` change the seals in the transaction
that deletes or inserts the results.
"""

from collections.abc import Sequence
from typing import Any

from sqlalchemy import (
    BigInteger,
    ColumnElement,
    Connection,
    Executable,
    bindparam,
    delete,
    func,
    select,
)

from service.storage.projections.rollups import RecordedResult, lock_position
from service.storage.sql.dialects import dialect_of
from service.storage.sql.statements import Prepared
from service.storage.sql.tables import projector, results, seals

HOUR_NS = 3_600_000_000_000
SUMMED_BITS = (1 << 40) - 1
"""Mask for the summed bits of each digest: eight million sums fit in 63 bits."""

Seal = tuple[str, str, int]
"""Key of a seal: (spacecraft, run, number of the hour in TAI)."""
_OWN = (results.c.spacecraft, results.c.run, results.c.time_ns // HOUR_NS)


def apply(connection: Connection, new: Sequence[RecordedResult]) -> None:
    """Add new results to the seals of their hours."""
    _ADD_RANGE.run(connection, [{"first_seq": new[0].seq, "last_seq": new[-1].seq}])


def add(connection: Connection, chosen: ColumnElement[bool], sign: int = 1) -> None:
    """Add results to the seals of their hours, or take them out with a `sign` of -1."""
    connection.execute(_adding(dialect_of(connection).module, chosen, sign))


def _adding(dialect: Any, chosen: ColumnElement[bool], sign: int = 1) -> Executable:
    summed = select(*_OWN, *(sign * each for each in _sums())).where(chosen).group_by(*_OWN)
    statement = dialect.insert(seals).from_select([each.name for each in seals.columns], summed)
    merged = {name: seals.c[name] + statement.excluded[name] for name in ("results", "digests")}
    found: Executable = statement.on_conflict_do_update(
        index_elements=list(seals.primary_key), set_=merged
    )
    return found


def take_out(connection: Connection, batch_ids: Sequence[str]) -> None:
    """Remove results of batches to be deleted from the seals, if the projector has added them."""
    passed = results.c.seq <= lock_position(connection)
    add(connection, results.c.batch_id.in_(batch_ids) & passed, -1)
    connection.execute(delete(seals).where(seals.c.results == 0))


def stored(connection: Connection) -> dict[Seal, tuple[int, int]]:
    """Stored seals: number of results and sum of digests of each hour."""
    return {(s, r, hour): (n, sum) for s, r, hour, n, sum in connection.execute(select(seals))}


def counted(connection: Connection) -> dict[Seal, tuple[int, int]]:
    """Seals counted from the results that the projector has passed."""
    passed = results.c.seq <= select(projector.c.seq).scalar_subquery()
    query = select(*_OWN, *_sums()).where(passed).group_by(*_OWN)
    return {(s, r, hour): (n, sum) for s, r, hour, n, sum in connection.execute(query)}


def _sums() -> tuple[ColumnElement[int], ColumnElement[int]]:
    bits = results.c.digest.op("&")(SUMMED_BITS)
    # PostgreSQL's sum of integers is a decimal number.
    return func.count(), func.coalesce(func.sum(bits), 0).cast(BigInteger)


_ADD_RANGE = Prepared(
    lambda dialect: _adding(
        dialect, results.c.seq.between(bindparam("first_seq"), bindparam("last_seq"))
    )
)
