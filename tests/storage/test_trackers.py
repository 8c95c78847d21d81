"""Of a spacecraft with several trackers each has trends of its own, older batches included."""

import itertools
import math

import pytest
from sqlalchemy import delete, insert, select

from service.cli import main
from service.errors import BadInput
from service.observations.schema import OptionsIn
from service.storage.projections import rollups
from service.storage.sql.tables import (
    tracker_rollups_daily,
    tracker_rollups_hourly,
    tracker_splits,
    tracker_values,
)
from service.storage.upkeep import split_trackers
from service.storage.upkeep.prune import prune
from service.storage.upkeep.verify import verify
from service.times import parse_utc
from tests.storage.twin import FIRST, SECOND, lone, submission, twin

pytestmark = pytest.mark.both_databases

TIGHT = OptionsIn.model_validate({"identifier": "starid", "tolerances": {"separation_deg": 1e-5}})
OF_TRACKERS = (tracker_values, tracker_rollups_hourly, tracker_rollups_daily)
ALL = {"start": parse_utc("1996-01-01T00:00:00Z"), "end": parse_utc("1996-02-01T00:00:00Z")}


@pytest.fixture
def mission(missions):
    return twin(missions)


@pytest.fixture
def twins(opened, mission):
    return opened(mission)


def fill(app, sky, mission, count=12, **wanted):
    """Batches over nine hours, whose second tracker is noisy."""
    given = {"noise_arcsec": (1.0, 9.0), "offset_mag": 0.15} | wanted
    made = [submission(sky, mission, f"b{k}", after_s=3000.0 * k, **given) for k in range(count)]
    answered = app.submissions.submit_many(made)
    with app.store.reading():
        """All is projected."""
    return [each.id for each in answered]


def rows_of(app):
    with app.store.reading() as connection:
        return [
            sorted(map(tuple, connection.execute(select(table))), key=lambda row: row[:4])
            for table in OF_TRACKERS
        ]


def assert_alike(one, other):
    """Sums in another order may differ in their last digit."""
    for a, b in zip(itertools.chain(*one), itertools.chain(*other), strict=True):
        assert all(
            x == (pytest.approx(y, rel=1e-12, abs=1e-12) if isinstance(y, float) else y)
            for x, y in zip(a, b, strict=True)
        )


def assert_whole(app):
    assert verify(app.settings.database) == []


def test_each_tracker_has_its_own_values(twins, sky, mission):
    (id,) = fill(twins, sky, mission, 1)
    answer = twins.results.get(id).answer
    with twins.store.reading() as connection:
        rows = connection.execute(select(tracker_values)).mappings().all()
    assert [row["tracker"] for row in rows] == [FIRST, SECOND]
    squares, expected = 0.0, 0.0
    for row, found in zip(rows, answer.observations, strict=True):
        used = [star.residual_arcsec for star in found.stars if star.residual_arcsec is not None]
        rms = math.sqrt(sum(each**2 for each in used) / len(used))
        assert row["residual_rms_arcsec"] == pytest.approx(rms)
        assert row["observed"] == len(found.stars)
        squares += len(used) * row["residual_rms_arcsec"] ** 2
        expected += len(used) * row["predicted_rms_arcsec"] ** 2
    count = answer.counts.unique
    assert math.sqrt(squares / count) == pytest.approx(answer.attitude.residual_rms_arcsec)
    assert math.sqrt(expected / count) == pytest.approx(answer.attitude.predicted_rms_arcsec)
    assert rows[0]["magnitude_offset_mag"] == pytest.approx(0.0, abs=1e-9)
    assert rows[1]["magnitude_offset_mag"] == pytest.approx(0.15)


