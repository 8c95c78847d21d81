"""Restore: the database of the backup, whole or not at all, with the schema that it has."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import MetaData, create_engine, select, text
from sqlalchemy.pool import NullPool

from service.errors import BadConfiguration
from service.storage.sql import migrations
from service.storage.sql.engines import database_url
from service.storage.upkeep.backup import back_up, restore
from tests.databases import make as fixtures

EARLIER = ["0001", "0018"]


def rows_of(url):
    engine = create_engine(database_url(url), poolclass=NullPool)
    tables = MetaData()
    tables.reflect(engine)
    with engine.connect() as connection:
        found = {
            name: sorted(map(repr, connection.execute(select(table))))
            for name, table in tables.tables.items()
        }
    engine.dispose()
    return found


def schema_of(url):
    engine = create_engine(database_url(url), poolclass=NullPool)
    with engine.connect() as connection:
        name = connection.scalar(text("SELECT current_schema()"))
    engine.dispose()
    return name


def clear(url):
    """Leave no database: no file, or an empty schema."""
    if url.startswith("sqlite"):
        Path(database_url(url).database).unlink()
        return
    schema = schema_of(url)
    engine = create_engine(database_url(url), isolation_level="AUTOCOMMIT", poolclass=NullPool)
    with engine.connect() as connection:
        connection.execute(text(f"DROP SCHEMA {schema} CASCADE"))
        connection.execute(text(f"CREATE SCHEMA {schema}"))
    engine.dispose()


@pytest.mark.both_databases
@pytest.mark.parametrize("revision", EARLIER)
def test_a_backup_comes_back_with_the_schema_that_it_has(empty_database, tmp_path, revision):
    """Also a schema that this version does not read: the version that wrote it can be installed."""
    fixtures.restore(revision, empty_database)
    before = rows_of(empty_database)
    back_up(empty_database, tmp_path / "before")
    clear(empty_database)
    assert restore(empty_database, tmp_path / "before") == revision
    assert rows_of(empty_database) == before


@pytest.mark.both_databases
def test_a_restored_database_is_never_put_over_another(database, tmp_path):
    back_up(database, tmp_path / "copy")
    before = rows_of(database)
    with pytest.raises(BadConfiguration, match=r"exists already|holds tables already"):
        restore(database, tmp_path / "copy")
    assert rows_of(database) == before


@pytest.mark.parametrize("left", ["-wal", "-shm", "-journal"])
def test_what_another_file_left_beside_it_is_not_taken_for_its_own(tmp_path, left):
    made = f"sqlite:///{tmp_path}/made.db"
    migrations.upgrade(made)
    back_up(made, tmp_path / "copy")
    (tmp_path / f"new.db{left}").write_text("of a file that was moved away")
    with pytest.raises(BadConfiguration, match=f"new.db{left}: exists already"):
        restore(f"sqlite:///{tmp_path}/new.db", tmp_path / "copy")
    assert not (tmp_path / "new.db").exists()


def test_a_backup_that_is_cut_short_leaves_nothing(database, tmp_path):
    back_up(database, tmp_path / "copy")
    clear(database)
    whole = (tmp_path / "copy").read_bytes()
    (tmp_path / "copy").write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(BadConfiguration, match="copy"):
        restore(database, tmp_path / "copy")
    if database.startswith("sqlite"):
        assert not list(tmp_path.glob("*.part*"))
        assert not Path(database_url(database).database).exists()
    else:
        assert rows_of(database) == {}


@pytest.mark.both_databases
def test_files_that_are_no_backup_of_the_database_are_refused(database, tmp_path):
    target = f"sqlite:///{tmp_path}/new.db"
    with pytest.raises(BadConfiguration, match="none: cannot be read: No such file"):
        restore(target, tmp_path / "none")
    (tmp_path / "text").write_text("no backup")
    with pytest.raises(BadConfiguration, match="is no file of `acquire database backup`"):
        restore(target, tmp_path / "text")
    back_up(database, tmp_path / "copy")
    other = "postgresql://me@host/d" if database.startswith("sqlite") else target
    with pytest.raises(BadConfiguration, match="is a backup of"):
        restore(other, tmp_path / "copy")
    with closing(sqlite3.connect(tmp_path / "other.db")) as connection:
        connection.execute("CREATE TABLE mine (a)")
    with pytest.raises(BadConfiguration, match="holds no records of this service"):
        restore(target, tmp_path / "other.db")
    assert not (tmp_path / "new.db").exists()


def test_a_file_that_a_service_makes_in_the_meantime_is_not_replaced(tmp_path):
    made, target = f"sqlite:///{tmp_path}/made.db", tmp_path / "new.db"
    migrations.upgrade(made)
    back_up(made, tmp_path / "copy")
    with pytest.raises(BadConfiguration, match="exists already"):
        restore(f"sqlite:///{target}", tmp_path / "copy", lambda *_: target.write_text("mine"))
    assert target.read_text() == "mine"
    assert not list(tmp_path.glob("*.part*"))


def test_the_command_restores_and_says_what_to_do_next(acquire, tmp_path):
    for revision in EARLIER:
        fixtures.restore_sqlite(revision, tmp_path / f"{revision}.db")
        backup, new = f"{revision}.backup", f"sqlite:///{revision}.new"
        made = acquire("database", "backup", backup, "--database", f"sqlite:///{revision}.db")
        assert made[0] == 0
        code, out, _ = acquire("database", "restore", backup, "--database", new)
        assert code == 0
        assert f"{backup}: restored; its schema is at {revision}" in out
        is_read = acquire("database", "verify", "--database", new)[0] == 0
        assert is_read == (revision == migrations.HEAD)
        assert ("git checkout" in out) == (not is_read)
