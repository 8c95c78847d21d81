"""The database: made by migrations, opened with care, refused with a reason."""

import logging
import os
import re
import sqlite3
import subprocess
import sys
from pathlib import Path
from urllib.parse import quote

import psycopg
import pytest
from alembic import command
from sqlalchemy import create_engine, event, inspect, make_url, select, text
from sqlalchemy.exc import DBAPIError, OperationalError

from service import __version__
from service.app.factory import open_app
from service.errors import BadConfiguration, Busy
from service.settings import Settings
from service.storage.sql import migrations
from service.storage.sql.columns import metadata
from service.storage.sql.engines import database_url, writing_engine
from service.storage.sql.statements import execute
from service.storage.sql.tables import batches
from service.storage.store import Store
from service.storage.upkeep.backup import back_up

pytestmark = pytest.mark.both_databases


def test_the_migrations_make_what_the_tables_say(empty_database, caplog):
    if empty_database.startswith("sqlite"):
        Path(make_url(empty_database).database).touch()
    assert "acquire database upgrade" in migrations.check(empty_database)[0]
    with caplog.at_level(logging.INFO, "service.storage.sql.migrations"):
        migrations.upgrade(empty_database)
        migrations.upgrade(empty_database)
    assert migrations.check(empty_database) == []
    # What was done to a database stands in the log, once.
    (line,) = caplog.messages
    assert line.endswith(f"made with the schema {migrations.HEAD}")


def test_a_fresh_database_is_checked_without_leaving_one_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert migrations.check_fresh() == []
    assert list(tmp_path.iterdir()) == []


def test_upgrading_again_changes_nothing(opened, database, make):
    app = opened()
    answered = app.submissions.submit(make())
    app.close()
    migrations.upgrade(database)
    assert opened().results.get(answered.id).answer.id == answered.id


def test_the_migrations_can_be_taken_back_to_nothing(database):
    engine = writing_engine(database_url(database))
    config = migrations._config()
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.downgrade(config, "base")
    with engine.connect() as connection:
        assert inspect(connection).get_table_names() == ["alembic_version"]
    engine.dispose()


def test_a_sqlite_file_is_created_and_brought_up_to_date_on_opening(tmp_path):
    open_app(Settings(database=f"sqlite:///{tmp_path / 'new.db'}")).close()
    assert migrations.check(f"sqlite:///{tmp_path / 'new.db'}") == []


@pytest.mark.parametrize("empty_database", ["postgresql"], indirect=True)
def test_a_postgresql_database_that_is_behind_is_not_opened_but_told_of(empty_database):
    with pytest.raises(BadConfiguration, match="acquire database upgrade"):
        open_app(Settings(database=empty_database))
    migrations.upgrade(empty_database)
    open_app(Settings(database=empty_database)).close()


def test_a_connection_that_is_read_from_while_the_store_is_closed_is_closed_after_that(database):
    store = Store(database)
    with store.reading() as connection:
        driver = connection.connection.driver_connection
        store.close()
        assert connection.execute(text("SELECT 1")).scalar() == 1
    with pytest.raises((sqlite3.ProgrammingError, psycopg.OperationalError), match="closed"):
        driver.execute("SELECT 1")


def test_a_database_of_a_newer_version_is_refused(database):
    engine = create_engine(database_url(database))
    with engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    engine.dispose()
    (by_verify,) = migrations.check(database)
    for refused in (Store, migrations.upgrade):
        with pytest.raises(BadConfiguration, match="at 9999, of a newer version") as told:
            refused(database)
        # Verifying advises nothing that upgrading would refuse.
        assert by_verify in str(told.value)
    assert "upgrade" not in by_verify


def test_a_newer_database_names_the_version_that_wrote_it(database, opened, make):
    app = opened()
    app.submissions.submit(make("b1"))
    app.close()
    engine = create_engine(database_url(database))
    with engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    engine.dispose()
    (difference,) = migrations.check(database)
    assert f"its newest result is of version {__version__}" in difference