@pytest.mark.parametrize("size", [1, 3, 500])
def test_a_history_of_a_tracker_is_that_of_its_values(twins, sky, mission, size):
    """From batches, hours and days alike."""
    fill(twins, sky, mission)
    with twins.store.reading() as connection:
        rows = connection.execute(select(tracker_values)).mappings().all()
    for tracker in (FIRST, SECOND):
        of_batches = [row["residual_rms_arcsec"] for row in rows if row["tracker"] == tracker]
        shown = twins.spacecraft.history("XTE", tracker=tracker, size=size, **ALL)
        series = shown.series["residual_rms_arcsec"]
        total = sum(n * mean for n, mean in zip(series.count, series.mean, strict=True) if n)
        assert total == pytest.approx(sum(of_batches))
        assert max(filter(None, series.max)) == pytest.approx(max(of_batches))
        assert (shown.tracker, shown.not_split) == (tracker, False)
        latest = twins.spacecraft.history("XTE", tracker=tracker, strategy="latest", **ALL)
        assert sorted(latest.series["residual_rms_arcsec"].value) == pytest.approx(
            sorted(of_batches)
        )
        assert "a_priori_angle_deg" not in shown.series


def test_the_worst_batches_are_those_of_the_tracker(twins, sky, mission):
    fill(twins, sky, mission)
    worst = twins.spacecraft.ranking("XTE", by="residual_rms_arcsec", tracker=SECOND).items
    with twins.store.reading() as connection:
        query = select(tracker_values.c.residual_rms_arcsec).where(
            tracker_values.c.tracker == SECOND
        )
        wanted = sorted(connection.scalars(query), reverse=True)
    assert [each.value for each in worst] == pytest.approx(wanted)


def test_what_a_tracker_has_not_is_refused(twins, missions):
    with pytest.raises(BadInput, match="tracker: XTE has STARTRACKER_1, STARTRACKER_2"):
        twins.spacecraft.history("XTE", tracker="STARTRACKER_3")
    with pytest.raises(BadInput, match="quantity: a tracker has"):
        twins.spacecraft.history("XTE", tracker=FIRST, quantities=["a_priori_angle_deg"])
    with pytest.raises(BadInput, match="by: a tracker has"):
        twins.spacecraft.ranking("XTE", by="a_priori_angle_deg", tracker=FIRST)


def test_of_a_single_tracker_nothing_more_is_stored(app, make, missions):
    """Its values are the spacecraft's."""
    app.submissions.submit(make())
    assert rows_of(app) == [[], [], []]
    (tracker,) = missions["XTE"].trackers
    own = app.spacecraft.history("XTE", tracker=tracker.name)
    whole = app.spacecraft.history("XTE", quantities=list(own.series))
    assert own.series == whole.series
    assert own.not_split is False


def test_an_adopted_result_replaces_the_values_of_its_trackers(twins, sky, mission):
    ids = fill(twins, sky, mission, 3)
    before = rows_of(twins)
    twins.results.what_if(ids[1], TIGHT, record=True)
    assert rows_of(twins) == before
    twins.results.what_if(ids[1], TIGHT, adopt=True)
    assert rows_of(twins)[0] != before[0]
    assert_whole(twins)


def test_pruning_takes_the_trackers_part_with_it(twins, sky, mission):
    fill(twins, sky, mission)
    prune(twins.store, parse_utc("1996-01-10T15:10:00Z"))
    assert_whole(twins)
    prune(twins.store, parse_utc("1997-01-01T00:00:00Z"))
    assert rows_of(twins) == [[], [], []]


def unsplit(app):
    """As if the batches were recorded before the second tracker was there."""

    def change(connection):
        for table in OF_TRACKERS:
            connection.execute(delete(table))
        owner = {"spacecraft": "XTE", "run": "live"}
        connection.execute(insert(tracker_splits), owner)

    app.context.change(change)


