"""Command `acquire record`: signed heads of the record, and proofs that it contains a result."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from service.cli import arguments
from service.cli.arguments import settings_of_existing

PUBLIC_KEY = "the public key (PEM) of the key that signs the heads"


def add(commands: Any) -> None:
    """Declare the command `record` with its subcommands."""
    group = arguments.add_group(
        commands,
        "record",
        "Signed heads of the record, and proofs that a result is in it.",
        """
        acquire record key record.pem > record.pub.pem
        acquire record head >> heads.log
        acquire database verify --public-key record.pub.pem --head heads.log
        """,
    )
    parser = arguments.add_command(group, "key", key)
    parser.add_argument("file", type=Path, metavar="FILE", help="must not exist yet")
    parser = arguments.add_command(group, "head", head)
    arguments.add_database(parser)
    parser = arguments.add_command(group, "prove", prove)
    parser.add_argument("result", metavar="ID", help="the id of a batch or a result")
    arguments.add_database(parser)
    parser = arguments.add_command(group, "check", check)
    parser.add_argument("proof", type=Path, metavar="PROOF")
    parser.add_argument("--public-key", type=Path, metavar="FILE", help=PUBLIC_KEY)
    parser.add_argument("--answer", type=Path, metavar="FILE", help="the answer as it was sent")


def key(parsed: Namespace) -> int:
    """Make a private key for the setting ACQUIRE_RECORD_KEY, and print its public key.

    acquire record key record.pem > record.pub.pem
    """
    from service.storage.recording.signing import make_key

    print(make_key(parsed.file), end="")
    return 0


def head(parsed: Namespace) -> int:
    """Print the last head: its number, its SHA-256 and when it was made.  Keep it where nobody who
    can write to the database can: `acquire database verify --head` compares.

    acquire record head
    """
    from service.storage.projections.heads import require_head
    from service.storage.sql.migrations import reading

    with reading(settings_of_existing(parsed).database) as connection:
        print(require_head(connection).text)
    return 0


def prove(parsed: Namespace) -> int:
    """Print a proof that a result is in the record, as JSON of at most 2 kB.  With the answer, the
    proof and the public key it is checked without the database.

    acquire record prove 01JD0000000000000000000000 > proof.json
    """
    import msgspec

    from service.storage.sql.migrations import reading
    from service.storage.upkeep import proofs

    with reading(settings_of_existing(parsed).database) as connection:
        proof = proofs.prove(connection, parsed.result)
    print(msgspec.json.encode(proof).decode())
    return 0


def check(parsed: Namespace) -> int:
    """Check a proof; exit code 1 if it does not hold.

    acquire record check proof.json --public-key record.pub.pem --answer answer.json
    """
    from service.storage.recording.signing import PublicKey
    from service.storage.upkeep import proofs

    proof = proofs.read_proof(parsed.proof)
    public_key = None if parsed.public_key is None else PublicKey(parsed.public_key)
    answer = None if parsed.answer is None else parsed.answer.read_bytes()
    faults = proofs.faults_of(proof, public_key, answer)
    for fault in faults:
        print(fault)
    if faults:
        return 1
    print(f"the record has result {proof.result}")
    if public_key is None:
        print("the signature was not checked: --public-key")
    return 0
