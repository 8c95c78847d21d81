"""The schema begins with one migration; databases of development versions are refused unchanged."""

from pathlib import Path

import pytest
from alembic.script import ScriptDirectory
from sqlalchemy import MetaData, create_engine, inspect, select, text
from sqlalchemy.pool import NullPool

from service.app.factory import open_app
from service.errors import BadConfiguration
from service.settings import Settings
from service.storage.sql import migrations
from service.storage.sql.engines import database_url
from service.storage.store import Store
from service.storage.upkeep.copy import copy_record
from service.storage.upkeep.verify import verify
from tests.databases.make import restore

pytestmark = pytest.mark.both_databases

UPGRADED_BY = "`git checkout 2973fa51 && make install && .venv/bin/acquire database upgrade`"
BEFORE = "2000-001T00:00:00Z"
COMMANDS = [
    ("database", "upgrade"),
    ("database", "check"),
    ("database", "verify"),
    ("database", "rebuild"),
    ("database", "prune", "--before", BEFORE),
    ("database", "forget", "--run", "live", "--yes"),
    ("record", "head"),
    ("record", "prove", "01JD0000000000000000000000"),
    ("token", "create", "me", "--scope", "read"),
    ("history", "--spacecraft", "XTE"),
    ("export", "batches", "--spacecraft", "XTE"),
    ("reprocess", "--source", "live", "--run", "again"),
    ("archive", "--before", BEFORE, "--to", "archive"),
    ("serve", "--port", "1"),
]


@pytest.fixture(params=["0001", "0017"])
def of_development(request, empty_database):
    """URL of a database that an early commit wrote, and the schema that it names."""
    restore("0001", empty_database)
    engine = create_engine(database_url(empty_database), poolclass=NullPool)
    with engine.begin() as connection:
        named = text("UPDATE alembic_version SET version_num = :it")
        connection.execute(named, {"it": request.param})
    engine.dispose()
    return empty_database, request.param


def everything_in(url):
    """The bytes of a file with the names beside it, or all rows of a server's tables, by table."""
    if url.startswith("sqlite"):
        file = Path(database_url(url).database)
        return file.read_bytes(), sorted(each.name for each in file.parent.glob(f"{file.name}*"))
    engine = create_engine(database_url(url), poolclass=NullPool)
    tables = MetaData()
    tables.reflect(engine)
    with engine.connect() as connection:
        rows = {
            name: ([*map(repr, table.c)], sorted(map(repr, connection.execute(select(table)))))
            for name, table in tables.tables.items()
        }
        others = inspect(connection).get_sequence_names()
    engine.dispose()
    return rows, others


def test_the_first_migration_makes_the_schema_of_the_first_release():
    script = ScriptDirectory.from_config(migrations._config())
    assert script.get_bases() == ["0018"]
    in_order = [each.revision for each in script.walk_revisions()][::-1]
    assert in_order == migrations.REVISIONS
    assert in_order[-1] == migrations.HEAD


def test_a_database_of_a_development_version_is_refused_unchanged(of_development, tmp_path):
    url, schema = of_development
    before = everything_in(url)
    other = f"sqlite:///{tmp_path / 'other.db'}"
    migrations.upgrade(other)
    for refused in (
        Store,
        lambda url: open_app(Settings(database=url, replay_processes=0)),
        lambda url: Store(url, serving=True),
        migrations.upgrade,
        migrations.check,
        migrations.require_records,
        verify,
        lambda url: copy_record(url, other),
        lambda url: copy_record(other, url),
    ):
        with pytest.raises(BadConfiguration) as told:
            refused(url)
        said = f"by a development version before 0.2.0, with the schema {schema}: upgrade it with "
        assert said + UPGRADED_BY in str(told.value)
        assert everything_in(url) == before


def test_every_command_refuses_it_with_what_to_do(of_development, acquire):
    url, schema = of_development
    before = everything_in(url)
    Path("archive").mkdir()
    for command in COMMANDS:
        code, _, complaint = acquire(*command, "--database", url)
        assert (code, complaint.count(UPGRADED_BY)) == (2, 1), (command, complaint)
        assert f"with the schema {schema}" in complaint
        assert everything_in(url) == before, command
