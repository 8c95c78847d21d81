"""Histories: thinned out on the server, exact at both ends, no extreme lost."""

import math
from datetime import datetime
from itertools import count

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from service.storage.queries import time_buckets
from service.times import parse_utc, shifted, unix_seconds, utc_of_unix
from service.trends.measures import Rate
from service.trends.quantities import QUANTITIES, trend_names
from tests.storage.bulk import put, result_row

pytestmark = pytest.mark.both_databases

# Examples share a database: each has a run of its own.
RUNS = count()
START = parse_utc("2016-12-31T20:30:00Z")
"""A leap second lies three and a half hours ahead."""

RESULT = st.tuples(
    st.integers(0, 6 * 3600 * 1000),
    st.integers(0, 5),
    st.integers(0, 5),
    st.sampled_from(["good", "suspect", None]),
    st.floats(0.01, 50),
    st.one_of(st.none(), st.floats(-2, 2)),
)


def rows_of(app, drawn, run):
    rows = []
    for after_ms, ambiguous, unmatched, status, rms, offset in drawn:
        unmatched = min(unmatched, 5 - ambiguous)
        solved = status is not None
        values = {
            "ambiguous": ambiguous,
            "unmatched": unmatched,
            "unique": 5 - ambiguous - unmatched,
            "status": status,
            "reason": None if solved else "fewer_than_two_unique_stars",
            "residual_rms_arcsec": rms if solved else None,
            "predicted_rms_arcsec": 2.5 if solved else None,
            "magnitude_offset_mag": offset,
            "a_priori_angle_deg": rms / 10 if solved else None,
        }
        time = shifted(START, after_ms / 1000)
        rows.append(result_row(app, time, run=run, **values))
    return rows


def expected(rows, start, end, width_s, name):
    """Every bucket's batches, mean, least and greatest, from the rows themselves."""
    found = {}
    for _, row in rows:
        if start.tai_ns <= row["time_ns"] < end.tai_ns:
            (unix_s,) = unix_seconds([row["time_ns"]])
            found.setdefault(math.floor(unix_s / width_s) * width_s, []).append(row)
    for bucket, inside in sorted(found.items()):
        values = [v for row in inside if (v := QUANTITIES[name].value_of(row)) is not None]
        mean = sum(values) / len(values) if values else None
        yield bucket, len(inside), mean, min(values, default=None), max(values, default=None)


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    drawn=st.lists(RESULT, min_size=1, max_size=40),
    begin_s=st.integers(-100, 8000),
    length_s=st.integers(1, 6 * 3600),
    size=st.sampled_from([1, 2, 5, 30, 300]),
    at_most=st.sampled_from([1, 10_000]),
)
def test_thinning_out_keeps_the_least_and_greatest_of_every_bucket(
    app, drawn, begin_s, length_s, size, at_most
):
    """Summed from batches and read from rollups alike, whatever hour the ends cut through."""
    run = f"r{next(RUNS)}"
    rows = rows_of(app, drawn, run)
    put(app, rows)
    start = shifted(START, begin_s)
    end = shifted(start, length_s)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time_buckets, "MAX_BATCHES_SUMMED", at_most)
        shown = app.spacecraft.history("XTE", run=run, start=start, end=end, size=size)
    assert len(shown.unix_s) <= size or shown.bucket_s == 3600
    for name in trend_names():
        if isinstance(QUANTITIES[name].source, Rate):
            continue
        series = shown.series[name]
        found = list(
            zip(
                *(shown.unix_s, shown.batches),
                *(series.mean, series.min, series.max),
                strict=True,
            )
        )
        wanted = list(expected(rows, start, end, shown.bucket_s, name))
        assert [(f[0], f[1], f[3], f[4]) for f in found] == [(w[0], w[1], *w[3:]) for w in wanted]
        for (*_, mean, _, _), (*_, correct, _, _) in zip(found, wanted, strict=True):
            assert mean == (None if correct is None else pytest.approx(correct))


