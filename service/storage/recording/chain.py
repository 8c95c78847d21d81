"""Chain of the record: definition and hashing of its leaves, facts and heads.

Every result has a leaf, a hash over all that is kept of it.  Rows of other tables have facts.  A
head is a statement over the leaves and facts since the head before it: their number, the root of a
Merkle tree over them (RFC 6962, section 2.1, with SHA-256), and the hash of the head before.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

import msgspec
from sqlalchemy import Connection, Double, LargeBinary, Table, insert, select

from service.storage.sql import definitive_tables, tables
from service.storage.sql.chain_tables import record_facts
from service.storage.sql.columns import BOUND, Bound, Row
from service.storage.sql.migrations import all_tables
from service.storage.sql.statements import rows_of

LEAF_BYTES = 16
"""Length of a leaf in bytes: to find another record with the same leaf takes 2^128 trials."""
HELD_BYTES, LARGE_BYTES = 2_047, 65_536
"""Largest input that Python hashes without releasing its lock, and largest hashed in pieces.

Taking the lock back takes the writer longer than a hash of fewer than `LARGE_BYTES`.
"""

_encode = msgspec.json.Encoder(order="sorted").encode


class Statement(msgspec.Struct, frozen=True, kw_only=True):
    """Statement of a head of the record; its JSON with sorted names is hashed and signed."""

    version: int = 1
    number: int
    previous: str
    """SHA-256 of the statement of the head before in hexadecimal digits; empty in the first one."""
    made: str
    """UTC at which the head of the record was made."""
    first: int
    """Lowest place of a result with a leaf; negative: recorded before there was a chain."""
    last: int
    """Highest place of a result with a leaf."""
    counts: dict[str, int]
    """Number of leaves and facts since the preceding head, by kind."""
    root: str
    """Root of the Merkle tree over the leaves and facts, in hexadecimal digits."""

    def encoded(self) -> bytes:
        """Bytes of the statement that are hashed and signed."""
        return _encode(self)


def sha256_of(statement: Statement) -> str:
    """SHA-256 of a statement, by which the next statement and outside parties refer to it."""
    return hashlib.sha256(statement.encoded()).hexdigest()


def leaf_of(id: str, answer: str, content: bytes, adopted: bool) -> bytes:
    """Leaf of a result, a hash over its id, its answer as sent, and the encoding of all its rows.

    `adopted` is True if the result was current when it was recorded.
    """
    answer_sha256 = _hashed(hashlib.sha256(), answer.encode())
    return leaf_of_hashes(id, answer_sha256, digest_of_content(content), adopted)


def digest_of_content(content: bytes) -> bytes:
    """BLAKE2b hash (32 bytes) of the encoding of all rows of a result."""
    return _hashed(hashlib.blake2b(digest_size=32), content)


def _hashed(state: Any, content: bytes) -> bytes:
    """Add content to a hash, with Python's lock held if small; returns the digest."""
    view = memoryview(content)
    step = HELD_BYTES if len(content) <= LARGE_BYTES else len(content)
    for first in range(0, len(content), step):
        state.update(view[first : first + step])
    digest: bytes = state.digest()
    return digest


def leaf_of_hashes(id: str, answer_sha256: bytes, content: bytes, adopted: bool) -> bytes:
    """Leaf of a result from the hashes of its answer and of its content; see `leaf_of`."""
    mark = b"\x01" if adopted else b"\x00"
    whole = b"result\x00" + id.encode() + b"\x00" + mark + answer_sha256 + content
    return hashlib.sha256(whole).digest()[:LEAF_BYTES]


def leaf_of_fact(kind: str, key: str, sha256: str) -> bytes:
    """Leaf of a fact: a hash over the table and action, the row's key, and the row's SHA-256."""
    whole = f"fact\x00{kind}\x00{key}\x00{sha256}".encode()
    return hashlib.sha256(whole).digest()[:LEAF_BYTES]


# ---- Merkle trees (RFC 6962, section 2.1) -------------------------------------------------------


def root_of(leaves: Sequence[bytes]) -> bytes:
    """Root of the Merkle tree over leaves in order; the hash of the empty string without leaves."""
    if not leaves:
        return hashlib.sha256(b"").digest()
    level = [_of_leaf(each) for each in leaves]
    while len(level) > 1:
        level = _above(level)
    return level[0]


def path_to(leaves: Sequence[bytes], index: int) -> list[bytes]:
    """Audit path of a leaf: the sibling hashes from the leaf up to the root of the Merkle tree."""
    level, path = [_of_leaf(each) for each in leaves], []
    while len(level) > 1:
        beside = index ^ 1
        if beside < len(level):
            path.append(level[beside])
        level, index = _above(level), index // 2
    return path


