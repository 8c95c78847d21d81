"""Forgetting a run, or some of its batches: nothing of it is left, all else is as it was."""

import pytest
from sqlalchemy import func, select

from service.errors import BadConfiguration, NotFound
from service.features.archive import archiving
from service.features.archive.archiving import verify_archive
from service.storage.sql.columns import metadata
from service.storage.sql.definitive_tables import graded_days
from service.storage.sql.tables import (
    archived_batches,
    archived_parts,
    audit,
    batches,
    gyro_blocks,
    rollups_hourly,
    runs,
)
from service.storage.upkeep.forget import ForgetFilter, forget, found
from service.storage.upkeep.verify import verify
from service.times import shifted
from tests.storage.recount import assert_equal_to_a_recount
from tests.storage.samples import START

BATCHES = 6
KINDS = ("good", "suspect", "one_star", "spurious")
LATER = shifted(START, 10 * 86_400.0)


@pytest.fixture
def place(tmp_path):
    (tmp_path / "archive").mkdir()
    return tmp_path / "archive"


@pytest.fixture
def app(opened, place):
    return opened(archive_folder=place)


@pytest.fixture
def filled(app, make):
    """Batches of every kind over two days in two runs."""
    for k in range(BATCHES):
        for run in ("live", "r"):
            submission = make(f"b{k}", kind=KINDS[k % 4], run=run, after_s=k * 30_000.0)
            app.submissions.submit(submission, f"key-{run}-{k}")
    return app


def assert_trends_are_right(app):
    with app.store.reading() as connection:
        assert_equal_to_a_recount(connection)


def names(app, run, table=batches):
    with app.store.reading() as connection:
        return sorted(connection.scalars(select(table.c.batch).where(table.c.run == run)))


def count(app, table):
    with app.store.reading() as connection:
        return connection.scalar(select(func.count()).select_from(table))


def rows_of_run(app, run):
    """What each table with a column `run` has of it, except for what says what happened."""
    happened = {"events", "replays", "alarms", "watches", "annotations"}
    with app.store.reading() as connection:
        return {
            name: connection.scalar(select(func.count()).select_from(t).where(t.c.run == run))
            for name, t in metadata.tables.items()
            if "run" in t.c and name not in happened
        }


def test_a_run_is_forgotten_whole_and_can_be_recorded_again(filled, make, database, place):
    live = rows_of_run(filled, "live")
    done = []
    total = forget(filled.store, ForgetFilter("r"), place, step=lambda n, total: done.append(n))
    assert (total.batches, total.archived_batches, total.gyro_blocks) == (BATCHES, 0, 0)
    assert done[-1] == BATCHES
    assert set(rows_of_run(filled, "r").values()) == {0}
    assert rows_of_run(filled, "live") == live
    with filled.store.reading() as connection:
        assert list(connection.scalars(select(runs.c.name))) == ["live"]
    assert_trends_are_right(filled)
    assert verify(database) == []
    # Another body under a name that was poisoned, and a key that was used.
    again = filled.submissions.submit(make("b0", kind="one_star", run="r"), "key-r-0")
    assert not again.replayed
    with pytest.raises(NotFound, match="nothing is recorded in run s"):
        forget(filled.store, ForgetFilter("s"), place)


def test_named_batches_are_forgotten_and_the_others_stay(filled, database, place):
    selected = ForgetFilter("live", "XTE", ("b1", "b4"))
    with filled.store.reading() as connection:
        assert found(connection, selected).batches == 2
    assert forget(filled.store, selected, place).batches == 2
    assert names(filled, "live") == ["b0", "b2", "b3", "b5"]
    assert len(names(filled, "r")) == BATCHES
    assert_trends_are_right(filled)
    assert verify(database) == []


def test_a_name_that_is_not_there_removes_nothing(filled, place):
    for selected, message in (
        (ForgetFilter("live", None, ("b1", "b99")), "run live has no batch 'b99'"),
        (ForgetFilter("live", "SOHO", ("b1",)), "run live of SOHO has no batch 'b1'"),
        (ForgetFilter("r", None, (), ("g1",)), "run r has no gyro block 'g1'"),
        (ForgetFilter("live", "SOHO"), "nothing is recorded in run live of SOHO"),
    ):
        with pytest.raises(NotFound) as refusal:
            forget(filled.store, selected, place)
        assert str(refusal.value) == message
    assert count(filled, batches) == 2 * BATCHES


def test_archived_batches_are_forgotten_with_their_files(filled, database, place):
    """Whole parts go; of others what is not named is recorded again."""
    archiving.archive(filled.store, place, LATER)
    archived = names(filled, "r", archived_batches)
    assert len(archived) > 2
    files = len(list(place.glob("**/part-*.parquet")))
    with pytest.raises(BadConfiguration, match="name the folder of the archive"):
        forget(filled.store, ForgetFilter("r"), None)
    one = forget(filled.store, ForgetFilter("r", "XTE", (archived[1],)), place)
    assert (one.batches, one.archived_batches) == (0, 1)
    assert sorted(names(filled, "r") + names(filled, "r", archived_batches)) == [
        f"b{k}" for k in range(BATCHES) if f"b{k}" != archived[1]
    ]
    assert_trends_are_right(filled)
    assert verify(database) == []
    assert list(verify_archive(place, {})) == []
    assert len(list(place.glob("**/part-*.parquet"))) == files - 1
    total = forget(filled.store, ForgetFilter("r"), place)
    assert total.batches + total.archived_batches == BATCHES - 1
    assert set(rows_of_run(filled, "r").values()) == {0}
    with filled.store.reading() as connection:
        assert set(connection.scalars(select(archived_parts.c.run))) == {"live"}
    assert_trends_are_right(filled)
    assert list(verify_archive(place, {})) == []
    assert count(filled, rollups_hourly) > 0


def test_the_entry_of_the_audit_list_and_the_change_are_one(filled, place):
    def fail(connection, total):
        raise RuntimeError(total.batches)

    with pytest.raises(RuntimeError, match="6"):
        forget(filled.store, ForgetFilter("r"), place, note=fail)
    assert len(names(filled, "r")) == BATCHES
    assert count(filled, audit) == 0
    assert count(filled, gyro_blocks) == count(filled, graded_days) == 0
