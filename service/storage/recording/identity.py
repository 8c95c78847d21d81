"""Identities of recorded batches, Idempotency-Keys, and digests over recorded rows.

`verify` computes the digests again, of each result and of each row of settings that it names, and
finds any digit changed later in an answer, an input, a column or a star.  A digest leaves null
columns out, so that a column added by a later version changes no earlier digest.
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
"""Identity of a batch, unique among submissions: (spacecraft, run, batch)."""

OwnKey = tuple[str, str]
"""Id of a token and an Idempotency-Key: the same key of another token is a different key.

The id is empty for a key that came without a token.
"""


class ExistingResult(Struct, frozen=True):
    """Recorded result for an identity or a key, with the fingerprint of its body."""

    result_id: str
    fingerprint: str
    archived: bool = False
    """True if the result's batch is in the archive."""


class PredictionOutdated(Busy):
    """Error: another service recorded a later attitude than the one a batch was predicted from."""


class ArchivedMeanwhile(Exception):
    """Error: another process archived, just now, a batch that was to be recorded as new."""


def identity_of(batch: ObservationBatch) -> Identity:
    """The identity of a batch, which is unique among submissions."""
    return batch.spacecraft, batch.run, batch.batch


@dataclass
class Registry:
    """Recorded results by batch identity and by Idempotency-Key."""

    identities: dict[Identity, ExistingResult] = field(default_factory=dict)
    keys: dict[OwnKey, ExistingResult] = field(default_factory=dict)

    def holder(
        self, identity: Identity, key: OwnKey | None, fingerprint: str
    ) -> ExistingResult | KeyReused | Conflict | None:
        """Find the recorded result with this body; None if new, an error if name or key is taken.

        The error is `KeyReused` where the key belongs to another body, which is checked first, and
        `Conflict` where the identity does.
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
        """Note a new result under its identity and key, so that later submissions find it."""
        self.identities[identity] = taken
        if key is not None:
            self.keys[key] = taken


def look_up(
    connection: Connection, identities: Collection[Identity], keys: Collection[OwnKey] = ()
) -> Registry:
    """Look up the recorded results that hold the given batch identities and Idempotency-Keys."""
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
    """Raise `ArchivedMeanwhile` if one of the batches just inserted is archived.

    The insert waits for a transaction that archives the same batch, and the check then sees its
    outcome.
    """
    if identities and _rows(connection, _archived(dialect_of(connection)), identities):
        raise ArchivedMeanwhile


def _rows(connection: Connection, sql: str, wanted: Collection[object]) -> Sequence[Any]:
    return execute(connection, sql, {"wanted": msgspec.json.encode(list(wanted)).decode()})


def remember_keys(
    connection: Connection, keys: Sequence[tuple[Identity, OwnKey, ExistingResult]]
) -> list[AcquisitionError | None]:
    """Store Idempotency-Keys for recorded results; an error for each that is taken, else None."""
    outcomes: list[AcquisitionError | None] = []
    for identity, key, taken in keys:
        holder = look_up(connection, (), [key]).holder(identity, key, taken.fingerprint)
        outcomes.append(holder if isinstance(holder, AcquisitionError) else None)
        if holder is None:
            connection.execute(insert(tables.idempotency_keys), key_row(key, taken))
    return outcomes


def key_row(key: OwnKey, taken: ExistingResult) -> dict[str, str]:
    """Database row that assigns an Idempotency-Key to a result."""
    token_id, name = key
    return {
        "token_id": token_id,
        "key": name,
        "fingerprint": taken.fingerprint,
        "result_id": taken.result_id,
    }


def stored_answers(connection: Connection, ids: Collection[str]) -> dict[str, bytes]:
    """Answers of recorded results by id, byte for byte as first sent."""
    sql = f"SELECT id, answer FROM results WHERE id IN ({dialect_of(connection).wanted_texts})"
    rows = _rows(connection, sql, ids) if ids else ()
    return {id: unpack(answer).encode() for id, answer in rows}


# The wanted identities and keys are one JSON value, so that the text of each statement never
# changes: compiling a statement for many values takes longer than running it.


@cache
def _known_by_identity(dialect: Dialect) -> str:
    # A single statement sees a single moment: a batch being archived is found in one of both
    # tables.
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
"""Tables of mission settings, their uses, and catalogs; each row has a digest (`row_digest`)."""
_NO_CONTENT = ("results.current", "results.seq", "results.digest", "mission_uses.id")
"""Columns that digests leave out: those that change, give an order, or hold a digest."""

_encode = msgspec.json.Encoder().encode
_in_order = itemgetter("tracker", "position")


def digest_of(
    result: Row,
    stars: Sequence[Row],
    solution: Row | None,
    batch: Row | None = None,
    frame: Row | None = None,
) -> int:
    """Digest over all rows of a result, 63 bits of BLAKE2b; see `encoded_rows`."""
    return digest_of_encoded(encoded_rows(result, stars, solution, batch, frame))


def digest_of_encoded(encoded: bytes) -> int:
    """Digest of the encoded rows of a result, 63 bits of BLAKE2b."""
    return int.from_bytes(blake2b(encoded, digest_size=BYTES).digest(), "big") >> 1


def encoded_rows(
    result: Row,
    stars: Sequence[Row],
    solution: Row | None,
    batch: Row | None = None,
    frame: Row | None = None,
) -> bytes:
    """Encode the rows of a result as bytes, the same from any database.

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
    """Digest over a row of `SETTINGS` or `tracker_values`."""
    return digest_of_encoded(_encode(_content(table)(row)))


def made_later(digest: int) -> int:
    """Stored form of a digest computed later than its result was recorded, at an upgrade."""
    return ~digest


def agrees(stored: int | None, digest: int) -> bool:
    """True if no digest is stored, or the stored one equals `digest`, in either stored form."""
    return stored in (None, digest, made_later(digest))


@cache
def _content(table: Table) -> Callable[[Row], dict[str, object]]:
    """Build a function that extracts a table row's content, the same from any database."""
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
