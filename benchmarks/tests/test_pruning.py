"""Test of the pruning benchmark on PostgreSQL with a small sample."""

import os
import uuid

import pytest
from sqlalchemy import create_engine, make_url, text

from benchmarks.speed.pruning import measured


@pytest.fixture
def schema():
    """URL of a new, empty schema; skips the test if no server is named."""
    server = os.environ.get("TEST_POSTGRESQL_URL")
    if not server:
        pytest.skip("TEST_POSTGRESQL_URL names no PostgreSQL database to test on")
    name = f"test_{uuid.uuid4().hex}"
    engine = create_engine(server, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"CREATE SCHEMA {name}"))
        url = make_url(server).update_query_dict({"options": f"-csearch_path={name}"})
        yield url.render_as_string(hide_password=False)
        connection.execute(text(f"DROP SCHEMA {name} CASCADE"))
    engine.dispose()


def test_its_batches_are_pruned_and_archived_and_their_space_is_used_again(schema, seed):
    report = measured(60, 4, seed, schema)
    assert report.passed, report.text()
    assert report.figures["of these pruned"] == 120
