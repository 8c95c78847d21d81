"""Without the feature archived batches are known, and none is left out without a word."""

import pytest
from sqlalchemy import select

from service.errors import BadConfiguration, Conflict, NotAvailable
from service.features.archive import archiving
from service.features.products.part import Products
from service.observations.schema import OptionsIn
from service.storage.sql.tables import archived_batches, batches
from service.storage.upkeep.forget import ForgetFilter, found
from service.storage.upkeep.verify import verify
from service.times import shifted
from tests.storage.samples import START

LATER = shifted(START, 10 * 86_400.0)
BATCHES, STEP_S = 4, 40_000.0
OFF = "ACQUIRE_FEATURES_OFF leaves the feature `archive` out"


@pytest.fixture
def place(tmp_path):
    (tmp_path / "archive").mkdir()
    return tmp_path / "archive"


@pytest.fixture
def without(opened, make, place):
    """An app without the feature, over a database whose batches but the last are archived."""
    app = opened(archive_folder=place)
    for k in range(BATCHES):
        app.submissions.submit(make(f"b{k}", after_s=k * STEP_S))
    before = app.spacecraft.rates("XTE")
    assert archiving.archive(app.store, place, LATER).batches == BATCHES - 1
    app.close()
    off = opened(archive_folder=place, features_off="archive")
    assert repr(off.spacecraft.rates("XTE")) == repr(before)
    return off


def ids_of(app, table):
    """The ids of a table's batches by name."""
    with app.store.reading() as connection:
        return dict(map(tuple, connection.execute(select(table.c.batch, table.c.id))))


@pytest.mark.both_databases
def test_what_would_read_an_archived_batch_is_refused_with_the_setting(without, place):
    recorded, archived = ids_of(without, batches), ids_of(without, archived_batches)
    assert (set(recorded), set(archived)) == ({"b3"}, {"b0", "b1", "b2"})
    for read in (
        lambda: without.results.get(archived["b1"]),
        lambda: without.results.what_if(archived["b1"], OptionsIn()),
        lambda: without.results.page(limit=5),
        lambda: without.spacecraft.attitudes("XTE"),
        lambda: list(without.part(Products).table("XTE", "stars").pages),
        lambda: without.comparisons.of_options("XTE", OptionsIn(), OptionsIn()),
    ):
        with pytest.raises(NotAvailable, match=OFF):
            read()
    assert without.results.get(recorded["b3"]).current
    assert without.results.neighbours(recorded["b3"]).earlier is None
    (item,) = without.results.page(limit=5, start=shifted(START, (BATCHES - 1.5) * STEP_S)).items
    assert item.id == recorded["b3"]


@pytest.mark.both_databases
def test_an_archived_batch_is_recognised_and_not_recorded_twice(without, make, database):
    with pytest.raises(NotAvailable, match=OFF):
        without.submissions.submit(make("b1", after_s=STEP_S))
    with pytest.raises(Conflict):
        without.submissions.submit(make("b1", after_s=STEP_S + 1.0))
    recorded, archived = ids_of(without, batches), ids_of(without, archived_batches)
    assert (set(recorded), len(archived)) == ({"b3"}, BATCHES - 1)
    assert without.submissions.submit(make("b4", after_s=BATCHES * STEP_S)).id
    assert verify(database) == []


def test_nothing_is_removed_where_archived_batches_cannot_be(without, place, acquire, database):
    selected = ForgetFilter("live")
    with pytest.raises(BadConfiguration, match=OFF):
        without.runs.forget(selected)
    with without.store.reading() as connection:
        counts = found(connection, selected)
    assert (counts.batches, counts.archived_batches) == (1, BATCHES - 1)


def test_commands_of_the_archive_are_gone_and_reprocess_is_there(
    without, place, acquire, database, monkeypatch
):
    without.close()
    if not database.startswith("sqlite"):
        pytest.skip("the commands do not depend on the database: SQLite shows it")
    monkeypatch.setenv("ACQUIRE_FEATURES_OFF", "archive")
    assert acquire("archive", "verify", "--archive", place)[0] == 2
    options = ("--database", database, "--run", "again", "--processes", "1", "--quiet")
    code, _, complaint = acquire("reprocess", "--archive", place, *options)
    assert (code, "there is no option --archive" in complaint) == (2, True)
    code, out, complaint = acquire("reprocess", "--no-comparison", *options)
    assert (code, complaint) == (0, "")
    assert "1 recorded, 0 there already, 0 refused" in out
    forget = ("database", "forget", "--run", "live", "--yes", "--archive", place)
    code, _, complaint = acquire(*forget, "--database", database)
    assert (code, OFF in complaint) == (2, True)