@pytest.mark.parametrize(
    "first",
    [
        "2016-12-31T20:30:00Z",
        "2017-01-01T00:00:00Z",
        "2016-12-29T12:26:40Z",
        # Where a binary fraction for the nanoseconds would fall short of the second.
        "1983-06-01T11:00:00Z",
    ],
)
def test_days_hours_and_their_parts_make_up_the_same_sums(app, first):
    """Wherever the stretch lies, a leap second in it or not, and of a single result as of many."""
    start = parse_utc(first)
    rows = [
        result_row(app, shifted(start, after_s), ambiguous=k % 3, unique=5 - k % 3)
        for k, after_s in enumerate([12_600.2, *(3000 * k + 0.5 for k in range(150))])
    ]
    put(app, rows)
    for begin_s, end_s in ((2500, 360_000), (4000, 5000), (0, 12_601), (3000.5, 6000.5)):
        span = time_buckets.BucketFilter(
            "XTE", "live", shifted(start, begin_s), shifted(start, end_s)
        )
        with app.store.reading() as connection:
            found = {
                each: time_buckets.read_buckets(connection, span, each) for each in ("hour", "day")
            }
            for width_s in (60, 1800, 86_400):
                steps = found[width_s] = time_buckets.read_steps(connection, span, width_s)
                assert not (steps["unix_s"] % width_s).any()
                assert len(set(steps["unix_s"])) == len(steps["unix_s"])
        inside = [row for _, row in rows if span.start.tai_ns <= row["time_ns"] < span.end.tai_ns]
        for each in found.values():
            counts = time_buckets.totals(each)
            assert counts["batches"] == len(inside)
            assert counts["observed"] == 5 * len(inside)
            assert counts["ambiguous"] == sum(row["ambiguous"] for row in inside)
            assert counts["solved"] == len(inside)


def test_a_dense_stretch_is_read_in_as_many_rows_as_it_shows(app):
    """An hour of a thousand batches a second must not be held in memory, nor sent."""
    rows = [result_row(app, shifted(START, k / 10), ambiguous=k % 2) for k in range(3000)]
    put(app, rows)
    with app.store.reading() as connection:
        span = time_buckets.BucketFilter("XTE", "live", START, shifted(START, 300))
        assert len(time_buckets.read_steps(connection, span, 60)["batches"]) == 5
        assert len(time_buckets.read_buckets(connection, span, "day")["batches"]) == 1
    shown = app.spacecraft.history("XTE", start=START, end=shifted(START, 300), size=5)
    assert shown.batches == [600] * 5
    item = next(each for each in app.spacecraft.overview().items if each.name == "XTE")
    assert sum(item.sparkline_hour.batches) == 3000
    assert len(item.sparkline_hour.batches) == 3


def test_a_year_is_read_from_days_and_a_month_from_hours(app):
    put(app, [result_row(app, shifted(START, 43200.0 * k)) for k in range(720)])
    end = shifted(START, 365 * 86400)
    year = app.spacecraft.history("XTE", start=START, end=end, size=400)
    assert (year.source, year.bucket_s) == ("day", 86400)
    assert sum(year.batches) == 720
    month = app.spacecraft.history("XTE", start=START, end=shifted(START, 30 * 86400), size=1000)
    assert month.bucket_s == 3600 or month.source == "batch"
    assert sum(month.batches) == 60


def test_without_a_range_it_is_the_day_up_to_the_latest_batch(app):
    put(app, [result_row(app, shifted(START, 3600.0 * k)) for k in range(60)])
    shown = app.spacecraft.history("XTE")
    assert sum(shown.batches) == 24
    assert shown.end.startswith(shifted(START, 59 * 3600).text[:19])


def test_of_a_spacecraft_without_a_batch_it_is_empty(app):
    for strategy in ("minmax", "latest"):
        shown = app.spacecraft.history("SWAS", strategy=strategy)
        assert shown.unix_s == []
        assert shown.start is None


def test_the_latest_are_single_batches_with_their_times(app):
    rows = [result_row(app, shifted(START, 60.0 * k), ambiguous=k % 5) for k in range(10)]
    put(app, rows)
    shown = app.spacecraft.history("XTE", strategy="latest", size=4, quantities=["ambiguous_share"])
    assert shown.time == [batch["time"] for batch, _ in rows[-4:]]
    assert shown.id == [batch["id"] for batch, _ in rows[-4:]]
    assert list(shown.series) == ["ambiguous_share"]
    assert len(shown.series["ambiguous_share"].value) == 4


