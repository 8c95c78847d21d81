"""Recorded batches and Idempotency-Keys; and digests of what the record keeps.

`verify` computes the digests again, of each result and of each row of settings that it names:
a digit that changed later, in an answer, an input, a column or a star, does not pass.  A digest
leaves null columns out, so that a column which a later version adds changes no digest that was
made before it.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import cache
from hashlib import blake2b
from operator import itemgetter
from typing import Any

import msgspec
from msgspec import Struct
from sqlalchemy import Connection, Double, Table, insert

from service.errors import AcquisitionError, Busy, Conflict, KeyReused, shown_value
from service.observations.batch import ObservationBatch
from service.storage.sql import tables
from service.storage.sql.columns import Row, unpack
from service.storage.sql.dialects import Dialect, dialect_of
from service.storage.sql.statements import execute

Identity = tuple[str, str, str]
"""(spacecraft, run, batch): unique among submissions."""

OwnKey = tuple[str, str]
"""The id of a token and an Idempotency-Key: keys of different tokens are different keys.

The id is empty where a key came without a token.
"""


class ExistingResult(Struct, frozen=True):
    """The result that holds an identity or a key, and the fingerprint of its body."""

    result_id: str
    fingerprint: str
    archived: bool = False
    """True if its batch is in the archive."""


class PredictionOutdated(Busy):
    """Another service recorded an attitude after the one that a batch was predicted from."""


class ArchivedMeanwhile(Exception):
    """A batch that was to be new is one that another process has just archived."""


def identity_of(batch: ObservationBatch) -> Identity:
    """The identity of a batch, which is unique among submissions."""
    return batch.spacecraft, batch.run, batch.batch


@dataclass
class Registry:
    """The recorded ones of some identities and keys."""

    identities: dict[Identity, ExistingResult] = field(default_factory=dict)
    keys: dict[OwnKey, ExistingResult] = field(default_factory=dict)

    def holder(
        self, identity: Identity, key: OwnKey | None, fingerprint: str
    ) -> ExistingResult | KeyReused | Conflict | None:
        """The recorded result of this body, or None; the error where it is of another body.

        That is `KeyReused` where the key belongs to another body, which is
        looked at first, and `Conflict` where the identity does.
        """
        by_key = None if key is None else self.keys.get(key)
        if key is not None and by_key is not None:
            if by_key.fingerprint != fingerprint:
                return KeyReused(
                    f"Idempotency-Key {shown_value(key[1])} was used with another body"
                )
            return by_key
        by_identity = self.identities.get(identity)
        if by_identity is not None and by_identity.fingerprint != fingerprint:
            spacecraft, run, batch = identity
            return Conflict(
                f"{spacecraft}, run {run}: batch {shown_value(batch)} is recorded with another body"
            )
        return by_identity

    def enter(self, identity: Identity, key: OwnKey | None, taken: ExistingResult) -> None:
        """Note a new holder, so that later submissions find it."""
        self.identities[identity] = taken
        if key is not None:
            self.keys[key] = taken


def look_up(
    connection: Connection, identities: Collection[Identity], keys: Collection[OwnKey] = ()
) -> Registry:
    """The recorded results of these identities and keys."""
    registry = Registry()
    dialect = dialect_of(connection)
    if identities:
        rows = _rows(connection, _known_by_identity(dialect), identities)
        for spacecraft, run, batch, id, fingerprint, archived in rows:
            found = ExistingResult(id, fingerprint, bool(archived))
            registry.identities[spacecraft, run, batch] = found
    if keys:
        rows = _rows(connection, _by_key(dialect), keys)
        registry.keys = {
            (token_id, key): ExistingResult(id, fingerprint)
            for token_id, key, id, fingerprint in rows
        }
    return registry


def require_not_archived(connection: Connection, identities: Collection[Identity]) -> None:
    """Raise `ArchivedMeanwhile` if one of the batches that were just inserted is archived.

    The insert waits for a transaction that archives the same batch, and this sees its end.
    """
    if identities and _rows(connection, _archived(dialect_of(connection)), identities):
        raise ArchivedMeanwhile


def _rows(connection: Connection, sql: str, wanted: Collection[object]) -> Sequence[Any]:
    return execute(connection, sql, {"wanted": msgspec.json.encode(list(wanted)).decode()})


def remember_keys(
    connection: Connection, keys: Sequence[tuple[Identity, OwnKey, ExistingResult]]
) -> list[AcquisitionError | None]:
    """Give keys to bodies that are recorded without them; the error of each that another has."""
    outcomes: list[AcquisitionError | None] = []
    for identity, key, taken in keys:
        holder = look_up(connection, (), [key]).holder(identity, key, taken.fingerprint)
        outcomes.append(holder if isinstance(holder, AcquisitionError) else None)
        if holder is None:
            connection.execute(insert(tables.idempotency_keys), key_row(key, taken))
    return outcomes


def key_row(key: OwnKey, taken: ExistingResult) -> dict[str, str]:
    """A row of the table of keys."""
    token_id, name = key
    return {
        "token_id": token_id,
        "key": name,
        "fingerprint": taken.fingerprint,
        "result_id": taken.result_id,
    }


def stored_answers(connection: Connection, ids: Collection[str]) -> dict[str, bytes]:
    """The answers of recorded results, byte for byte as first sent."""
    sql = f"SELECT id, answer FROM results WHERE id IN ({dialect_of(connection).wanted_texts})"
    rows = _rows(connection, sql, ids) if ids else ()
    return {id: unpack(answer).encode() for id, answer in rows}


# The wanted identities and keys are one JSON value, so that the text of each statement never
# changes: compiling a statement for many values takes longer than running it.


@cache
def _known_by_identity(dialect: Dialect) -> str:
    # One statement sees one moment: a batch that is being archived is found in one of the two.
    return f"{_by_identity(dialect, 'batches', archived=0)} UNION ALL {_archived(dialect)}"


@cache
def _archived(dialect: Dialect) -> str:
    return _by_identity(dialect, "archived_batches", archived=1)


def _by_identity(dialect: Dialect, table: str, archived: int) -> str:
    item = dialect.item
    return f"""
        SELECT b.spacecraft, b.run, b.batch, b.id, b.fingerprint, {archived}
        FROM {dialect.wanted} CROSS JOIN {table} AS b
        WHERE b.spacecraft = {item(0)} AND b.run = {item(1)} AND b.batch = {item(2)}
    """


@cache
def _by_key(dialect: Dialect) -> str:
    return f"""
        SELECT k.token_id, k.key, k.result_id, k.fingerprint
        FROM {dialect.wanted} CROSS JOIN idempotency_keys AS k
        WHERE k.token_id = {dialect.item(0)} AND k.key = {dialect.item(1)}
    """


# ---- digests ----------------------------------------------------------------------------------

BYTES = 8
SETTINGS = (tables.missions, tables.catalogs, tables.mission_uses)
"""The tables whose rows have a digest each, `row_digest`."""
_NO_CONTENT = ("results.current", "results.seq", "results.digest", "mission_uses.id")
"""Columns without content: the mark of the current result, places in an order, digests."""

_encode = msgspec.json.Encoder().encode
_in_order = itemgetter("tracker", "position")


def digest_of(
    result: Row,
    stars: Sequence[Row],
    solution: Row | None,
    batch: Row | None = None,
    frame: Row | None = None,
) -> int:
    """The digest of the rows of a result, 63 bits of BLAKE2b; see `encoded_rows`."""
    return digest_of_encoded(encoded_rows(result, stars, solution, batch, frame))


def digest_of_encoded(encoded: bytes) -> int:
    """`digest_of` of rows that are encoded already."""
    return int.from_bytes(blake2b(encoded, digest_size=BYTES).digest(), "big") >> 1


def encoded_rows(
    result: Row,
    stars: Sequence[Row],
    solution: Row | None,
    batch: Row | None = None,
    frame: Row | None = None,
) -> bytes:
    """The rows of a result as bytes, the same from any database.

    `batch` and `frame` are given for the first result of a batch, and not for a what-if.
    """
    content: list[object] = [
        _content(tables.results)(result),
        sorted(map(_content(tables.star_results), stars), key=_in_order),
    ]
    for table, row in (
        (tables.solutions, solution),
        (tables.batches, batch),
        (tables.frames, frame),
    ):
        content.append(None if row is None else _content(table)(row))
    return _encode(content)


def digest_of_row(table: Table, row: Row) -> int:
    """The digest of a row of `SETTINGS` or `tracker_values`."""
    return digest_of_encoded(_encode(_content(table)(row)))


def made_later(digest: int) -> int:
    """The digest as it is kept where it was made after the result: at an upgrade."""
    return ~digest


def agrees(stored: int | None, digest: int) -> bool:
    """True if a digest that is kept, if any, is this one, whenever it was made."""
    return stored in (None, digest, made_later(digest))


@cache
def _content(table: Table) -> Callable[[Row], dict[str, object]]:
    """A function that gives the content of a row as it comes back from any database."""
    columns = [
        (each.name, isinstance(each.type, Double))
        for each in table.columns
        if each.name != "row_digest" and f"{table.name}.{each.name}" not in _NO_CONTENT
    ]

    def content(row: Row) -> dict[str, object]:
        # SQLite has no minus zero, and a whole number comes back as a float.
        return {
            name: float(value) + 0.0 if is_double else value
            for name, is_double in columns
            if (value := row[name]) is not None
        }

    return content
