"""Databases: every test that asks for `database` runs on SQLite and on PostgreSQL.

PostgreSQL takes part where TEST_POSTGRESQL_URL names a database to be used for
tests; each test has a schema of its own there.
"""

import os
import uuid

import pytest
from sqlalchemy import create_engine, make_url, text

from service.operations import Operations
from service.records.database import upgrade
from service.records.engines import database_url
from service.settings import Settings
from tests.records import samples


@pytest.fixture(params=["sqlite", "postgresql"])
def empty_database(request, tmp_path):
    """The URL of a database with nothing in it."""
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path / 'acquire.db'}"
        return
    server = os.environ.get("TEST_POSTGRESQL_URL")
    if not server:
        pytest.skip("TEST_POSTGRESQL_URL names no PostgreSQL database to test on")
    schema = f"test_{uuid.uuid4().hex}"
    engine = create_engine(database_url(server), isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"CREATE SCHEMA {schema}"))
        # The server itself is never killed here: its commits need not wait for the disk.
        options = f"-csearch_path={schema} -csynchronous_commit=off"
        url = make_url(server).update_query_dict({"options": options})
        yield url.render_as_string(hide_password=False)
        connection.execute(text(f"DROP SCHEMA {schema} CASCADE"))
    engine.dispose()


@pytest.fixture
def database(empty_database):
    """The URL of a database that is up to date."""
    upgrade(empty_database)
    return empty_database


@pytest.fixture
def opened(database):
    """Opens operations on the test's database, as often as asked; all are closed at the end."""
    held = []

    def open_operations(mission=None, **wanted):
        # Processes of their own take seconds to start: only tests about them ask for some.
        settings = Settings(**({"database": database, "replay_processes": 0} | wanted))
        held.append(Operations.open(settings, mission))
        return held[-1]

    yield open_operations
    for operations in held:
        operations.close()


@pytest.fixture
def operations(opened):
    """Operations on a database of their own."""
    return opened()


@pytest.fixture
def make(sky, missions):
    """Makes submissions: make("b1", kind="suspect", run="r", after_s=60)."""

    def submission(name="b1", **wanted):
        return samples.submission(sky, missions, name, **wanted)

    return submission