def test_the_rate_of_batches_counts_the_hours_that_are_shown_of_a_bucket(app):
    put(app, [result_row(app, shifted(START, 30.0 * k)) for k in range(240)])
    shown = app.spacecraft.history("XTE", start=START, end=shifted(START, 7200), size=3)
    rate = shown.series["batches_per_hour"].mean
    assert rate == [pytest.approx(120.0)] * len(rate)


def test_the_last_bucket_of_a_few_batches_does_not_double_the_rate(app):
    start = parse_utc("2015-03-01T20:30:00Z")
    times = [shifted(start, 600.0 * k) for k in range(37)]
    put(app, [result_row(app, time) for time in times])
    end = shifted(times[-1], 0.001)
    rate = app.spacecraft.history("XTE", start=start, end=end, size=8).series["batches_per_hour"]
    assert rate.mean[-1] is None
    assert [each for each in rate.mean if each is not None] == [pytest.approx(6.0)] * 5


@pytest.mark.parametrize(
    "text",
    [
        "2016-12-31T23:59:59.500Z",
        "2017-01-01T00:00:00.000Z",
        "1972-07-01T00:00:00Z",
        "2099-12-31T11:22:33.250Z",
    ],
)
def test_posix_times_are_those_of_the_library(text):
    correct = datetime.fromisoformat(text).timestamp()
    (found,) = unix_seconds([parse_utc(text).tai_ns])
    assert found == pytest.approx(correct, abs=1e-6)
    assert utc_of_unix(correct).tai_ns == parse_utc(text).tai_ns


@given(st.integers(63_072_000, 4_102_444_799))
def test_a_whole_second_is_a_whole_second_of_posix_time(unix_s):
    """What begins with an hour must not be counted to the hour before."""
    assert unix_seconds([utc_of_unix(unix_s).tai_ns]).tolist() == [unix_s]


def test_a_leap_second_belongs_to_the_hour_that_it_ends():
    (found,) = unix_seconds([parse_utc("2016-12-31T23:59:60.500Z").tai_ns])
    (midnight,) = unix_seconds([parse_utc("2017-01-01T00:00:00Z").tai_ns])
    assert midnight - 1e-3 < found < midnight


# ---- the worst batches -------------------------------------------------------------------------

BY = ["ambiguous_share", "residual_ratio", "magnitude_offset_mag", "a_priori_angle_deg"]


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    drawn=st.lists(RESULT, min_size=1, max_size=40),
    by=st.sampled_from(BY),
    limit=st.integers(1, 8),
    bounds=st.tuples(st.integers(0, 20000), st.integers(1, 20000)),
)
def test_the_worst_are_those_of_sorting_everything(app, drawn, by, limit, bounds):
    run = f"r{next(RUNS)}"
    rows = rows_of(app, drawn, run)
    put(app, rows)
    start, end = shifted(START, bounds[0]), shifted(START, sum(bounds))
    found = app.spacecraft.ranking("XTE", by=by, run=run, start=start, end=end, limit=limit).items
    inside = [
        (abs(value), row["time_ns"], row["id"])
        for _, row in rows
        if (value := QUANTITIES[by].value_of(row)) is not None
        and start.tai_ns <= row["time_ns"] < end.tai_ns
    ]
    assert [each.id for each in found] == [id for *_, id in sorted(inside, reverse=True)[:limit]]
    for each in found:
        assert abs(each.value) in {value for value, *_ in inside}


def test_across_runs_batches_are_listed_in_order_of_time(app):
    for k, run in enumerate(["live", "a", "b", "live"]):
        put(app, [result_row(app, shifted(START, k), run=run)])
    shown = app.results.page(run="*").items
    assert [each.run for each in shown] == ["live", "b", "a", "live"]
    first = app.results.page(run="*", spacecraft="XTE", limit=3)
    rest = app.results.page(run="*", spacecraft="XTE", limit=3, cursor=first.next_cursor)
    assert [each.run for each in rest.items] == ["live"]