@pytest.mark.parametrize("at_once", [1, 5, 50])
def test_older_batches_are_split_as_if_they_were_recorded_now(
    twins, sky, mission, monkeypatch, at_once
):
    monkeypatch.setattr(split_trackers, "AT_ONCE", at_once)
    fill(twins, sky, mission, 6)
    before = rows_of(twins)
    unsplit(twins)
    assert twins.spacecraft.history("XTE", tracker=SECOND).not_split
    assert_whole(twins)
    assert twins.upgrade.splitter.split() == 6
    assert_alike(rows_of(twins), before)
    assert not twins.spacecraft.history("XTE", tracker=SECOND).not_split
    assert_whole(twins)


def test_splitting_goes_on_where_it_was_stopped(opened, twins, sky, mission, monkeypatch):
    """New batches and adopted results in between are part of it."""
    monkeypatch.setattr(split_trackers, "AT_ONCE", 2)
    ids = fill(twins, sky, mission, 7)
    unsplit(twins)
    steps = iter((False, False, True))
    assert twins.upgrade.splitter.split(is_stopped=lambda: next(steps)) == 4
    assert_whole(twins)
    twins.submissions.submit(submission(sky, mission, "new", after_s=100.0))
    twins.results.what_if(ids[0], TIGHT, adopt=True)
    twins.results.what_if(ids[6], TIGHT, adopt=True)
    assert_whole(twins)
    twins.close()
    again = opened(mission)
    assert again.upgrade.splitter.split() == 4
    assert again.upgrade.splitter.waiting() == []
    assert {row[1] for row in rows_of(again)[0]} == {FIRST, SECOND}
    assert len(rows_of(again)[0]) == 16
    assert_whole(again)


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_two_processes_that_split_do_it_once(twins, opened, sky, mission, monkeypatch):
    monkeypatch.setattr(split_trackers, "AT_ONCE", 2)
    fill(twins, sky, mission, 5)
    before = rows_of(twins)
    unsplit(twins)
    one, other = twins.upgrade.splitter, opened(mission).upgrade.splitter
    owner = ("XTE", "live")
    while one.waiting():
        one._step(owner)
        other._step(owner)
    assert_alike(rows_of(twins), before)
    assert_whole(twins)


def test_a_mission_that_gets_a_second_tracker_is_split_from_its_beginning(
    opened, sky, missions, mission
):
    single = lone(missions)
    app = opened(single)
    fill(app, sky, single, 3)
    app.close()
    app = opened(mission)
    assert app.upgrade.splitter.waiting() == [("XTE", "live")]
    assert app.upgrade.splitter.split() == 3
    assert {row[1] for row in rows_of(app)[0]} == {FIRST}
    assert_whole(app)
    app.close()
    assert opened(mission).upgrade.splitter.waiting() == []


def test_the_command_splits_what_is_waiting(opened, twins, sky, mission, tmp_path, capsys):
    """The missions are those of the folder: there XTE has one tracker, and nothing is waiting."""
    fill(twins, sky, mission, 2)
    unsplit(twins)
    database = twins.settings.database
    twins.close()
    assert main(["database", "split-trackers", "--database", database]) == 0
    assert "0 batches" in capsys.readouterr().out


def test_verify_tells_of_values_that_are_not_those_of_the_stars(twins, sky, mission):
    fill(twins, sky, mission, 2)

    def spoil(connection):
        connection.execute(
            tracker_values.update()
            .where(tracker_values.c.tracker == SECOND)
            .values(unmatched=tracker_values.c.unmatched + 1)
        )

    twins.context.change(spoil)
    found = "\n".join(verify(twins.settings.database))
    assert "its trackers' counts are not those of their stars" in found
    assert f"trends of XTE, run live, {SECOND}, hour" in found
    with twins.store.reading() as connection:
        stored = rollups.stored(connection, "day", of_trackers=True)
    assert {key[2] for key in stored} == {FIRST, SECOND}


def test_verify_tells_of_batches_that_were_never_split(twins, sky, mission):
    fill(twins, sky, mission, 2)

    def forget(connection):
        for table in OF_TRACKERS:
            connection.execute(delete(table))

    twins.context.change(forget)
    assert "is not split by them" in "\n".join(verify(twins.settings.database))
