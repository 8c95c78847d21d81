"""On PostgreSQL the session that holds the lock writes, and no other one of a service does."""

from contextlib import closing

import pytest

from service.errors import Busy, Standby
from service.storage.store import Store

pytestmark = pytest.mark.both_databases

pytestmark = pytest.mark.parametrize("database", ["postgresql"], indirect=True)


@pytest.fixture
def opened(database):
    with (
        closing(Store(database, serving=True)) as first,
        closing(Store(database, serving=True)) as second,
    ):
        yield first, second


def run(store, sql):
    """Run a statement in a transaction of the writer; its value."""
    return store.writer.change(lambda connection: connection.exec_driver_sql(sql).scalar()).result()


def test_nothing_is_written_before_the_lock_is_taken(opened):
    first, second = opened
    with pytest.raises(Standby):
        run(first, "SELECT 1")
    assert first.writer.take_lock() == "taken"
    assert second.writer.take_lock() == "refused"
    assert run(first, "SELECT 1") == 1
    with pytest.raises(Standby):
        run(second, "SELECT 1")


def test_a_session_that_the_server_ends_writes_nothing_more(opened):
    first, second = opened
    first.writer.take_lock()
    pid = run(first, "SELECT pg_backend_pid()")
    with second.reading() as connection:
        connection.exec_driver_sql(f"SELECT pg_terminate_backend({pid}, 5000)")
    with pytest.raises(Standby, match="the connection that writes to the database was lost"):
        run(first, "SELECT 1")
    assert second.writer.take_lock() == "taken"
    assert first.writer.take_lock() == "refused"
    with pytest.raises(Standby, match="another service writes"):
        run(first, "SELECT 1")
    assert run(second, "SELECT 1") == 1


def test_a_lock_that_is_given_back_is_there_for_another(opened):
    first, second = opened
    first.writer.take_lock()
    second.writer.give_lock()
    assert second.writer.take_lock() == "refused"
    first.writer.give_lock()
    with pytest.raises(Standby, match="the connection that writes to the database was lost"):
        run(first, "SELECT 1")
    assert second.writer.take_lock() == "taken"
    assert first.writer.take_lock() == "refused"
    with pytest.raises(Standby, match="another service writes"):
        run(first, "SELECT 1")


def test_an_error_that_the_server_has_rolled_back_costs_no_lock(opened):
    first, second = opened
    first.writer.take_lock()
    with pytest.raises(Busy, match="cannot be written now"):
        run(first, "SET LOCAL statement_timeout = 50; SELECT pg_sleep(5)")
    assert second.writer.take_lock() == "refused"
    assert first.writer.take_lock() == "kept"
    assert run(first, "SELECT 1") == 1


def test_a_command_writes_without_the_lock(opened, database):
    first, _ = opened
    first.writer.take_lock()
    with closing(Store(database)) as command:
        assert run(command, "SELECT 1") == 1
