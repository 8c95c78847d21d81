"""On PostgreSQL the session that holds the lock projects; every service records."""

from contextlib import closing

import pytest

from service.errors import Busy
from service.storage.sql.projector_lock import NotProjecting, left_behind
from service.storage.store import Store

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
    return store.writer.change(lambda connection: connection.exec_driver_sql(sql).scalar())


def project(store, sql):
    """The same in a step of the projector."""
    with store.writer.projection() as connection:
        return connection.exec_driver_sql(sql).scalar()


def test_nothing_is_projected_before_the_lock_is_taken_and_both_record(opened):
    first, second = opened
    with pytest.raises(NotProjecting):
        project(first, "SELECT 1")
    assert first.writer.take_lock() == "taken"
    assert second.writer.take_lock() == "refused"
    assert project(first, "SELECT 1") == 1
    with pytest.raises(NotProjecting):
        project(second, "SELECT 1")
    assert run(first, "SELECT 1") == run(second, "SELECT 1") == 1


def test_a_session_that_the_server_ends_projects_nothing_more_and_goes_on_recording(opened):
    first, second = opened
    first.writer.take_lock()
    pid = run(first, "SELECT pg_backend_pid()")
    with second.reading() as connection:
        connection.exec_driver_sql(f"SELECT pg_terminate_backend({pid}, 5000)")
    assert run(first, "SELECT pg_backend_pid()") != pid
    assert first.is_projecting
    with pytest.raises(NotProjecting, match="session that held the projector's lock has ended"):
        project(first, "SELECT 1")
    assert not first.is_projecting
    assert first.lock.lost.is_set()
    assert second.writer.take_lock() == "taken"
    assert first.writer.take_lock() == "refused"
    with pytest.raises(NotProjecting, match="another service projects"):
        project(first, "SELECT 1")
    assert project(second, "SELECT 1") == 1


def test_an_error_that_the_server_has_rolled_back_costs_no_lock(opened):
    first, second = opened
    first.writer.take_lock()
    with pytest.raises(Busy, match="cannot be written now"):
        run(first, "SET LOCAL statement_timeout = 50; SELECT pg_sleep(5)")
    assert second.writer.take_lock() == "refused"
    assert first.writer.take_lock() == "kept"
    assert project(first, "SELECT 1") == 1


def test_a_command_projects_without_the_lock(opened, database):
    first, _ = opened
    first.writer.take_lock()
    with closing(Store(database)) as command:
        assert project(command, "SELECT 1") == 1


def test_work_that_a_service_is_at_is_not_left_behind_until_it_has_ended(opened):
    first, second = opened
    first.writer.take_lock()
    second.at_work |= {"one", "two"}
    second.writer.take_lock()

    def left():
        ids = {"one", "two", "three"}
        with first.writer.projection() as connection:
            return left_behind(connection, ids)

    assert left() == {"three"}
    second.at_work.discard("one")
    second.writer.take_lock()
    assert left() == {"one", "three"}
    pid = run(second, "SELECT pg_backend_pid()")
    run(first, f"SELECT pg_terminate_backend({pid}, 5000)")
    assert left() == {"one", "two", "three"}
    # The next session takes the locks of all that goes on.
    second.writer.take_lock()
    assert left() == {"one", "three"}
