"""Nobody but its owner reads what holds secrets: the database, its copies, uploaded telemetry."""

import logging
import os
import stat

import pytest

from service.ingest.spool import Spool, SpooledReplay
from service.storage.sql.database_file import warn_of_readers
from service.storage.store import Store
from service.storage.upkeep.backup import back_up, restore


@pytest.fixture(autouse=True)
def usual_umask():
    before = os.umask(0o022)
    yield
    os.umask(before)


def modes(folder):
    return {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.rglob("*")}


def test_a_database_its_backup_and_its_copy_are_its_owners_alone(tmp_path):
    store = Store(f"sqlite:///{tmp_path / 'acquire.db'}")
    try:
        store.writer.change(lambda connection: connection.exec_driver_sql("SELECT 1"))
        back_up(f"sqlite:///{tmp_path / 'acquire.db'}", tmp_path / "backup.db")
        restore(f"sqlite:///{tmp_path / 'restored.db'}", tmp_path / "backup.db")
        found = modes(tmp_path)
    finally:
        store.close()
    assert {"acquire.db", "acquire.db-wal", "backup.db", "restored.db"} <= found.keys()
    assert found == dict.fromkeys(found, 0o600)


def test_an_uploaded_file_of_telemetry_is_its_owners_alone(tmp_path):
    spool = Spool(tmp_path / "spool")
    with spool.new_file() as upload:
        spool.keep(upload, SpooledReplay("01J", "plain", 1000, None, "local", None))
    spool.release("01J")
    found = modes(tmp_path)
    assert found.pop("spool") == 0o700
    assert sorted(found) == ["01J.json", "01J.lines"]
    assert found == dict.fromkeys(found, 0o600)


def test_a_file_that_others_may_read_is_warned_of_with_what_mends_it(tmp_path, caplog):
    file, folder = tmp_path / "acquire.db", tmp_path / "acquire.db.spool"
    file.touch()
    folder.mkdir()
    with caplog.at_level(logging.WARNING):
        for path in (file, folder):
            warn_of_readers(path)
    assert f"chmod 600 {file}" in caplog.messages[0]
    assert f"chmod 700 {folder}" in caplog.messages[1]
    assert all("(mode " in message for message in caplog.messages)
    caplog.clear()
    file.chmod(0o600)
    folder.chmod(0o700)
    for path in (file, folder, tmp_path / "missing"):
        warn_of_readers(path)
    assert not caplog.messages
