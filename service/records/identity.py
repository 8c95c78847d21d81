"""Who was first: which batches and Idempotency-Keys are recorded, and with what body."""

from collections.abc import Collection
from dataclasses import dataclass, field

from sqlalchemy import Connection, bindparam, insert, select, tuple_

from service.errors import Conflict, KeyReused, shown_value
from service.records.tables import batches, idempotency_keys, results

Identity = tuple[str, str, str]
"""(spacecraft, run, batch): unique among submissions."""

# SQLite takes 32,766 values in a statement, three to an identity.
_LOOKED_UP_AT_ONCE = 5_000

_IDENTITY = (batches.c.spacecraft, batches.c.run, batches.c.batch)
_BY_IDENTITY = select(*_IDENTITY, batches.c.id, batches.c.fingerprint).where(
    tuple_(*_IDENTITY).in_(bindparam("identities", expanding=True))
)
_BY_KEY = select(
    idempotency_keys.c.key, idempotency_keys.c.result_id, idempotency_keys.c.fingerprint
).where(idempotency_keys.c.key.in_(bindparam("keys", expanding=True)))
_ANSWERS = select(results.c.id, results.c.answer).where(
    results.c.id.in_(bindparam("ids", expanding=True))
)


@dataclass(frozen=True)
class Taken:
    """The result that holds an identity or a key, and the fingerprint of its body."""

    result_id: str
    fingerprint: str


@dataclass
class Registry:
    """What is already there of some identities and keys."""

    identities: dict[Identity, Taken] = field(default_factory=dict)
    keys: dict[str, Taken] = field(default_factory=dict)

    def first(self, identity: Identity, key: str | None, fingerprint: str) -> Taken | None:
        """Who recorded this body before; None: nobody did.

        Raises `KeyReused` where the key belongs to another body, which is
        looked at first, and `Conflict` where the identity does.
        """
        by_key = None if key is None else self.keys.get(key)
        if by_key is not None:
            if by_key.fingerprint != fingerprint:
                raise KeyReused(f"Idempotency-Key {shown_value(key)} was used with another body")
            return by_key
        by_identity = self.identities.get(identity)
        if by_identity is not None and by_identity.fingerprint != fingerprint:
            spacecraft, run, batch = identity
            raise Conflict(
                f"{spacecraft}, run {run}: batch {shown_value(batch)} is recorded with another body"
            )
        return by_identity

    def enter(self, identity: Identity, key: str | None, taken: Taken) -> None:
        """Note a new holder, so that whoever comes next finds it."""
        self.identities[identity] = taken
        if key is not None:
            self.keys[key] = taken


def look_up(
    connection: Connection, identities: Collection[Identity], keys: Collection[str] = ()
) -> Registry:
    """What is recorded under these identities and keys."""
    registry = Registry()
    wanted = list(identities)
    for first in range(0, len(wanted), _LOOKED_UP_AT_ONCE):
        part = {"identities": wanted[first : first + _LOOKED_UP_AT_ONCE]}
        for spacecraft, run, batch, id, fingerprint in connection.execute(_BY_IDENTITY, part):
            registry.identities[spacecraft, run, batch] = Taken(id, fingerprint)
    if keys:
        rows = connection.execute(_BY_KEY, {"keys": list(keys)})
        registry.keys = {key: Taken(id, fingerprint) for key, id, fingerprint in rows}
    return registry


def remember_key(connection: Connection, identity: Identity, key: str, taken: Taken) -> None:
    """Give a key to a body that is recorded without it; raises `KeyReused` if another has it."""
    if look_up(connection, (), [key]).first(identity, key, taken.fingerprint) is None:
        row = {"key": key, "fingerprint": taken.fingerprint, "result_id": taken.result_id}
        connection.execute(insert(idempotency_keys), row)


def stored_answers(connection: Connection, ids: Collection[str]) -> dict[str, bytes]:
    """The answers of recorded results, byte for byte as first sent."""
    rows = connection.execute(_ANSWERS, {"ids": list(ids)}) if ids else ()
    return {id: answer.encode() for id, answer in rows}
