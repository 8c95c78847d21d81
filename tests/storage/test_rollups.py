"""Trends are at every moment the sums over the results that are current."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from service.errors import BadInput
from service.observations.schema import OptionsIn
from service.storage.queries import time_buckets
from service.times import parse_utc
from tests.storage.recount import assert_equal_to_a_recount
from tests.storage.samples import KINDS

pytestmark = pytest.mark.both_databases

TIGHT = OptionsIn.model_validate({"identifier": "starid", "tolerances": {"separation_deg": 1e-5}})
WIDE = OptionsIn.model_validate({"identifier": "starid", "tolerances": {"separation_deg": 0.05}})

BATCH = st.fixed_dictionaries(
    {
        "kind": st.sampled_from(KINDS),
        "run": st.sampled_from(["live", "again"]),
        "spacecraft": st.sampled_from(["XTE", "SWAS"]),
        "after_s": st.sampled_from([0.0, 1800.0, 3600.0, 50_000.0]),
    }
)
WHAT_IF = st.tuples(
    st.integers(0, 1000), st.sampled_from([TIGHT, WIDE]), st.booleans(), st.booleans()
)


def assert_trends_whole(app):
    with app.store.reading() as connection:
        assert_equal_to_a_recount(connection)


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=st.lists(st.one_of(BATCH, WHAT_IF, st.lists(BATCH, max_size=4)), max_size=10))
@pytest.mark.slow("postgresql")
def test_they_equal_a_recount_after_any_sequence_of_batches_and_adoptions(app, make, steps):
    ids = []
    serial = iter(range(len(steps) * 10))

    def named(wanted):
        # Examples share a database: names tell them apart, and the sums must hold all the same.
        return make(f"{id(steps)}-{next(serial)}", **wanted)

    for step in steps:
        if isinstance(step, dict):
            ids.append(app.submissions.submit(named(step)).id)
        elif isinstance(step, list):
            ids += [each.id for each in app.submissions.submit_many([named(each) for each in step])]
        elif ids:
            chosen, options, record, adopt = step
            answered = app.results.what_if(ids[chosen % len(ids)], options, record, adopt)
            ids += [answered.id] if answered.id else []
    assert_trends_whole(app)


def test_an_adopted_result_takes_the_place_of_the_old_one(app, make):
    first = app.submissions.submit(make(kind="suspect"))
    (before,) = app.spacecraft.rates("XTE")
    assert (before.unique, before.solved, before.suspect) == (5, 1, 1)
    app.results.what_if(first.id, TIGHT, record=True)
    assert app.spacecraft.rates("XTE") == [before]
    app.results.what_if(first.id, TIGHT, adopt=True)
    (after,) = app.spacecraft.rates("XTE")
    assert (after.unique, after.unmatched) == (4, 1)
    assert (after.batches, after.solved, after.suspect) == (1, 1, 0)
    assert_trends_whole(app)


def test_live_rates_never_include_a_named_run(app, make):
    app.submissions.submit(make("b1"))
    app.submissions.submit(make("b1", run="again"))
    app.submissions.submit(make("b2", run="again"))
    assert [each.batches for each in app.spacecraft.rates("XTE")] == [1]
    assert [each.batches for each in app.spacecraft.rates("XTE", run="again")] == [2]


def test_buckets_are_utc_hours_and_days_of_the_batch_time(app, make):
    for index, hours in enumerate((0, 0.5, 1, 11.75, 12.25)):
        app.submissions.submit(make(f"b{index}", after_s=3600 * hours))
    hourly = app.spacecraft.rates("XTE", bucket="hour")
    assert [(each.start[11:16], each.batches) for each in hourly] == [
        ("12:00", 2),
        ("13:00", 1),
        ("23:00", 1),
        ("00:00", 1),
    ]
    daily = app.spacecraft.rates("XTE", bucket="day")
    assert [(each.start, each.batches) for each in daily] == [
        ("1996-01-10T00:00:00.000Z", 4),
        ("1996-01-11T00:00:00.000Z", 1),
    ]


@pytest.mark.parametrize(
    ("start", "end", "hours"),
    [
        ("1996-01-10T12:30:00Z", None, [12, 13]),
        ("1996-01-10T13:00:00Z", None, [13]),
        (None, "1996-01-10T13:00:00Z", [12]),
        (None, "1996-01-10T13:00:00.001Z", [12, 13]),
        ("1996-01-10T14:00:00Z", "1996-01-10T15:00:00Z", []),
    ],
)
def test_a_range_takes_the_buckets_it_touches(app, make, start, end, hours):
    app.submissions.submit(make("b1"))
    app.submissions.submit(make("b2", after_s=3600))
    given_range = {"start": start and parse_utc(start), "end": end and parse_utc(end)}
    shown = app.spacecraft.rates("XTE", **given_range)
    assert [int(each.start[11:13]) for each in shown] == hours


def test_a_stretch_with_more_buckets_than_an_answer_holds_is_refused(app, make, monkeypatch):
    for hour in range(3):
        app.submissions.submit(make(f"b{hour}", after_s=3600 * hour))
    monkeypatch.setattr(time_buckets, "MAX_RATES", 3)
    assert len(app.spacecraft.rates("XTE")) == 3
    monkeypatch.setattr(time_buckets, "MAX_RATES", 2)
    with pytest.raises(BadInput, match=r"start: .* more than 2 hours hold batches: .* or for days"):
        app.spacecraft.rates("XTE")
    assert len(app.spacecraft.rates("XTE", start=parse_utc("1996-01-10T13:00:00Z"))) == 2
    assert len(app.spacecraft.rates("XTE", bucket="day")) == 1
