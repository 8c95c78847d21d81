"""The archive: every batch is in the record or in the archive, byte for byte, whatever happens."""

import errno
import math
import os
import stat
import threading
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from sqlalchemy import func, select, update

from service.errors import BadConfiguration, Busy, Conflict
from service.features.archive import archiving, folder, rows
from service.features.archive.archive import ParquetArchive
from service.features.archive.archiving import PartFilter, restore, verify_archive
from service.features.archive.rows import WHOLE, Opened, columns_of
from service.ingest import submit
from service.observations.schema import OptionsIn
from service.storage.projections import rollups
from service.storage.sql.columns import metadata
from service.storage.sql.tables import (
    archived_batches,
    batches,
    frames,
    idempotency_keys,
    results,
    runs,
    solutions,
    star_results,
    tracker_values,
)
from service.storage.store import Store
from service.storage.upkeep.prune import prune
from service.storage.upkeep.verify import verify
from service.times import shifted
from tests.fresh_databases import sqlite_at
from tests.ingest.test_replays import finished
from tests.storage import twin
from tests.storage.recount import assert_equal_to_a_recount
from tests.storage.samples import START

TIGHT = OptionsIn.model_validate({"identifier": "starid", "tolerances": {"separation_deg": 1e-5}})
KINDS = ("good", "suspect", "one_star", "spurious")
OF_BATCHES = (
    batches,
    results,
    star_results,
    solutions,
    tracker_values,
    frames,
    idempotency_keys,
)
DAY_S = 86_400.0
LATER = shifted(START, 10 * DAY_S)


def rows_of(store, tables):
    with store.reading() as connection:
        return {
            table.name: sorted(
                (dict(row) for row in connection.execute(select(table)).mappings()), key=repr
            )
            for table in tables
        }


def trends_of(store):
    return rows_of(store, [t for name, t in metadata.tables.items() if "rollups" in name])


def archived_ids(store):
    with store.reading() as connection:
        return set(connection.scalars(select(archived_batches.c.id)))


@pytest.fixture
def place(tmp_path):
    (tmp_path / "archive").mkdir()
    return tmp_path / "archive"


@pytest.fixture
def app(opened, place):
    return opened(archive_folder=place)


@pytest.fixture
def filled(app, make):
    """Batches of every kind over three days and two runs, what-ifs, keys."""
    ids = []
    for k in range(12):
        for run in ("live", "r"):
            submission = make(f"b{k}", kind=KINDS[k % 4], run=run, after_s=k * 20_000.0)
            ids.append(app.submissions.submit(submission, f"key-{run}-{k}").id)
    app.results.what_if(ids[0], TIGHT, adopt=True)
    app.results.what_if(ids[1], TIGHT, record=True)
    return app


@pytest.mark.both_databases
def test_what_is_archived_and_restored_is_the_same_byte_for_byte(filled, place, database):
    before, trends = rows_of(filled.store, OF_BATCHES), trends_of(filled.store)
    steps = []
    done = archiving.archive(filled.store, place, LATER, step=lambda s: steps.append(s.batches))
    # The hours of the newest batch, and of the newest attitude, stay.
    left = rows_of(filled.store, OF_BATCHES)["batches"]
    assert done.batches == done.total == len(before["batches"]) - len(left) == steps[-1]
    assert {row["batch"] for row in left} == {"b11"}
    assert trends_of(filled.store) == trends
    assert verify(database) == []
    assert list(verify_archive(place, {})) == []
    restored = restore(filled.store, place, PartFilter())
    assert restored.restored == done.batches
    assert rows_of(filled.store, OF_BATCHES) == before
    assert archived_ids(filled.store) == set()
    assert trends_of(filled.store) == trends
    assert verify(database) == []
    assert restore(filled.store, place, PartFilter()).restored == 0


