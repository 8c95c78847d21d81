"""The chain of the record: what a person changes in the tables is found and named."""

import hashlib
import json
import re
import subprocess
from contextlib import closing, contextmanager

import pytest
from sqlalchemy import create_engine, select, text, update

from service.errors import BadConfiguration
from service.observations.schema import OptionsIn
from service.storage.recording import chain
from service.storage.recording.signing import PublicKey, Signer, make_key
from service.storage.sql.chain_tables import record_facts, record_heads, record_leaves
from service.storage.sql.columns import BOUND, metadata
from service.storage.sql.engines import database_url
from service.storage.sql.migrations import all_tables
from service.storage.sql.tables import results
from service.storage.upkeep import proofs, verify_chain
from service.storage.upkeep.prune import prune
from service.storage.upkeep.verify import verify
from service.times import shifted
from tests.storage.samples import START

pytestmark = pytest.mark.both_databases

LATER = shifted(START, 30 * 86_400.0)
TIGHT = OptionsIn.model_validate({"identifier": "starid", "tolerances": {"separation_deg": 1e-5}})


@pytest.fixture
def key(tmp_path):
    """A private key and the file of its public key."""
    (tmp_path / "public.pem").write_text(make_key(tmp_path / "key.pem"))
    return tmp_path / "key.pem", tmp_path / "public.pem"


@pytest.fixture
def sealed(opened, make, key, database):
    """A database with results of every kind and rows of other tables, all in signed heads."""
    app = opened(record_key=str(key[0]))
    ids = [
        app.submissions.submit(make(f"b{k}", kind=kind, after_s=6_000.0 * k)).id
        for k, kind in enumerate(("good", "suspect", "one_star", "spurious", "good", "good"))
    ]
    app.projector.make_heads()
    app.results.what_if(ids[0], TIGHT, adopt=True)
    app.results.what_if(ids[1], TIGHT, record=True)
    with changing(database) as connection:
        # As the service writes them; people would have to wait for its routes here.
        moment = START.text
        for table, row in ROWS.items():
            names = ", ".join(f'"{name}"' for name in row)
            values = ", ".join(f":{name}" for name in row)
            statement = text(f"INSERT INTO {table} ({names}) VALUES ({values})")
            connection.execute(statement, {n: v or moment for n, v in row.items()})
    app.projector.make_heads()
    app.close()
    return app


ID = "01JD000000000000000000000{}"
ROWS = {
    "audit": {"id": ID.format(1), "moment": "", "who": "A", "action": "x", "about": "y"},
    "access_tokens": {"id": ID.format(2), "name": "A", "digest": "d", "scopes": "read"}
    | {"created": "", "expires": ""},
    "limits": {"spacecraft": "XTE", "quantity": "unique", "who": "A", "since": ""},
    "annotations": {"id": ID.format(3), "spacecraft": "XTE", "start": "", "start_ns": 1}
    | {"end_ns": 2, "text": "a note", "who": "A", "created": ""},
    "webhooks": {"id": ID.format(4), "name": "w", "url": "https://x.example/", "enabled": True}
    | {"who": "A", "created": "", "secret": "s", "position": 1},
}


@contextmanager
def changing(database):
    """A connection of a person with access to the database."""
    engine = create_engine(database_url(database))
    with engine.begin() as connection:
        yield connection
    engine.dispose()


@pytest.fixture
def faults(database, key):
    """Faults of the database, with the key; `faults(public=False)` without."""

    def found(public=True, anchors=()):
        return verify(database, public_key=PublicKey(key[1]) if public else None, anchors=anchors)

    return found


