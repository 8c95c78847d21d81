"""Backup and restore reach PostgreSQL as the service does, and show no secret to other users."""

import json
import os
import shutil
import sys
from pathlib import Path

import pytest
from psycopg.conninfo import conninfo_to_dict
from sqlalchemy import create_engine, make_url, text

from service.errors import BadConfiguration
from service.storage.sql import migrations
from service.storage.sql.engines import database_url
from service.storage.upkeep.backup import back_up, restore
from tests.storage.test_restore import clear, rows_of

NOTING = """#!{python}
import json, os, sys
with open({notes!r}, "a") as file:
    file.write(json.dumps([sys.argv, os.environ.get("PGPASSWORD")]) + "\\n")
os.execv({real!r}, sys.argv)
"""


@pytest.fixture
def noted(tmp_path, monkeypatch):
    """Notes what the client programs are given, and runs them."""
    folder, notes = tmp_path / "bin", tmp_path / "notes"
    folder.mkdir()
    for name in ("pg_dump", "pg_restore"):
        real = shutil.which(name)
        if real is None:
            pytest.skip(f"{name} is not installed")
        program = folder / name
        program.write_text(
            NOTING.format(python=sys.executable, notes=str(notes), real=str(Path(real)))
        )
        program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    return lambda: [json.loads(line) for line in notes.read_text().splitlines()]


def by_query(url):
    """The same database, its server and user named in the query part, with a password."""
    found = make_url(url)
    query = {
        "host": found.host,
        "port": str(found.port or 5432),
        "user": found.username,
        "password": "not for others",
        "sslmode": "prefer",
        "application_name": "a night's copy",
    }
    bare = found.set(host=None, port=None, username=None, password=None)
    return bare.update_query_dict(query).render_as_string(hide_password=False)


def test_the_whole_url_counts_and_no_password_is_shown(
    postgresql_schema, tmp_path, noted, monkeypatch
):
    # What counts where the URL is silent leads nowhere.
    for name in ("PGHOST", "PGUSER", "PGDATABASE"):
        monkeypatch.setenv(name, "/nowhere")
    with postgresql_schema() as url:
        migrations.upgrade(url)
        before = rows_of(url)
        back_up(by_query(url), tmp_path / "copy")
        clear(url)
        restore(by_query(url), tmp_path / "copy")
        assert rows_of(url) == before
    asked = [each for each in noted() if "--list" not in each[0]]
    assert len(asked) == 2
    for command, password in asked:
        assert "not for others" not in " ".join(command)
        assert password == "not for others"
        (named,) = (each.removeprefix("--dbname=") for each in command if "--dbname=" in each)
        given = conninfo_to_dict(named)
        assert given["sslmode"] == "prefer"
        assert given["application_name"] == "a night's copy"
        assert given["options"] == make_url(url).query["options"]


def test_a_passphrase_that_only_the_command_line_could_hold_is_refused(tmp_path):
    url = "postgresql://me@127.0.0.1:1/d?sslkey=key.pem&sslpassword=not+for+others"
    with pytest.raises(BadConfiguration, match="sslpassword") as raised:
        back_up(url, tmp_path / "copy")
    assert "not for others" not in str(raised.value)
    assert not list(tmp_path.iterdir())


def test_a_server_that_does_not_answer_is_named_without_its_password(tmp_path):
    url = "postgresql://me@127.0.0.1:1/d?password=not+for+others"
    with pytest.raises(BadConfiguration, match="refused") as raised:
        back_up(url, tmp_path / "copy")
    assert "not" not in str(raised.value).partition("?")[2].partition(":")[0]
    assert "password=***" in str(raised.value).replace("%2A", "*")


def test_a_schema_whose_name_is_no_plain_word_is_copied(postgresql_schema, tmp_path):
    with postgresql_schema() as url:
        own = 'Night "a*"'
        there = make_url(url).update_query_dict({"options": ""})
        engine = create_engine(database_url(url), isolation_level="AUTOCOMMIT")
        quoted = engine.dialect.identifier_preparer.quote(own)
        with engine.connect() as connection:
            connection.execute(text(f"CREATE SCHEMA {quoted}"))
        path = quoted.replace(" ", "\\ ")
        named = there.update_query_dict({"options": f"-csearch_path={path}"})
        named = named.render_as_string(hide_password=False)
        try:
            migrations.upgrade(named)
            before = rows_of(named)
            back_up(named, tmp_path / "copy")
            with engine.connect() as connection:
                connection.execute(text(f"DROP SCHEMA {quoted} CASCADE"))
                connection.execute(text(f"CREATE SCHEMA {quoted}"))
            restore(named, tmp_path / "copy")
            assert rows_of(named) == before
        finally:
            with engine.connect() as connection:
                connection.execute(text(f"DROP SCHEMA {quoted} CASCADE"))
            engine.dispose()


def test_the_tables_of_another_schema_are_refused_by_its_name(postgresql_schema, tmp_path):
    with postgresql_schema() as url, postgresql_schema() as other:
        migrations.upgrade(url)
        back_up(url, tmp_path / "copy")
        schema = make_url(url).query["options"].split()[0].partition("=")[2]
        with pytest.raises(BadConfiguration, match=f"holds the tables of schema {schema};"):
            restore(other, tmp_path / "copy")


def test_a_schema_that_is_not_there_is_named(postgresql_schema, tmp_path):
    with postgresql_schema() as url:
        lost = make_url(url).update_query_dict({"options": "-csearch_path=nowhere"})
        with pytest.raises(BadConfiguration, match="has no schema"):
            back_up(lost.render_as_string(hide_password=False), tmp_path / "copy")


def test_a_backup_is_for_its_owner_alone(database, tmp_path):
    """It holds the secrets of webhooks."""
    back_up(database, tmp_path / "copy")
    assert (tmp_path / "copy").stat().st_mode & 0o077 == 0