def test_an_archive_is_restored_into_an_empty_database(filled, place, tmp_path, opened):
    before, trends = rows_of(filled.store, OF_BATCHES), trends_of(filled.store)
    archiving.archive(filled.store, place, LATER)
    kept = {row["id"] for row in rows_of(filled.store, OF_BATCHES)["batches"]}
    other = Store(sqlite_at(tmp_path / "again.db"))
    try:
        restore(other, place, PartFilter(run="live"))
        found = rows_of(other, [batches, results])
        for name, key in (("batches", "id"), ("results", "batch_id")):
            wanted = [r for r in before[name] if r["run"] == "live" and r[key] not in kept]
            # Its own order of the record is another.
            own = {"seq": 0} if name == "results" else {}
            assert found[name] == [r | own for r in wanted]
        with other.reading() as connection:
            assert_equal_to_a_recount(connection)
    finally:
        other.close()
    assert verify(f"sqlite:///{tmp_path / 'again.db'}") == []
    assert trends_of(filled.store) == trends


def test_a_repeat_of_an_archived_batch_gets_its_answer_and_another_body_is_refused(
    filled, place, make
):
    answers = {row["id"]: row["answer"] for row in rows_of(filled.store, [results])["results"]}
    archiving.archive(filled.store, place, LATER)
    again = filled.submissions.submit(make("b1", kind="suspect", after_s=20_000.0))
    assert again.replayed
    assert again.body.decode() == answers[again.id]
    assert filled.results.get(again.id).archived
    with_key = make("b2", kind="one_star", after_s=40_000.0)
    assert filled.submissions.submit(with_key, "another key").replayed
    with pytest.raises(Conflict):
        filled.submissions.submit(make("b1", kind="good", after_s=20_000.0))
    many = [make("b1", kind="suspect", after_s=20_000.0), make("new", after_s=20_000.0)]
    first, second = filled.submissions.submit_many(many)
    assert first.replayed
    assert not second.replayed


def test_without_its_archive_the_service_says_so_and_records_nothing_twice(filled, place, make):
    archiving.archive(filled.store, place, LATER)
    place.rename(place.with_name("away"))
    with pytest.raises(Busy, match="the archive cannot be read"):
        filled.submissions.submit(make("b1", kind="suspect", after_s=20_000.0))


def test_without_its_archive_the_service_takes_what_came_with_a_repeat(
    filled, place, make, monkeypatch
):
    archiving.archive(filled.store, place, LATER)
    place.rename(place.with_name("away"))
    real, may_go_on = submit.look_up, threading.Event()

    def look_up(*arguments):
        may_go_on.wait(60)
        return real(*arguments)

    # While the first is looked up the others come, and are then looked up together.
    monkeypatch.setattr(submit, "look_up", look_up)
    sent = [make("n1"), make("b1", kind="suspect", after_s=20_000.0), make("n2")]
    first, repeat, new = (filled.submissions.queued(each, None, None, Future()) for each in sent)
    may_go_on.set()
    assert not first.result(60).replayed
    assert not new.result(60).replayed
    assert isinstance(repeat.exception(60), Busy)


def test_without_its_archive_a_replay_refuses_the_line_and_goes_on(filled, place, make):
    archiving.archive(filled.store, place, LATER)
    place.rename(place.with_name("away"))
    sent = [make("b1", kind="suspect", after_s=20_000.0, run="r"), make("new", run="r")]
    id = filled.replays.start([each.text.encode() + b"\n" for each in sent], "r")
    replay = finished(filled, id)
    assert (replay.state, replay.counts.new) == ("done", 1)
    assert [each.line for each in replay.errors] == [1]
    assert "archive" in replay.errors[0].problem.detail


@pytest.mark.both_databases
def test_a_batch_that_is_archived_between_look_up_and_insert_is_not_recorded_again(
    filled, place, make, monkeypatch
):
    late = make("b1", kind="suspect", after_s=20_000.0)
    archiving.archive(filled.store, place, LATER)
    unsaved = filled.submissions.solver.solve(late)
    (outcome,) = filled.store.writer.record([unsaved])
    assert isinstance(outcome, Busy)
    with filled.store.reading() as connection:
        same = batches.c.batch == "b1", batches.c.run == "live"
        assert connection.scalar(select(func.count()).select_from(batches).where(*same)) == 0