CHANGES = {
    "a digest that is missing": "UPDATE results SET digest = NULL WHERE status = 'good'",
    "a place that is missing": "UPDATE results SET seq = 0, digest = NULL WHERE status = 'suspect'",
    "an answer": "UPDATE results SET reason = 'x' WHERE status IS NULL",
    "an attitude": "UPDATE solutions SET q1 = q1 + 1e-9",
    "a covariance": "UPDATE solutions SET p11 = p11 * 1.000000000001",
    "a star": "UPDATE star_results SET votes = votes + 1",
    "an outcome": "UPDATE star_results SET outcome = 'unmatched' WHERE outcome = 'unique'",
    "the time of receipt": "UPDATE batches SET received = '2001-01-01T00:00:00Z'",
    "a mission": "UPDATE missions SET settings = settings || ' '",
    "a mission and its digest": "UPDATE missions SET spacecraft = 'X', row_digest = NULL",
    "a use of a mission": "UPDATE mission_uses SET since = '1990-01-01', row_digest = NULL",
    "the digest of a use": "UPDATE mission_uses SET row_digest = NULL",
    "a use that is removed": "DELETE FROM mission_uses",
    "a catalog": "UPDATE catalogs SET name = 'x', row_digest = NULL",
    "the audit list": "UPDATE audit SET who = 'B'",
    "an entry that is removed": "DELETE FROM audit",
    "a token's scopes": "UPDATE access_tokens SET scopes = 'read operate'",
    "a token's end": "UPDATE access_tokens SET expires = '2100-01-01T00:00:00Z'",
    "a token that is removed": "DELETE FROM access_tokens",
    "a limit": "UPDATE limits SET settings = '{}'",
    "a limit that is removed": "DELETE FROM limits",
    "a note": "UPDATE annotations SET text = 'another'",
    "a note that is removed": "DELETE FROM annotations",
    "an address": "UPDATE webhooks SET url = 'https://y.example/'",
    "a webhook that is removed": "DELETE FROM webhooks",
    "a fact": "UPDATE record_facts SET sha256 = 'x' WHERE kind = 'audit'",
    "a fact that is removed": "DELETE FROM record_facts WHERE kind = 'audit'",
    "a leaf": "UPDATE record_leaves SET leaf = (SELECT leaf FROM record_leaves LIMIT 1)",
    "a leaf that is removed": (
        "DELETE FROM record_leaves WHERE seq = (SELECT min(seq) FROM results)"
    ),
    "a head": "UPDATE record_heads SET statement = replace(statement, 'results', 'audit')",
    "a head that is removed": "DELETE FROM record_heads WHERE number = 1",
    "a signature": "UPDATE record_heads SET signature = NULL",
    "the current result": (
        "UPDATE results SET current = NOT current WHERE batch_id IN "
        "(SELECT batch_id FROM results WHERE parent_id IS NOT NULL)"
    ),
}


def test_a_record_that_nobody_changed_has_no_fault(sealed, faults):
    assert faults() == []
    assert faults(public=False) == []


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_change_of_the_tables_is_found(sealed, faults, database, change):
    with changing(database) as connection:
        if database.startswith("sqlite"):
            connection.execute(text("PRAGMA foreign_keys = OFF"))
        else:
            connection.execute(text("SET session_replication_role = replica"))
        if "NOT current" in change:
            # One after the other: there is never more than one.
            ids = "SELECT id FROM results WHERE batch_id IN (SELECT batch_id FROM results WHERE "
            ids += "parent_id IS NOT NULL AND current = {}) AND id = batch_id"
            true = "1" if database.startswith("sqlite") else "true"
            (id,) = connection.scalars(text(ids.format(true))).all()
            connection.execute(
                text("UPDATE results SET current = NOT current WHERE batch_id = :id AND current"),
                {"id": id},
            )
            change = f"UPDATE results SET current = NOT current WHERE id = '{id}'"
        assert connection.execute(text(change)).rowcount
    assert faults()


def test_two_results_whose_places_are_exchanged_are_found(sealed, faults, database):
    with changing(database) as connection:
        one, other, *_ = connection.scalars(select(results.c.seq)).all()
        for before, after in ((one, 0), (other, one), (0, other)):
            connection.execute(update(results).where(results.c.seq == before).values(seq=after))
    assert len([fault for fault in faults() if "at its place" in fault]) == 2


def remade(connection, sign=None):
    """All leaves, facts and heads made anew, as one who knows every algorithm can."""
    from service.storage.projections import heads
    from service.storage.projections.rollups import lock_position

    for table in (record_heads, record_facts, record_leaves):
        connection.execute(table.delete())
    maker = heads.HeadMaker(sign)
    while maker.make(connection, lock_position(connection)):
        pass


def test_a_chain_that_is_made_anew_has_no_signature_of_the_key(sealed, faults, database, key):
    (first, *_, last) = heads_of(database)
    with changing(database) as connection:
        connection.execute(text("UPDATE audit SET who = 'B'"))
        remade(connection)
    assert faults(public=False) == []
    assert any("it is not signed" in fault for fault in faults())
    (named,) = faults(public=False, anchors=[first])
    assert "head 1 is another than the one that was given" in named
    # With the key of another person.
    other = key[0].with_name("other.pem")
    make_key(other)
    with changing(database) as connection:
        remade(connection, Signer(str(other)).sign)
    assert any("its signature is not of this key" in fault for fault in faults())
    # With the key itself only a head that was noted outside tells.
    with changing(database) as connection:
        remade(connection, Signer(str(key[0])).sign)
    assert faults() == []
    assert faults(anchors=[last])


def heads_of(database):
    with changing(database) as connection:
        query = select(record_heads.c.number, record_heads.c.sha256).order_by(record_heads.c.number)
        return [verify_chain.Anchor(*row) for row in connection.execute(query)]