# Root writes everywhere, but for a process that gave this up.
AS_OTHERS = (
    ("setpriv", "--bounding-set=-dac_override", "--inh-caps=-dac_override")
    if os.geteuid() == 0
    else ()
)


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_a_read_only_file_is_verified_and_exported(database, opened, make, tmp_path):
    app = opened()
    app.submissions.submit(make("b1"))
    app.close()
    source = tmp_path / "kept" / "acquire.db"
    source.parent.mkdir()
    back_up(database, source)
    before = source.read_bytes()
    os.chmod(source, 0o444)
    os.chmod(source.parent, 0o555)

    def acquire(*arguments):
        command = [*AS_OTHERS, sys.executable, "-m", "service.cli", *arguments]
        command += ["--database", f"sqlite:///{source}"]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    assert "nothing is wrong with 1 batches\n" in acquire("database", "verify").stdout
    assert acquire("export", "batches", "--spacecraft", "XTE").stdout.count("\n") == 2
    refused = acquire("database", "prune", "--before", "2000-001T00:00:00Z")
    assert refused.returncode == 2
    assert "read-only here: it can be read" in refused.stderr
    os.chmod(source.parent, 0o755)
    assert source.read_bytes() == before
    assert [each.name for each in source.parent.iterdir()] == ["acquire.db"]


@pytest.mark.parametrize(
    "password",
    ["hunter@2-secret", "@secret@", "sec/ret@word", "sec?ret", "sec:ret@", "s%zzecret", "se#cret"],
)
def test_no_message_holds_a_part_of_a_password(password, caplog):
    """Written into the URL as it is, whatever its signs; encoded it is accepted."""
    for tried in (password, quote(password, safe="")):
        url = f"postgresql://acquire:{tried}@127.0.0.1:1/acquire?connect_timeout=1"
        with pytest.raises(BadConfiguration) as told:
            Store(url)
        told = f"{told.value} {caplog.text}"
        for part in re.findall(r"[a-z0-9]{3,}", password):
            assert part not in told.replace("password", "")
    assert database_url(url).password == password


def test_a_file_that_is_no_database_is_refused_and_left_alone(tmp_path):
    file = tmp_path / "notes.txt"
    file.write_text("Nothing of the kind. " * 100)
    with pytest.raises(BadConfiguration, match="file is not a database"):
        Store(f"sqlite:///{file}")
    assert file.read_text() == "Nothing of the kind. " * 100


def test_a_damaged_database_is_refused(tmp_path):
    file = tmp_path / "acquire.db"
    Store(f"sqlite:///{file}").close()
    file.write_bytes(file.read_bytes()[:5000])
    with pytest.raises(BadConfiguration, match="ACQUIRE_DATABASE"):
        Store(f"sqlite:///{file}")


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("sqlite:///no/such/folder/acquire.db", "there is no folder"),
        ("sqlite:///.", "is a folder"),
        ("sqlite:////dev/null/acquire.db", "there is no folder"),
        ("sqlite:////proc/acquire.db", "cannot be opened"),
        ("sqlite://", "needs a file"),
        ("sqlite:///:memory:", "needs a file"),
        ("acquire.db", "must be sqlite:///FILE or postgresql://"),
        ("mysql://user@host/name", "must be sqlite:///FILE or postgresql://"),
        ("postgresql://user:secret@127.0.0.1:1/name", "port 1"),
        ("postgres://user:secret@host:no-port/name", "must be sqlite:///FILE or postgresql://"),
        ("postgresql://user:secret@host:port/name", "must be sqlite:///FILE or postgresql://"),
    ],
)
def test_a_place_that_cannot_be_used_is_refused_without_showing_a_password(url, said):
    with pytest.raises(BadConfiguration, match=said) as refusal:
        Store(url)
    assert "secret" not in str(refusal.value)


