"""Advice over what is recorded: a fair sample, the same from either database, nothing changed."""

import json
import threading

import pytest
from msgspec import to_builtins
from sqlalchemy import func, select

from service.acquire import acquire
from service.errors import BadBatch, Busy, NotFound
from service.features.advice.advice import advise
from service.features.advice.part import AdviceService, ZoneSizes, advice_record
from service.features.advice.statements import zone_statements
from service.observations.schema import OptionsIn, submission_from_json, tolerances_from_text
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.storage.archived import Archive
from service.storage.queries.pages import ResultFilter
from service.storage.queries.results import sample_batches
from service.storage.sql.tables import results, star_results
from service.times import parse_utc
from tests.scale import draws

BATCHES = 40


@pytest.fixture
def recorded(app, missions, sky, seed):
    """A run of XTE on the database; its bodies in order of time."""
    drawn = draw_pass(missions["XTE"], sky, Pass(BATCHES, seed))
    bodies = [each.batch | {"run": "night"} for each in drawn]
    answers = app.submissions.submit_many([submission_from_json(json.dumps(b)) for b in bodies])
    assert all(not isinstance(each, Exception) for each in answers)
    return bodies


def drawn_from(app, size, seed=0, **stretch):
    with app.store.reading() as connection:
        return sample_batches(
            connection, Archive(), ResultFilter("night", "XTE", **stretch), size, seed
        )


def rows(app):
    with app.store.reading() as connection:
        return [
            connection.scalar(select(func.count()).select_from(table))
            for table in (results, star_results)
        ]


@pytest.mark.both_databases
def test_a_sample_has_as_many_batches_as_were_asked_for_and_none_twice(app, recorded):
    """Also where it is most of them, so that the parts are shorter than two batches."""
    for size in range(1, BATCHES + 3):
        for seed in range(draws(2, 5)):
            drawn = drawn_from(app, size, seed)
            names = {batch.batch for batch in drawn.batches}
            assert len(names) == len(drawn.batches) == min(size, BATCHES)


def test_a_sample_is_spread_over_the_whole_range(app, recorded):
    """One batch of each of ten equal parts, whatever the seed."""
    order = [body["batch"] for body in recorded]
    for seed in range(5):
        drawn = drawn_from(app, 10, seed)
        places = sorted(order.index(batch.batch) for batch in drawn.batches)
        assert drawn.total == BATCHES
        assert [place // 4 for place in places] == list(range(10))


def test_a_sample_that_holds_all_holds_each_once(app, recorded):
    for size in (BATCHES, 1000):
        drawn = drawn_from(app, size)
        assert sorted(batch.batch for batch in drawn.batches) == sorted(
            body["batch"] for body in recorded
        )
        assert (drawn.first, drawn.last) == (recorded[0]["time"], recorded[-1]["time"])


def test_the_same_seed_draws_the_same(app, recorded):
    once, again = (drawn_from(app, 7, seed=3).batches for _ in range(2))
    assert [batch.batch for batch in once] == [batch.batch for batch in again]


def test_a_stretch_bounds_the_sample(app, recorded):
    start, end = parse_utc(recorded[10]["time"]), parse_utc(recorded[20]["time"])
    drawn = drawn_from(app, 1000, start=start, end=end)
    assert drawn.total == 10
    assert {batch.batch for batch in drawn.batches} == {b["batch"] for b in recorded[10:20]}


def test_of_a_batch_with_an_adopted_what_if_the_current_options_hold(app, make):
    first = app.submissions.submit(make(run="night"))
    options = OptionsIn.model_validate(
        {"identifier": "starid", "tolerances": {"separation_deg": 0.01}}
    )
    app.results.what_if(first.id, options, adopt=True)
    (batch,) = drawn_from(app, 10).batches
    assert batch.options.tolerances == {"separation_deg": 0.01}


@pytest.mark.both_databases
def test_the_advice_is_that_of_the_batches_themselves_and_changes_nothing(
    app, recorded, missions, sky
):
    """As the core gives it of the same bodies, without any database."""
    before = rows(app)
    own = tolerances_from_text(["separation_deg=0.01"], "--try")
    found = app.part(AdviceService).of_spacecraft("XTE", run="night", sample=1000, tolerances=own)
    assert rows(app) == before
    batches = [submission_from_json(json.dumps(body)).batch for body in recorded]
    mission = missions["XTE"]
    with app.store.reading() as connection:
        sample = sample_batches(connection, Archive(), ResultFilter("night", "XTE"), 1000)
    plain = advise(
        mission,
        batches,
        lambda b: acquire(b, mission.within_zones, sky),
        lambda b: acquire(b, mission, sky),
        {"separation_deg": 0.01},
        run_with=lambda other, b: acquire(b, other.within_zones, sky),
    )
    about = ("spacecraft", "run", "first", "last", "batches_in_range")
    assert [getattr(found, name) for name in about] == [
        "XTE",
        "night",
        recorded[0]["time"],
        recorded[-1]["time"],
        BATCHES,
    ]
    zone = zone_statements(mission, *ZoneSizes(app.context).advised("XTE", "night"))
    # Batches came in another order, which sums of floats may tell in their last digit.
    expected = to_builtins(advice_record("XTE", "night", sample, plain, zone))
    given = to_builtins(found)
    # Advice on the gyro comes from recorded innovations, and none are recorded here.
    assert [(each["subject"], each["action"]) for each in given["innovations"]] == [
        ("gyro", "wait")
    ]
    assert _rounded(given | {"innovations": [], "causes": []}) == _rounded(expected)


def _rounded(thing):
    if isinstance(thing, dict):
        return {key: _rounded(value) for key, value in thing.items()}
    if isinstance(thing, list | tuple):
        return [_rounded(value) for value in thing]
    return float(f"{thing:.8g}") if isinstance(thing, float) else thing


def test_a_run_without_batches_gives_no_advice_and_no_error(app):
    found = app.part(AdviceService).of_spacecraft("SOHO")
    assert (found.first, found.batches_in_range, found.changes) == (None, 0, [])


def test_an_unknown_spacecraft_is_named(app):
    with pytest.raises(NotFound, match="NOPE"):
        app.part(AdviceService).of_spacecraft("NOPE")


def test_while_advice_is_worked_out_another_asks_again_later(app, recorded):
    begun, go_on = threading.Event(), threading.Event()

    def step():
        begun.set()
        go_on.wait(30)

    found = []
    thread = threading.Thread(
        target=lambda: found.append(
            app.part(AdviceService).of_spacecraft("XTE", run="night", sample=2, step=step)
        )
    )
    thread.start()
    try:
        assert begun.wait(30)
        with pytest.raises(Busy, match="advice"):
            app.part(AdviceService).of_spacecraft("XTE", run="night")
    finally:
        go_on.set()
        thread.join()
    assert found[0].batches_sampled == 2
    assert app.part(AdviceService).of_spacecraft("XTE", run="night", sample=1).batches_sampled == 1


@pytest.mark.parametrize(
    "text", ["separation_deg", "separation_deg=wide", "separation_deg=nan", "magnitude=1", "=1"]
)
def test_a_tolerance_that_cannot_be_is_refused_by_its_name(text):
    with pytest.raises(BadBatch, match="--try"):
        tolerances_from_text([text], "--try")