def test_a_record_that_was_rolled_back_is_told_by_a_head_of_before(sealed, faults, database):
    noted = heads_of(database)
    assert len(noted) >= 2
    with changing(database) as connection:
        last = noted[-1].number
        connection.execute(text(f"DELETE FROM record_heads WHERE number = {last}"))
        connection.execute(text(f"UPDATE record_facts SET head = NULL WHERE head = {last}"))
    assert faults() == []
    (named,) = faults(anchors=noted)
    assert f"the record ends at head {last - 1}, and head {last} was given" in named
    assert f"the last head that agrees is {last - 1}" in named


def test_heads_are_read_from_a_log():
    line = f"2026-11-29T12:00:00Z info server x: record head 17 {'ab' * 32}"
    assert verify_chain.anchors_in(f"{line}\nother\n") == [verify_chain.Anchor(17, "ab" * 32)]
    with pytest.raises(BadConfiguration, match="holds no head"):
        verify_chain.anchors_in("nothing")


def test_every_table_is_bound_or_listed_as_not():
    bound = {table.name for table in chain.bound_tables()}
    own = {"record_leaves", "record_facts", "record_heads"}
    tables = {table.name: table.info.get(BOUND) for table in all_tables()}
    reasons = [*verify_chain.UNBOUND, *(n for n, why in tables.items() if isinstance(why, str))]
    groups = [bound, verify_chain.BY_LEAVES, verify_chain.OF_OTHERS, reasons, own]
    assert sorted(name for group in groups for name in group) == sorted(tables)


def test_what_is_pruned_leaves_its_leaf_and_is_no_fault(sealed, opened, faults, database, key):
    with closing(opened(record_key=str(key[0]))) as app:
        before = len(leaves_in(app))
        assert prune(app.store, LATER).batches == 6
        app.projector.make_heads()
        assert len(leaves_in(app)) == before
    assert faults() == []
    with changing(database) as connection:
        connection.execute(text("DELETE FROM record_facts WHERE kind = 'results.removed'"))
    assert any("was recorded, and is gone" in fault for fault in faults())


def leaves_in(app):
    with app.store.reading_record() as connection:
        return connection.scalars(select(record_leaves.c.seq)).all()


def test_notes_and_webhooks_may_be_changed_by_the_service(opened, faults, key):
    with closing(opened(record_key=str(key[0]))) as app:
        from service.features.webhooks import records as webhooks
        from service.storage.recording import events

        app.projector.make_heads()
        moment = START.text
        note = {"id": ID.format(5), "start": moment, "start_ns": 1, "end_ns": 2, "text": "a"}
        hook = ROWS["webhooks"] | {"created": moment}

        def change(act):
            app.store.writer.change(act)
            app.projector.make_heads()

        insert = (
            metadata.tables["annotations"].insert().values(note | {"who": "A", "created": moment})
        )
        change(lambda c: c.execute(insert))
        change(lambda c: c.execute(metadata.tables["webhooks"].insert().values(hook)))
        change(lambda c: events.delete_annotation(c, note["id"]))
        change(lambda c: webhooks.change_webhook(c, hook["id"], {"url": "https://z.example/"}))
        assert faults() == []
        change(lambda c: webhooks.delete_webhook(c, hook["id"]))
    assert faults() == []


# ---- proofs ------------------------------------------------------------------------------------


def test_a_proof_is_small_and_convinces_without_the_database(sealed, database, key, tmp_path):
    with changing(database) as connection:
        rows = connection.execute(select(results.c.id, results.c.answer)).all()
        made = [(proofs.prove(connection, id), answer.encode()) for id, answer in rows]
    for proof, answer in made:
        (tmp_path / "proof.json").write_text(json.dumps(vars_of(proof)))
        assert (tmp_path / "proof.json").stat().st_size <= 2_000
        read = proofs.read_proof(tmp_path / "proof.json")
        assert proofs.faults_of(read, PublicKey(key[1]), answer) == []
        assert proofs.faults_of(read, PublicKey(key[1]), answer + b" ")
        other = read.answer_sha256[::-1]
        read.answer_sha256 = other
        assert "the head does not have the result" in proofs.faults_of(read)


def vars_of(proof):
    return {name: getattr(proof, name) for name in proof.__struct_fields__}