def test_late_batches_and_adopted_results_of_archived_hours_keep_the_trends(
    filled, place, make, database
):
    archiving.archive(filled.store, place, LATER)
    late = filled.submissions.submit(make("late", after_s=20_010.0))
    filled.results.what_if(late.id, TIGHT, adopt=True)
    with filled.store.reading() as connection:
        assert_equal_to_a_recount(connection)
    assert verify(database) == []
    archiving.archive(filled.store, place, LATER)
    assert verify(database) == []
    names = [part.file for part in folder.manifest_of(place, "XTE", "1996-01-10").parts]
    assert sorted(names) == ["part-1.parquet", "part-2.parquet", "part-3.parquet"]
    prune(filled.store, LATER)
    assert verify(database) == []
    restore(filled.store, place, PartFilter())
    assert verify(database) == []


@pytest.mark.parametrize("at", ["write_partition", "write_manifest", "differing", "keep_share"])
def test_an_archiving_that_fails_anywhere_is_called_again(filled, place, monkeypatch, at, database):
    before = rows_of(filled.store, OF_BATCHES)
    real, calls = getattr(archiving, at), []

    def fails_later(*arguments, **named):
        done = real(*arguments, **named)
        calls.append(done)
        if len(calls) > 1:
            raise OSError(28, "no space left on device")
        return done

    with monkeypatch.context() as patched:
        patched.setattr(archiving, at, fails_later)
        with pytest.raises(OSError, match="no space left"):
            archiving.archive(filled.store, place, LATER)
    assert verify(database) == []
    archiving.archive(filled.store, place, LATER)
    assert verify(database) == []
    named = [part for m in folder.manifests(place) for part in m.parts]
    assert sum(part.batches for part in named) == len(archived_ids(filled.store))
    restore(filled.store, place, PartFilter())
    assert rows_of(filled.store, OF_BATCHES) == before


def test_what_changes_while_a_part_is_written_is_archived_as_it_is_then(filled, place, monkeypatch):
    real, adopted = archiving.write_manifest, []

    def adopts(*arguments):
        real(*arguments)
        if not adopted:
            with filled.store.reading() as connection:
                query = select(results.c.id).where(results.c.run == "live", results.c.current)
                oldest = connection.scalar(query.order_by(results.c.time_ns))
            adopted.append(filled.results.what_if(oldest, OptionsIn(solver="triad"), adopt=True).id)

    monkeypatch.setattr(archiving, "write_manifest", adopts)
    archiving.archive(filled.store, place, LATER)
    restore(filled.store, place, PartFilter())
    with filled.store.reading() as connection:
        assert connection.scalar(select(results.c.current).where(results.c.id == adopted[0]))


@pytest.fixture
def meanwhile(opened, place, database):
    """Lets another service on the database do something, once.

    Waits for the end of it, a second at most: it may have to wait for the caller.
    """
    if database.startswith("sqlite"):
        pytest.skip("with SQLite the service is stopped first")
    other, begun = opened(archive_folder=place), []
    with ThreadPoolExecutor() as pool:

        def does(work):
            if not begun:
                begun.append(pool.submit(work, other))
                wait(begun, timeout=1.0)
            return begun[0]

        yield does


@pytest.mark.both_databases
def test_a_what_if_that_a_service_records_meanwhile_is_not_lost(
    meanwhile, filled, place, monkeypatch
):
    with filled.store.reading() as connection:
        query = select(results.c.id).where(results.c.run == "live", results.c.current)
        oldest = connection.scalar(query.order_by(results.c.time_ns))
    real, told = archiving.keep_share, []

    def keeps(*arguments):
        told.append(meanwhile(lambda other: other.results.what_if(oldest, TIGHT, record=True)))
        real(*arguments)

    monkeypatch.setattr(archiving, "keep_share", keeps)
    archiving.archive(filled.store, place, LATER)
    # It may be refused.  If not, it is kept.
    if told[0].exception() is None:
        assert filled.results.get(told[0].result().id).archived