@pytest.mark.parametrize("scheme", ["postgresql+psycopg", "postgresql", "postgres"])
def test_postgresql_goes_by_each_of_its_names(scheme):
    url = database_url(f"{scheme}://user@host:5432/name")
    assert url.drivername == "postgresql+psycopg"


def test_sqlite_writes_through_a_log_and_to_the_disk_before_it_says_so(tmp_path):
    engine = writing_engine(database_url(f"sqlite:///{tmp_path / 'acquire.db'}"))
    pragmas = {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 10_000}
    with engine.connect() as connection:
        found = {name: connection.exec_driver_sql(f"PRAGMA {name}").scalar() for name in pragmas}
    engine.dispose()
    assert found == pragmas


def test_a_writing_transaction_of_sqlite_takes_its_lock_at_the_beginning(tmp_path):
    file = tmp_path / "acquire.db"
    engine = writing_engine(database_url(f"sqlite:///{file}"))
    other = sqlite3.connect(file, timeout=0)
    with engine.begin(), pytest.raises(sqlite3.OperationalError, match="locked"):
        other.execute("BEGIN IMMEDIATE")
    other.close()
    engine.dispose()


def test_readers_cannot_write(database):
    store = Store(database)
    with pytest.raises(DBAPIError, match=r"readonly|read-only"), store.reading() as connection:
        connection.execute(metadata.tables["runs"].delete())
    store.close()


def test_a_reader_sees_one_moment(app, make):
    runs = metadata.tables["batches"].select()
    with app.store.reading() as connection:
        assert connection.execute(runs).all() == []
        app.submissions.submit(make())
        assert connection.execute(runs).all() == []


def test_checking_what_is_not_there_says_so_and_leaves_nothing_behind(tmp_path):
    with pytest.raises(BadConfiguration, match="there is no such file"):
        migrations.check(f"sqlite:///{tmp_path / 'none.db'}")
    assert list(tmp_path.iterdir()) == []


def test_checking_tells_every_difference_in_words(database):
    engine = create_engine(database_url(database))
    with engine.begin() as connection:
        connection.execute(text("ALTER TABLE runs ADD COLUMN colour TEXT"))
        connection.execute(text("DROP TABLE replays"))
    engine.dispose()
    told = migrations.check(database)
    assert any("add table replays" in each for each in told)
    assert any("remove column runs.colour" in each for each in told)
    assert not any("Column(" in each or "Table(" in each for each in told)


def test_a_database_out_of_reach_is_busy_and_the_reason_is_for_the_log_alone(app, caplog):
    """The hook stands for a server that has gone away, in the words of its driver."""

    def gone(*_):
        raise OperationalError("SELECT", {}, Exception("host db.example, user secret"))

    event.listen(app.store._readers, "begin", gone)
    with pytest.raises(Busy, match="cannot be read now") as busy:
        app.runs.all()
    event.remove(app.store._readers, "begin", gone)
    assert "secret" not in str(busy.value)
    assert "user secret" in caplog.text
    assert app.runs.all() == []


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_who_has_glanced_holds_no_moment_and_the_log_can_begin_anew(app, make):
    """By a prepared statement, and by one that SQLAlchemy opens a transaction for."""
    app.submissions.submit(make("b1"))
    with app.store.lookup() as connection:
        assert execute(connection, "SELECT batch FROM batches") == [("b1",)]
        assert connection.scalars(select(batches.c.batch)).all() == ["b1"]
    app.submissions.submit(make("b2"))
    with app.store.lookup() as connection:
        assert len(execute(connection, "SELECT batch FROM batches")) == 2
    other = sqlite3.connect(app.store.url.database)
    try:
        busy, _, _ = other.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
    finally:
        other.close()
    assert not busy


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_a_table_that_is_missing_is_no_passing_trouble(app):
    rename = text("ALTER TABLE runs RENAME TO elsewhere")
    app.store.writer.change(lambda connection: connection.execute(rename).close())
    with pytest.raises(DBAPIError, match="no such table"):
        app.runs.all()
