"""The tables of the chain: one append-only sequence of all recorded facts, and its heads.

record_leaves    one for each result, written with it and never deleted
record_facts     rows of other tables that were added, closed, changed or removed
record_heads     one statement over the leaves and facts since the one before, perhaps signed
"""

import sqlalchemy as sa

from service.storage.sql.columns import Moment, metadata

record_leaves = sa.Table(
    "record_leaves",
    metadata,
    # Order of the result in the record (`results.seq`); negative: recorded before there was a
    # chain.
    sa.Column(
        "seq",
        sa.BigInteger().with_variant(sa.Integer, "sqlite"),
        primary_key=True,
        autoincrement=False,
    ),
    # SHA-256 digest of the result's rows, see `recording.chain.leaf_of`.
    sa.Column("leaf", sa.LargeBinary, nullable=False),
)

record_facts = sa.Table(
    "record_facts",
    metadata,
    sa.Column("id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True),
    # The table and the action on the row: added, closed, changed or removed.
    sa.Column("kind", sa.String(64), nullable=False),
    sa.Column("key", sa.Text, nullable=False),
    # SHA-256 of the row's content, in hexadecimal digits; empty for a removed row.
    sa.Column("sha256", sa.String(64), nullable=False),
    # Number of the head that covers the fact; null until a head is made.
    sa.Column("head", sa.BigInteger),
    sa.Index("ix_record_facts_kind", "kind", "key"),
    sa.Index("ix_record_facts_head", "head"),
)

record_heads = sa.Table(
    "record_heads",
    metadata,
    # Consecutive number of the head, from 1.
    sa.Column(
        "number",
        sa.BigInteger().with_variant(sa.Integer, "sqlite"),
        primary_key=True,
        autoincrement=False,
    ),
    sa.Column("made", Moment, nullable=False),
    # JSON text of the head, byte for byte as signed.
    sa.Column("statement", sa.Text, nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False),
    # Ed25519 signature in hexadecimal digits; null if the service has no key.
    sa.Column("signature", sa.String(128)),
)
