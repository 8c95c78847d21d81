"""Reprocessing into an archive: every batch once, byte-equal, and a run like any other."""

import json
import threading
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress

import pytest
from msgspec.structs import asdict
from sqlalchemy import func, select

from service.errors import BadBatch, BadConfiguration, Busy, Conflict
from service.features.alarms.part import Alarms
from service.features.archive import archiving, folder, partition_coordinator, reprocessed
from service.features.archive.part import Reprocessings
from service.missions.mission import Mission
from service.observations.schema import submission_from_json
from service.storage.projections import rollups
from service.storage.recording.unsaved_result import Answered
from service.storage.sql.tables import batches
from service.storage.upkeep.prune import prune
from service.storage.upkeep.verify import verify
from service.times import parse_utc, shifted
from tests.features.archive.partitions.checks import (
    BATCHES,
    PART,
    START,
    assert_trends,
    assert_whole,
    files_of,
    names_of,
)

ALL = BATCHES + 12
NOON = shifted(parse_utc(START), 10_000.0)


def again(app, place, run="again", **wanted):
    return app.part(Reprocessings).reprocess(run, place, **({"processes": 1} | wanted))


@pytest.mark.both_databases
def test_archived_and_recorded_batches_are_run_again_into_the_archive(archived, place, database):
    steps = []
    progress = again(archived, place, step=lambda p: steps.append(p.partitions_done))
    assert (progress.total, progress.before, progress.recorded) == (ALL, 0, ALL)
    assert progress.partitions == progress.partitions_done == steps[-1] > ALL // PART
    assert_whole(archived, place)
    assert verify(database) == []
    (run,) = [each for each in archived.runs.all() if each.run == "again"]
    assert run.batches == ALL
    (told,) = archived.part(Reprocessings).all()
    assert (told.run, told.partitions_done, told.recorded) == ("again", progress.partitions, ALL)
    assert told.left_s == 0.0
    assert told.finished is not None


def test_with_the_same_settings_every_star_comes_out_alike_and_with_others_not(
    archived, place, missions, opened
):
    again(archived, place)
    compared = archived.runs.compare("live", "again")
    assert compared.batches == ALL
    assert all(each.before == each.after for each in compared.stars.transitions)
    assert compared.attitudes.angle_arcsec.max == 0.0
    settings = missions["XTE"].model_dump()
    settings["identifier"] = "starid"
    settings["tolerances"]["separation_deg"] = 0.004
    archived.close()
    other = opened(mission=Mission.model_validate(settings), archive_folder=place)
    again(other, place, "tight", spacecraft="XTE")
    compared = other.runs.compare("live", "tight", "XTE")
    assert compared.batches == BATCHES
    assert any(each.is_change for each in compared.stars.transitions)
    other.close()
    with pytest.raises(BadBatch, match="holds results of XTE with another mission"):
        again(opened(archive_folder=place), place, "tight", spacecraft="XTE")


def test_trends_pages_and_lists_of_the_run_are_those_of_a_recorded_one(archived, place):
    """Held against the same batches run again into the database."""
    recorded = archived.runs.reprocess("recorded", processes=1)
    again(archived, place)
    source = archived.runs.compare("live", "again", "XTE", NOON)
    assert source.batches > recorded.recorded - 12
    for bucket in ("hour", "day"):
        live = [asdict(each) for each in archived.spacecraft.rates("XTE", bucket=bucket)]
        of_run = archived.spacecraft.rates("XTE", run="again", bucket=bucket)
        assert [asdict(each) for each in of_run] == live
    page = archived.results.page(run="again", spacecraft="XTE", limit=500).items
    lived = archived.results.page(spacecraft="XTE", limit=500).items
    assert [(each.batch, each.status, each.counts) for each in page] == [
        (each.batch, each.status, each.counts) for each in lived
    ]
    assert {each.archived for each in page} == {True, False}
    (row,) = [each for each in archived.spacecraft.overview("again").items if each.name == "XTE"]
    assert row.latest_batch.batch == lived[0].batch
    first = next(each for each in page if each.archived)
    answer = archived.results.get(first.id).answer
    assert (answer.run, answer.id, answer.timings_us.zone) == ("again", first.id, 0)


