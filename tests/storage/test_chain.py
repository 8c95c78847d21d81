"""The chain of the record: what a person changes in the tables is found and named."""

import hashlib
import json
import re
import subprocess
from contextlib import closing

import pytest
from sqlalchemy import select, text, update

from service.cli import main
from service.errors import BadConfiguration
from service.features.archive import archiving
from service.features.products.attitude_formats import write_attitudes
from service.features.products.part import Products
from service.storage.projections import heads
from service.storage.recording import chain
from service.storage.recording.signing import PublicKey, Signer, make_key
from service.storage.sql.chain_tables import record_facts, record_heads, record_leaves
from service.storage.sql.columns import BOUND, metadata
from service.storage.sql.migrations import all_tables
from service.storage.sql.tables import results
from service.storage.upkeep import proofs, verify_chain
from service.storage.upkeep.prune import prune
from service.storage.upkeep.verify import verify
from service.times import shifted
from tests.storage.samples import START
from tests.storage.sealed import ID, ROWS, chain_anew, changing, heads_of

pytestmark = pytest.mark.both_databases

LATER = shifted(START, 30 * 86_400.0)


def test_a_record_that_nobody_changed_has_no_fault(signed, faults):
    assert faults() == []
    assert faults(public=False) == []


def test_two_results_whose_places_are_exchanged_are_found(signed, faults, database):
    with changing(database) as connection:
        one, other, *_ = connection.scalars(select(results.c.seq)).all()
        for before, after in ((one, 0), (other, one), (0, other)):
            connection.execute(update(results).where(results.c.seq == before).values(seq=after))
    assert len([fault for fault in faults() if "at its place" in fault]) == 2


def test_a_chain_that_is_made_anew_has_no_signature_of_the_key(signed, faults, database, key):
    (first, *_, last) = heads_of(database)
    with changing(database) as connection:
        connection.execute(text("UPDATE audit SET who = 'B'"))
        chain_anew(connection)
    assert faults(public=False) == []
    assert any("it is not signed" in fault for fault in faults())
    (named,) = faults(public=False, anchors=[first])
    assert "head 1 is another than the one that was given" in named
    # With the key of another person.
    other = key[0].with_name("other.pem")
    make_key(other)
    with changing(database) as connection:
        chain_anew(connection, Signer(str(other)).sign)
    assert any("its signature is not of this key" in fault for fault in faults())
    # With the key itself only a head that was noted outside tells.
    with changing(database) as connection:
        chain_anew(connection, Signer(str(key[0])).sign)
    assert faults() == []
    assert faults(anchors=[last])


def test_a_record_that_was_rolled_back_is_told_by_a_head_of_before(signed, faults, database):
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


def test_what_is_pruned_leaves_its_leaf_and_is_no_fault(signed, opened, faults, database, key):
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
        hook = dict(ROWS)["webhooks"] | {"created": moment}

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


# ---- heads that are given away -----------------------------------------------------------------


def test_a_head_is_in_the_answer_a_backup_an_archive_and_products_and_verify_reads_each(
    signed, opened, faults, database, tmp_path, capsys
):
    (*_, last) = heads_of(database)
    place = tmp_path / "archive"
    place.mkdir()
    with closing(opened(archive_folder=place)) as app:
        head = app.service.record_head()
        assert hashlib.sha256(head.statement.encode()).hexdigest() == head.sha256
        products = [
            b"".join(write_attitudes(format, app.part(Products).attitudes("XTE"))).decode()
            for format in ("aem", "aem-xml", "acm", "json")
        ]
        products.append(app.part(Products).table("XTE", "stars").about["record_head"])
        assert archiving.archive(app.store, place, LATER).batches
    (manifest,) = place.glob("spacecraft=XTE/day=*/manifest.json")
    assert main(["database", "backup", str(tmp_path / "b"), "--database", database]) == 0
    backup = capsys.readouterr().out
    texts = [head.text, backup.splitlines()[-1], manifest.read_text(), *products]
    for text_with_head in texts:
        assert verify_chain.anchors_in(text_with_head)[0].number >= last.number
        assert faults(public=False, anchors=verify_chain.anchors_in(text_with_head)) == []


def test_the_first_head_of_an_hour_is_an_event(signed, opened, key, make):
    with closing(opened(record_key=str(key[0]))) as app:

        def events():
            after = app.events.after(0, 1_000)
            return [each for each in after if each.kind == "head"]

        def record(name):
            app.submissions.submit(make(name))
            app.store.progress.catch_up()
            app.projector.make_heads()

        before = len(events())
        record("in-this-hour")
        with app.store.reading_record() as connection:
            newest = heads.newest_head(connection)
        earlier = json.loads(newest.statement) | {"made": "2001-01-01T00:59:00.000Z"}
        of_earlier = json.dumps(earlier, sort_keys=True, separators=(",", ":"))
        chosen = record_heads.c.number == newest.number
        change = update(record_heads).where(chosen).values(statement=of_earlier)
        app.store.writer.change(lambda connection: connection.execute(change))
        record("in-the-next")
        record("in-the-next-too")
        assert len(events()) == before + 1
        data = json.loads(events()[-1].data)
        assert data["number"] == newest.number + 1
        assert PublicKey(key[1]).has_signed(data["statement"].encode(), data["signature"])


# ---- proofs ------------------------------------------------------------------------------------


def test_a_proof_is_small_and_convinces_without_the_database(signed, database, key, tmp_path):
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


def test_a_proof_is_checked_with_openssl_and_a_few_lines(signed, database, key, tmp_path):
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


def test_results_of_before_the_chain_get_their_leaves_and_verify(signed, opened, faults, database):
    """As the migration leaves them: no leaf, and no place in the order."""
    with changing(database) as connection:
        for table in (record_heads, record_facts, record_leaves):
            connection.execute(table.delete())
        connection.execute(update(results).values(seq=0))
    assert faults(public=False) == []
    with closing(opened()) as app:
        app.projector.make_heads()
        places = leaves_in(app)
    assert len(places) == 9
    assert max(places) < 0
    assert faults(public=False) == []
    with changing(database) as connection:
        connection.execute(text("UPDATE results SET reason = 'x' WHERE status IS NULL"))
    assert any("at its place -" in fault for fault in faults(public=False))


def test_an_archive_keeps_the_chain_and_brings_its_results_back(signed, opened, faults, tmp_path):
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


def test_an_archive_in_another_database_gets_leaves_of_its_own(signed, opened, tmp_path, key):
    from service.features.archive import archiving
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