def test_a_proof_is_checked_with_openssl_and_a_few_lines(sealed, database, key, tmp_path):
    """Hashes with openssl alone, as somebody without this program would."""

    def sha256(content):
        command = ["openssl", "dgst", "-sha256", "-binary"]
        return subprocess.run(command, input=content, capture_output=True, check=True).stdout

    with changing(database) as connection:
        id, answer = connection.execute(select(results.c.id, results.c.answer)).first()
        proof = proofs.prove(connection, id)
    mark = b"\x01" if proof.adopted else b"\x00"
    content = sha256(answer.encode()) + bytes.fromhex(proof.content)
    leaf = sha256(b"result\x00" + id.encode() + b"\x00" + mark + content)[:16]
    found, index, last = sha256(b"\x00" + leaf), proof.index, proof.size - 1
    for beside in map(bytes.fromhex, proof.path):
        if index % 2 or index == last:
            found = sha256(b"\x01" + beside + found)
            while index and not index % 2:
                index, last = index >> 1, last >> 1
        else:
            found = sha256(b"\x01" + found + beside)
        index, last = index >> 1, last >> 1
    assert json.loads(proof.statement)["root"] == found.hex()
    (tmp_path / "statement").write_text(proof.statement)
    (tmp_path / "signature").write_bytes(bytes.fromhex(proof.signature))
    command = ["openssl", "pkeyutl", "-verify", "-pubin", "-inkey", key[1], "-rawin"]
    command += ["-in", tmp_path / "statement", "-sigfile", tmp_path / "signature"]
    assert subprocess.run(command, capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize("size", range(1, 40))
def test_roots_and_paths_are_those_of_rfc_6962(size):
    """Held against the recursive definition of section 2.1."""

    def tree(leaves):
        if len(leaves) == 1:
            return hashlib.sha256(b"\x00" + leaves[0]).digest()
        split = 1 << (len(leaves) - 1).bit_length() - 1
        return hashlib.sha256(b"\x01" + tree(leaves[:split]) + tree(leaves[split:])).digest()

    leaves = [bytes([k]) * 16 for k in range(size)]
    root = chain.root_of(leaves)
    assert root == tree(leaves)
    for index, leaf in enumerate(leaves):
        path = chain.path_to(leaves, index)
        assert chain.root_from(leaf, index, size, path) == root
        assert chain.root_from(leaves[index - 1], index, size, path) != root or size == 1
        assert chain.root_from(leaf, index, size, [*path, root]) != root


# ---- keys --------------------------------------------------------------------------------------


def test_a_key_that_others_can_read_is_refused_and_never_shown(opened, key):
    key[0].chmod(0o640)
    with pytest.raises(BadConfiguration, match="others may read it") as refused:
        opened(record_key=str(key[0]))
    secret = re.findall(r"^\w[\w+/=]{20,}$", key[0].read_text(), re.MULTILINE)
    assert secret
    assert not any(line in str(refused.value) for line in secret)
    key[0].chmod(0o600)
    opened(record_key=key[0].read_text())
    with pytest.raises(BadConfiguration, match="no private key"):
        Signer("-----BEGIN PRIVATE KEY-----\nx\n-----END PRIVATE KEY-----\n")


# ---- earlier databases, archives, copies -------------------------------------------------------


def test_results_of_before_the_chain_get_their_leaves_and_verify(sealed, opened, faults, database):
    """As the migration leaves them: no leaf, and no place in the order."""
    with changing(database) as connection:
        for table in (record_heads, record_facts, record_leaves):
            connection.execute(table.delete())
        connection.execute(update(results).values(seq=0))
    assert faults(public=False) == []
    with closing(opened()) as app:
        app.projector.make_heads()
        places = leaves_in(app)
    assert len(places) == 8
    assert max(places) < 0
    assert faults(public=False) == []
    with changing(database) as connection:
        connection.execute(text("UPDATE results SET reason = 'x' WHERE status IS NULL"))
    assert any("at its place -" in fault for fault in faults(public=False))


def test_an_archive_keeps_the_chain_and_brings_its_results_back(sealed, opened, faults, tmp_path):
    from service.storage.upkeep import archiving

    place = tmp_path / "archive"
    place.mkdir()
    with closing(opened(archive_folder=place)) as app:
        done = archiving.archive(app.store, place, LATER)
        app.projector.make_heads()
    assert done.batches
    assert faults(public=False) == []
    with closing(opened(archive_folder=place)) as app:
        back = archiving.restore(app.store, place, archiving.PartFilter())
        assert back.restored == done.batches
        app.projector.make_heads()
    assert faults(public=False) == []


def test_an_archive_in_another_database_gets_leaves_of_its_own(sealed, opened, tmp_path, key):
    from service.storage.upkeep import archiving
    from tests.fresh_databases import sqlite_at

    place = tmp_path / "archive"
    place.mkdir()
    other = sqlite_at(tmp_path / "other.db")
    with closing(opened(archive_folder=place)) as app:
        done = archiving.archive(app.store, place, LATER)
    with closing(opened(database=other, archive_folder=place)) as app:
        assert archiving.restore(app.store, place, archiving.PartFilter()).restored == done.batches
        app.projector.make_heads()
    assert verify(other) == []