@pytest.mark.parametrize("processes", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_bytes_follow_from_the_input_alone(archived, place, processes):
    again(archived, place)
    made = files_of(place, "again")
    for file in made:
        (place / file).unlink()
    for manifest in folder.manifests(place):
        kept = [part for part in manifest.parts if part.run != "again"]
        folder.write_manifest(place, folder.Manifest(**(asdict(manifest) | {"parts": kept})))
    archived.store.writer.change(forget("again"))
    again(archived, place, processes=processes)
    assert files_of(place, "again") == made
    assert_whole(archived, place)


def test_of_several_who_write_the_same_file_the_first_one_s_stays(place):
    """What each was told is there: the manifest gets the hash of one of them."""
    with ThreadPoolExecutor(4) as pool:
        for number in range(8):
            file = place / "day=1996-01-10" / f"run-again-{number}.parquet"
            begin = threading.Barrier(4)

            def write(name, file=file, begin=begin):
                begin.wait()
                return folder.write_first(file, name)

            found = set(pool.map(write, [b"a", b"b", b"c", b"d"]))
            assert found == {file.read_bytes()}
    assert list(place.rglob("*.part")) == []


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
@pytest.mark.slow("postgresql")
def test_posts_meanwhile_are_recorded_or_archived_but_never_both(
    archived, opened, place, bodies, monkeypatch
):
    """A service records batches of the run while the command notes a part of it as archived."""
    service, real, posted = opened(archive_folder=place), reprocessed.note_part, []
    in_run = [submission_from_json(json.dumps(json.loads(b) | {"run": "again"})) for b in bodies]
    with ThreadPoolExecutor() as pool:

        def note_part(*arguments):
            if not posted and arguments[1] == "XTE":
                posted.append(pool.submit(service.submissions.submit_many, in_run[:PART]))
                # They wait for the end of this transaction.
                wait(posted, timeout=5.0)
            return real(*arguments)

        monkeypatch.setattr(reprocessed, "note_part", note_part)
        with suppress(BadConfiguration):
            again(archived, place)
        # A client whose batch was archived meanwhile is told to send it again.
        assert posted[0].exception() is None or isinstance(posted[0].exception(), Busy)
    answers = service.submissions.submit_many(in_run[:PART])
    found = names_of(archived, "again")
    assert len(found) == len(set(found))
    assert {("XTE", each.batch.batch) for each in in_run[:PART]} <= set(found)
    assert all(isinstance(each, Answered | Conflict) for each in answers)
    assert_trends(archived)


def forget(run):
    """A change that takes all of an archived run out of a database."""
    from service.storage.sql.columns import metadata
    from service.storage.upkeep.prune import delete_batches

    def change(connection):
        ids = list(connection.scalars(select(batches.c.id).where(batches.c.run == run)))
        delete_batches(connection, ids)
        names = ("archived_batches", "archived_parts", "archived_hours")
        rolled = [name for name in metadata.tables if "rollups" in name]
        for name in (*names, *rolled):
            table = metadata.tables[name]
            connection.execute(table.delete().where(table.c.run == run))

    return change


class _Stopped(Exception):
    pass


@pytest.mark.parametrize("at", ["name_part", "merge", "_take", "restore_newest"])
def test_what_ends_anywhere_goes_on_and_every_batch_comes_once(archived, place, monkeypatch, at):
    """Before and after each step of every partition in turn."""
    real = getattr(partition_coordinator, at)
    calls = 0
    for fails_after in (False, True):

        def fail(*given, fails_after=fails_after):
            nonlocal calls
            calls += 1
            if calls % 4:
                return real(*given)
            if fails_after:
                real(*given)
            raise _Stopped

        monkeypatch.setattr(partition_coordinator, at, fail)
        for _ in range(2):
            with pytest.raises(_Stopped):
                again(archived, place, f"again-{fails_after}")
    monkeypatch.setattr(partition_coordinator, at, real)
    for fails_after in (False, True):
        run = f"again-{fails_after}"
        progress = again(archived, place, run)
        assert progress.before + progress.recorded == progress.total == ALL
        assert_whole(archived, place, run)
    assert again(archived, place, run).recorded == 0


def test_a_period_is_run_again_and_then_the_rest(archived, place):
    end = shifted(parse_utc(START), 40 * 2_700.0)
    first = again(archived, place, spacecraft="XTE", start=NOON, end=end)
    assert first.recorded == 36
    assert len(names_of(archived, "again")) == 36
    rest = again(archived, place)
    assert (rest.before, rest.recorded) == (36, ALL - 36)
    assert_whole(archived, place)


def test_what_is_archived_only_after_it_was_run_again_is_not_run_twice(archived, place):
    again(archived, place)
    archiving.archive(archived.store, place, shifted(parse_utc(START), 10 * 86_400.0))
    progress = again(archived, place)
    assert (progress.before, progress.recorded) == (ALL, 0)
    assert names_of(archived, "again") == names_of(archived, "live")
    assert_trends(archived)


def test_what_is_pruned_of_the_newest_part_is_run_again(archived, place):
    again(archived, place, spacecraft="XTE")
    with archived.store.reading() as connection:
        recorded = select(batches.c.time).where(batches.c.run == "again").order_by(batches.c.time)
        times = list(connection.scalars(recorded))
    prune(archived.store, parse_utc(times[2]), "again")
    progress = again(archived, place, spacecraft="XTE")
    assert (progress.before, progress.recorded) == (BATCHES - 2, 2)
    assert len(names_of(archived, "again")) == BATCHES
    assert_trends(archived)


def test_a_run_that_has_recorded_batches_gets_no_second_ones(archived, place):
    """They are left out, wherever they are."""
    recorded = archived.runs.reprocess("again", processes=1)
    progress = again(archived, place)
    assert (progress.before, progress.recorded) == (recorded.recorded, ALL - recorded.recorded)
    assert names_of(archived, "again") == names_of(archived, "live")
    more = archived.runs.reprocess("again", processes=1)
    assert (more.before, more.recorded) == (recorded.recorded, 0)


def test_a_batch_that_no_longer_fits_is_refused_by_name_and_the_rest_goes_on(
    archived, place, missions, opened
):
    settings = missions["SWAS"].model_dump()
    settings["trackers"][0]["name"] = "OTHER"
    archived.close()
    renamed = opened(mission=Mission.model_validate(settings), archive_folder=place)
    progress = again(renamed, place)
    assert (progress.recorded, progress.refused) == (BATCHES, 12)
    assert "observations.0.tracker: SWAS has OTHER" in progress.refusals[0]
    once_more = again(renamed, place)
    assert (once_more.before, once_more.recorded, once_more.refused) == (BATCHES, 0, 12)


def test_limits_of_a_run_with_alarms_are_evaluated_in_order_of_time(archived, place, make):
    """As if the same batches had been replayed."""
    archived.runs.watch("replayed")
    archived.runs.watch("again")
    ids = archived.results.page(spacecraft="XTE", limit=500).items
    for each in ids[::-1]:
        body = dict(archived.results.get(each.id).input) | {"run": "replayed"}
        archived.submissions.submit(submission_from_json(json.dumps(body)))
    again(archived, place, spacecraft="XTE")

    def raised(run):
        return [
            (each.quantity, each.severity, each.raised.time, each.worst.value)
            for each in archived.part(Alarms).page(run=run, state="all", limit=100).items
        ]

    assert raised("again") == raised("replayed") != []


def test_the_live_run_and_the_source_are_no_targets(archived, place):
    with pytest.raises(BadBatch, match="must be another run"):
        again(archived, place, "live", source="live")
    with pytest.raises(BadBatch, match="must be another run"):
        again(archived, place, "live", source="pass")


def test_a_damaged_part_ends_it_by_name_and_what_was_done_stays(archived, place):
    parts = sorted(place.glob("spacecraft=XTE/*/part-*.parquet"))
    content = parts[-1].read_bytes()
    parts[-1].write_bytes(content[:-9] + bytes(9))
    with pytest.raises(BadConfiguration, match=rf"{parts[-1].name}: is damaged"):
        again(archived, place)
    parts[-1].write_bytes(content)
    progress = again(archived, place)
    assert progress.before > 0
    assert_whole(archived, place)


def test_an_archive_of_another_database_is_refused(archived, place, tmp_path):
    from service.app.factory import open_app
    from service.features.archive.archiving import PartFilter, restore
    from service.settings import Settings

    other = open_app(Settings(database=f"sqlite:///{tmp_path / 'other.db'}", replay_processes=0))
    try:
        restore(other.store, place, PartFilter())
        before = {file: file.read_bytes() for file in place.rglob("*.parquet")}
        with pytest.raises(BadConfiguration, match="belongs to another database"):
            archiving.archive(other.store, place, shifted(parse_utc(START), 10 * 86_400.0))
        with pytest.raises(BadConfiguration, match="belongs to another database"):
            again(other, place)
        assert {file: file.read_bytes() for file in place.rglob("*.parquet")} == before
        with other.store.reading() as connection:
            assert connection.scalar(select(func.count()).select_from(batches)) > 0
            assert rollups.stored(connection, "hour")
    finally:
        other.close()
