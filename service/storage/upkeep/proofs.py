"""Proofs that a result is in the record, which can be checked years later without the database."""

import hashlib
from pathlib import Path

import msgspec
import sqlalchemy as sa

from service.errors import BadConfiguration, NotFound
from service.storage.projections import heads
from service.storage.recording import chain
from service.storage.recording.chain import Statement
from service.storage.recording.signing import PublicKey
from service.storage.sql.chain_tables import record_heads, record_leaves
from service.storage.sql.statements import rows_of
from service.storage.sql.tables import results
from service.storage.upkeep.verify_chain import bound_by


class Proof(msgspec.Struct, kw_only=True):
    """An inclusion proof of a result; digests are in hexadecimal digits."""

    result: str
    """Id of the result whose inclusion in the record is proven."""
    answer_sha256: str
    """SHA-256 of the answer, byte for byte as sent."""
    content: str
    """BLAKE2b (32 bytes) over all rows of the result."""
    adopted: bool
    """True if the result was current when it was recorded."""
    index: int
    """Index of the result's leaf in the Merkle tree of the head."""
    size: int
    """Number of leaves in the Merkle tree of the head."""
    path: list[str]
    """Audit path of the leaf, from below (RFC 6962)."""
    statement: str
    """Statement of the head, whose `root` the audit path leads to."""
    signature: str | None
    """Ed25519 signature of the statement; None if the head is not signed."""


def prove(connection: sa.Connection, id: str) -> Proof:
    """Build the inclusion proof of a recorded result; raises `NotFound` if not in a head yet."""
    query = sa.select(results, record_leaves.c.leaf).join_from(
        results, record_leaves, results.c.seq == record_leaves.c.seq
    )
    rows = rows_of(connection, query.where(results.c.id == id))
    if not rows:
        raise NotFound(f"result {id}: it is not in the database, or has no leaf yet")
    ((row, content),) = heads.contents(connection, rows)
    before = heads.NOTHING
    stored = rows_of(connection, sa.select(record_heads).order_by(record_heads.c.number))
    for each in stored:
        head = msgspec.json.decode(each["statement"], type=Statement)
        place = row["seq"]
        if before.last < place <= head.last or head.first <= place < min(before.first, 0):
            break
        before = head
    else:
        raise NotFound(f"result {id}: no head has it yet; one is made each minute")
    bound, facts = bound_by(connection, before, head)
    leaves = heads.leaves_of(bound, facts)
    index = [place for place, _ in bound].index(row["seq"])
    digest = chain.digest_of_content(content)
    answer_sha256 = hashlib.sha256(row["answer"].encode()).digest()
    adopted = leaves[index] == chain.leaf_of_hashes(id, answer_sha256, digest, True)
    return Proof(
        result=id,
        answer_sha256=answer_sha256.hex(),
        content=digest.hex(),
        adopted=adopted,
        index=index,
        size=len(leaves),
        path=[each.hex() for each in chain.path_to(leaves, index)],
        statement=each["statement"],
        signature=each["signature"],
    )


def read_proof(file: Path) -> Proof:
    """Read a proof from its file; raises `BadConfiguration` for any other file."""
    try:
        return msgspec.json.decode(file.read_bytes(), type=Proof)
    except msgspec.MsgspecError as error:
        raise BadConfiguration(f"{file}: is no proof: {error}") from None


def faults_of(
    proof: Proof, public_key: PublicKey | None = None, answer: bytes | None = None
) -> list[str]:
    """Sentences on each fault of a proof: its path, and the answer and public key if given."""
    found = []
    if answer is not None and hashlib.sha256(answer).hexdigest() != proof.answer_sha256:
        found.append("the answer is not the one that was recorded")
    try:
        hashes = bytes.fromhex(proof.answer_sha256), bytes.fromhex(proof.content)
        leaf = chain.leaf_of_hashes(proof.result, *hashes, proof.adopted)
        path = [bytes.fromhex(each) for each in proof.path]
        root = msgspec.json.decode(proof.statement, type=Statement).root
    except (ValueError, msgspec.MsgspecError):
        return [*found, "it cannot be read"]
    reached = chain.root_from(leaf, proof.index, proof.size, path)
    if reached is None or reached.hex() != root:
        found.append("the head does not have the result")
    if public_key is not None and not public_key.has_signed(
        proof.statement.encode(), proof.signature
    ):
        found.append("the head is not signed with this key")
    return found
