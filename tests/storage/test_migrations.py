"""Databases of every earlier version, with data in them, become this version's and lose nothing."""

import pytest
from alembic import command
from alembic.script import ScriptDirectory
from sqlalchemy import MetaData, create_engine, inspect, select

from service.access import Caller
from service.errors import KeyReused
from service.observations.schema import OptionsIn
from service.storage.sql import migrations
from service.storage.sql.columns import metadata
from service.storage.sql.engines import database_url, writing_engine
from service.storage.upkeep.verify import verify
from tests.scale import some_in_a_sitting
from tests.storage.test_upkeep import KINDS

pytestmark = pytest.mark.both_databases

REVISIONS = [
    script.revision for script in ScriptDirectory.from_config(migrations._config()).walk_revisions()
][::-1]

UNSEALED = {
    "results.seq": 0,
    "results.digest": None,
    "tracker_values.row_digest": None,
    "seals.digests": 0,
}
"""As migration 0017 leaves what it finds."""


def at_revision(database, revision):
    """Make the tables as they were at a revision."""
    engine = writing_engine(database_url(database))
    config = migrations._config()
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, revision)
    engine.dispose()


def rows_of(database, tables):
    engine = create_engine(database_url(database))
    with engine.connect() as connection:
        found = {
            table.name: [dict(row) for row in connection.execute(select(table)).mappings()]
            for table in tables
        }
    engine.dispose()
    return found


@pytest.fixture
def present(opened, make, database):
    """What this version records: batches of every kind, what-ifs, keys; as rows by table."""
    app = opened()
    tight = OptionsIn.model_validate(
        {"identifier": "starid", "tolerances": {"separation_deg": 1e-5}}
    )
    for k, kind in enumerate(KINDS):
        id = app.submissions.submit(make(f"b{k}", kind=kind, after_s=k * 5_000.0), f"key-{k}").id
        app.results.what_if(id, tight, adopt=k % 2 == 0, record=True)
    app.submissions.submit(make("b9", run="pass-7"))
    app.close()
    return rows_of(database, metadata.sorted_tables)


def test_the_latest_is_the_one_that_the_code_knows():
    assert REVISIONS[-1] == migrations.HEAD


def test_there_are_earlier_versions():
    assert REVISIONS[0] == "0001"
    assert len(REVISIONS) >= 4


@pytest.mark.parametrize("revision", [*some_in_a_sitting(REVISIONS[:-1]), REVISIONS[-1]])
@pytest.mark.slow("postgresql-0009", "postgresql-0016")
def test_an_older_database_is_brought_up_to_date_with_all_it_holds(
    revision, present, database, opened, make, tmp_path
):
    """Every value that the older version kept is there afterwards, and everything agrees."""
    older = _emptied(database, tmp_path)
    at_revision(older, revision)
    tables = MetaData()
    engine = create_engine(database_url(older))
    tables.reflect(engine)
    kept = {}
    # These rows' digests are of columns that the older version did not have, too.
    unsealed = {} if revision == migrations.HEAD else dict(UNSEALED)
    with engine.begin() as connection:
        # In the order of the code: of results a parent stands before its what-ifs.
        for name in [each.name for each in metadata.sorted_tables if each.name in tables.tables]:
            table = tables.tables[name]
            kept[name] = [
                {
                    column: unsealed.get(f"{name}.{column}", row[column])
                    for column in row
                    if column in table.c
                }
                for row in sorted(present[name], key=lambda row: str(row.get("id")))
            ]
            # A migration may have put a first row there already.
            connection.execute(table.delete())
            if kept[name]:
                connection.execute(table.insert(), kept[name])
    engine.dispose()
    migrations.upgrade(older)
    assert migrations.check(older) == []
    after = rows_of(older, metadata.sorted_tables)
    for name, rows in kept.items():
        shown = [
            {column: row[column] for column in (rows[0] if rows else ())} for row in after[name]
        ]
        assert sorted(map(repr, shown)) == sorted(map(repr, rows)), name
    assert verify(older) == []
    app = _open(older)
    try:
        assert len(app.results.page().items) == len(KINDS)
        assert app.submissions.submit(make("b0", kind="good")).replayed
        assert app.submissions.submit(make("b0", kind="good"), "key-0").replayed
        # Older keys belong to no token: under one of them a token may send another body.
        with pytest.raises(KeyReused):
            app.submissions.submit(make("other", after_s=98_000.0), "key-0")
        token = Caller("a", frozenset(["submit"]), None, "A")
        assert not app.submissions.submit(make("other", after_s=98_000.0), "key-0", token).replayed
        assert not app.submissions.submit(make("new", after_s=99_000.0)).replayed
    finally:
        app.close()
    assert verify(older) == []


def _open(database):
    from service.app.factory import open_app
    from service.settings import Settings

    return open_app(Settings(database=database))


def _emptied(database, tmp_path):
    """A database with nothing in it, of the same kind."""
    if database.startswith("sqlite"):
        return f"sqlite:///{tmp_path / 'older.db'}"
    engine = create_engine(database_url(database))
    metadata.drop_all(engine)
    with engine.begin() as connection:
        connection.exec_driver_sql("DROP TABLE alembic_version")
    assert inspect(engine).get_table_names() == []
    engine.dispose()
    return database