@pytest.mark.both_databases
@pytest.mark.parametrize("work", ["archive", "restore"])
@pytest.mark.slow("postgresql")
def test_trends_that_a_service_counts_meanwhile_have_each_batch_once(
    meanwhile, filled, place, make, monkeypatch, work
):
    monkeypatch.setattr(archiving, "MOST_BATCHES", 1)
    if work == "restore":
        archiving.archive(filled.store, place, LATER)
    late = filled.submissions.submit(make("late", after_s=20_010.0))
    works = {
        "archive": lambda other: archiving.archive(other.store, place, LATER),
        "restore": lambda other: restore(other.store, place, PartFilter()),
    }
    real, told = rollups.shares_of_hour, []

    def shares_of_hour(*arguments):
        told.append(meanwhile(works[work]))
        return real(*arguments)

    monkeypatch.setattr(rollups, "shares_of_hour", shares_of_hour)
    filled.results.what_if(late.id, TIGHT, adopt=True)
    with filled.store.reading():
        # The projector has counted the hour of the adopted result anew.
        told[0].result()
    with filled.store.reading() as connection:
        assert_equal_to_a_recount(connection)


def test_damage_of_a_file_is_found_and_nothing_of_it_is_restored(filled, place):
    archiving.archive(filled.store, place, LATER)
    file = min(place.rglob("part-1.parquet"))
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(bytes(content))
    (problem,) = verify_archive(place, {})
    assert "is damaged" in problem
    with pytest.raises(BadConfiguration, match="is damaged"):
        restore(filled.store, place, PartFilter())
    min(place.rglob("part-1.parquet")).unlink()
    assert any("cannot be read" in each for each in verify_archive(place, {}))


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("part-9.parquet", "the manifest does not name it"),
        ("run-again-0.parquet", "the manifest does not name it"),
        (f"part-9.parquet{folder.UNFINISHED}", "was not written to its end"),
    ],
)
def test_files_that_no_manifest_names_are_told(filled, place, name, told):
    archiving.archive(filled.store, place, LATER)
    whole = min(place.rglob("part-1.parquet"))
    stray = whole.with_name(name)
    stray.write_bytes(whole.read_bytes())
    assert list(verify_archive(place, {})) == [f"{stray}: {told}"]


def test_files_of_a_day_without_a_manifest_are_told(place):
    day = folder.day_folder(place, "XTE", "1999-03-01")
    day.mkdir(parents=True)
    (day / "part-0.parquet").write_bytes(b"")
    assert list(verify_archive(place, {})) == [
        f"{day / 'part-0.parquet'}: the manifest does not name it"
    ]


def test_values_of_trackers_are_archived_and_their_trends_stay(opened, place, sky, missions):
    mission = twin.twin(missions)
    app = opened(mission, archive_folder=place)
    for k in range(3):
        app.submissions.submit(twin.submission(sky, mission, f"b{k}", after_s=k * 4_000.0))
    before, trends = rows_of(app.store, OF_BATCHES), trends_of(app.store)
    assert len(before["tracker_values"]) == 6
    assert archiving.archive(app.store, place, LATER).batches == 2
    late = app.submissions.submit(twin.submission(sky, mission, "late", after_s=10.0))
    app.results.what_if(late.id, OptionsIn(solver="triad"), adopt=True)
    with app.store.reading() as connection:
        assert_equal_to_a_recount(connection)
    restore(app.store, place, PartFilter())
    found = rows_of(app.store, OF_BATCHES)["tracker_values"]
    assert [row for row in found if row["batch_id"] != late.id] == before["tracker_values"]
    assert len(trends_of(app.store)["tracker_rollups_hourly"]) == len(
        trends["tracker_rollups_hourly"]
    )