def root_from(leaf: bytes, index: int, size: int, path: Iterable[bytes]) -> bytes | None:
    """Root of a Merkle tree from a leaf and an audit path (RFC 9162, 2.1.3.2); None if invalid."""
    if not 0 <= index < size:
        return None
    last, found = size - 1, _of_leaf(leaf)
    for beside in path:
        if not last:
            return None
        if index & 1 or index == last:
            found = _of_pair(beside, found)
            while not index & 1 and index:
                index, last = index >> 1, last >> 1
        else:
            found = _of_pair(found, beside)
        index, last = index >> 1, last >> 1
    return found if not last else None


def _of_leaf(leaf: bytes) -> bytes:
    return hashlib.sha256(b"\x00" + leaf).digest()


def _of_pair(left: bytes, right: bytes) -> bytes:
    return hashlib.sha256(b"\x01" + left + right).digest()


def _above(level: Sequence[bytes]) -> list[bytes]:
    """Next level of a Merkle tree; an unpaired hash moves up unchanged."""
    pairs = zip(level[::2], level[1::2], strict=False)
    found = [_of_pair(left, right) for left, right in pairs]
    return [*found, level[-1]] if len(level) % 2 else found


# ---- facts of other tables ---------------------------------------------------------------------


_OF_PROGRESS = frozenset(("state", "done", "total", "result", "covariance", "fault"))
_DIGESTED = Bound(frozenset({"row_digest"}), rises=False)
_OWN: Mapping[Table, Bound] = {
    tables.missions: _DIGESTED,
    tables.catalogs: _DIGESTED,
    tables.mission_uses: Bound(frozenset({"row_digest"})),
    tables.audit: Bound(),
    tables.access_tokens: Bound(closed_by="revoked"),
    tables.calibrations: Bound(closed_by="ended", open_free=_OF_PROGRESS),
    tables.calibration_adoptions: Bound(),
    tables.annotations: Bound(),
    definitive_tables.graded_days: Bound(frozenset({"current"})),
    tables.gyro_blocks: Bound(),
}


@cache
def bound_tables() -> Mapping[Table, Bound]:
    """Tables whose rows get a fact in the chain when added, and when their `closed_by` is set.

    Tables of features declare this in their `info`.  Code that otherwise changes or removes such a
    row calls `note_changed` or `note_removed`.  A fact covers texts and numbers; it leaves out
    binary columns, since another column has their digest.
    """
    declared = {each: each.info.get(BOUND) for each in all_tables()}
    for table, bound in declared.items():
        if isinstance(bound, Bound) and bound.rises and len(table.primary_key) != 1:
            raise ValueError(f"{table.name}: a table whose rows are facts needs one key column")
    return {**_OWN, **{table: one for table, one in declared.items() if isinstance(one, Bound)}}


RESULTS, REMOVED = "results", "results.removed"


def key_of(table: Table, row: Row) -> str:
    """Key that names a table's row in its facts: the values of its primary key."""
    return " ".join(str(row[column.name]) for column in table.primary_key)


def content_of(table: Table, row: Row, *, closed: bool = False) -> str:
    """SHA-256 of the columns of a row that its fact covers, in hexadecimal digits."""
    bound = bound_tables()[table]
    left_out = bound.free if closed else bound.free | bound.open_free | {bound.closed_by}
    content = {
        column.name: float(value) + 0.0 if isinstance(column.type, Double) else value
        for column in table.columns
        if column.name not in left_out
        and not isinstance(column.type, LargeBinary)
        and (value := row[column.name]) is not None
    }
    return hashlib.sha256(_encode(content)).hexdigest()


def note_changed(connection: Connection, table: Table, id: str) -> None:
    """Add a fact to the chain for a row whose content has changed."""
    (key,) = table.primary_key
    for row in rows_of(connection, select(table).where(key == id)):
        _note(connection, [(table.name, key_of(table, row), content_of(table, row))])


def note_removed(connection: Connection, table: Table, ids: Sequence[object]) -> None:
    """Add a fact to the chain for each row that is about to be deleted."""
    _note(connection, [(table.name, str(id), "") for id in ids])


def note_results_removed(connection: Connection, batch_ids: Sequence[str]) -> None:
    """Add a fact with the places of all results of batches that are about to be deleted."""
    query = select(tables.results.c.seq).where(tables.results.c.batch_id.in_(batch_ids))
    ranges: list[list[int]] = []
    for place in sorted(set(connection.scalars(query)) - {0}):
        if ranges and ranges[-1][1] == place - 1:
            ranges[-1][1] = place
        else:
            ranges.append([place, place])
    if ranges:
        key = _encode(ranges).decode()
        _note(connection, [(REMOVED, key, hashlib.sha256(key.encode()).hexdigest())])


def _note(connection: Connection, facts: Sequence[tuple[str, str, str]]) -> None:
    rows = [{"kind": kind, "key": key, "sha256": sha256} for kind, key, sha256 in facts]
    if rows:
        connection.execute(insert(record_facts), rows)