def test_a_part_of_an_earlier_version_has_no_values_of_later_quantities(
    opened, place, sky, missions
):
    """Parts are never written again: columns that they lack are null, in lists and restored."""
    mission = twin.twin(missions)
    app = opened(mission, archive_folder=place)
    for k in range(3):
        app.submissions.submit(twin.submission(sky, mission, f"b{k}", after_s=k * 4_000.0))
    later = ("scale_offset_ppm", "alignment_offset_arcsec")
    with app.store.reading() as connection:
        ids = list(connection.scalars(select(batches.c.id)))
        now = rows.read_rows(connection, ids)
    earlier = dict(now)
    for name in ("results", "tracker_values"):
        assert now[name]["scale_offset_ppm"].null_count == 0
        earlier[name] = now[name].drop_columns(list(later))
    partition = rows.to_partition(earlier)
    assert not set(later) & set(partition.column_names)
    found = rows.from_partition(partition)
    for name in ("results", "tracker_values"):
        assert found[name].column_names == now[name].column_names
        assert found[name].drop_columns(list(later)).equals(earlier[name])
        assert all(found[name][each].null_count == len(now[name]) for each in later)
    whole = Opened()
    whole.add_partition(partition)
    with whole.reading() as connection:
        shown = connection.execute(select(results.c.scale_offset_ppm)).scalars().all()
        of_trackers = connection.execute(select(tracker_values.c.scale_offset_ppm)).scalars()
        assert [*shown, *of_trackers] == [None] * 9
    pq.write_table(partition, place / "earlier.parquet")
    read = ParquetArchive(place).read("earlier.parquet", columns_of(WHOLE), None)
    assert read.num_rows == 3
    assert not set(later) & set(read.column_names)


@pytest.mark.both_databases
def test_a_history_over_archived_time_counts_every_batch(filled, place):
    span = {"start": START, "end": shifted(START, 12 * 20_000.0)}
    wanted = filled.spacecraft.history("XTE", size=1_500, **span)
    archiving.archive(filled.store, place, LATER)
    found = filled.spacecraft.history("XTE", size=1_500, **span)
    assert sum(found.batches) == sum(wanted.batches) == 12


def test_an_archive_takes_one_command_at_a_time(filled, place):
    with folder.locked(place), pytest.raises(BadConfiguration, match="another command"):
        archiving.archive(filled.store, place, LATER)


def test_numbers_are_compared_bit_by_bit():
    def table(*values):
        return {"t": pa.table({"x": pa.array(values, pa.float64())})}

    assert rows.differing(table(0.0), table(-0.0)) == "t"
    assert rows.differing(table(math.nan, None), table(math.nan, None)) is None
    assert rows.differing(table(1.0), table(math.nextafter(1.0, 2.0))) == "t"
    assert rows.differing(table(None), table(0.0)) == "t"


def test_a_restored_run_is_still_tracked(filled, place, opened, tmp_path):
    """Else it could be continued without tracking, and would mix both."""
    noted = update(runs).where(runs.c.name == "r").values(tracked=True)
    filled.store.writer.change(lambda connection: connection.execute(noted))
    archiving.archive(filled.store, place, LATER)
    again = Store(f"sqlite:///{tmp_path / 'again.db'}")
    try:
        restore(again, place, PartFilter())
        with again.reading() as connection:
            found = dict(connection.execute(select(runs.c.name, runs.c.tracked)).all())
    finally:
        again.close()
    assert found == {"live": False, "r": True}


def test_what_a_running_command_writes_is_not_reported_as_left_over(filled, place):
    archiving.archive(filled.store, place, LATER)
    (day, *_) = folder.day_folders(place)
    (day / "part-9.parquet.part").write_bytes(b"")
    with folder.locked(place):
        assert list(verify_archive(place, {})) == []
    assert [each for each in verify_archive(place, {}) if "was not written to its end" in each]


def test_a_full_disk_names_the_file_and_the_bytes_that_it_needs(filled, place, monkeypatch):
    # Not by RLIMIT_FSIZE: it is of the whole process, the files of the database among them.
    sync, refused = os.fsync, []

    def full_disk(descriptor):
        status = os.fstat(descriptor)
        if stat.S_ISREG(status.st_mode) and status.st_size > 600:
            refused.append(status.st_size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(descriptor)

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full_disk)
        with pytest.raises(OSError, match=r"needs [0-9]+ bytes, and [0-9]+ are free") as full:
            archiving.archive(filled.store, place, LATER)
    assert f"needs {refused[0]} bytes" in str(full.value)
    assert Path(full.value.filename).is_relative_to(place)
    assert not [each for each in place.rglob("*") if each.name.endswith((".part", ".parquet"))]
    assert archived_ids(filled.store) == set()
    assert archiving.archive(filled.store, place, LATER).batches
