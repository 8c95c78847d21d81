"""The overview: shares of the last hour and day, ages, and what counts as latest."""

import pytest

from service.observations.schema import submission_from_json
from service.times import parse_utc, shifted, utc_now
from tests.storage.bulk import put, result_row

pytestmark = pytest.mark.both_databases

START = parse_utc("1999-03-01T00:00:00Z")


def item(app, name="XTE", run="live"):
    return next(each for each in app.spacecraft.overview(run).items if each.name == name)


def test_the_last_hour_and_day_end_with_the_runs_latest_batch(app):
    rows = [result_row(app, shifted(START, 600.0 * k), unique=4, ambiguous=1) for k in range(300)]
    put(app, rows)
    put(app, [result_row(app, shifted(START, 179_460), spacecraft="SWAS")])
    shown = app.spacecraft.overview()
    assert shown.as_of == shifted(START, 179_460).text
    found = item(app)
    assert found.last_hour.batches == 6
    assert found.last_day.batches == 144
    assert found.last_day.ambiguous == 144
    assert sum(found.sparkline_day.batches) == 144
    assert set(found.sparkline_hour.ambiguous_share) == {0.2}
    assert found.age_s == pytest.approx(60.0)
    assert item(app, "SWAS").last_hour.batches == 1


def test_the_day_is_the_same_from_hours_as_from_batches(app, monkeypatch):
    rows = [result_row(app, shifted(START, 317.0 * k), ambiguous=k % 4) for k in range(400)]
    put(app, rows)
    from_batches = item(app).last_day
    monkeypatch.setattr("service.storage.queries.time_buckets.MAX_BATCHES_SUMMED", 0)
    assert item(app).last_day == from_batches


def test_without_a_batch_nothing_is_made_up(app):
    shown = app.spacecraft.overview("nothing")
    assert shown.as_of is None
    for each in shown.items:
        assert each.state == "no_batches"
        assert each.last_hour is None
        assert each.sigma_arcsec is None


def test_the_sigma_is_that_of_the_last_attitude(app, make):
    app.submissions.submit(make("b1"))
    app.submissions.submit(make("b2", kind="one_star", after_s=60))
    found = item(app)
    assert found.state == "no_attitude"
    assert found.attitude is None
    assert found.last_attitude.batch == "b1"
    covariance = found.last_attitude.covariance_arcsec2
    assert found.sigma_arcsec == [pytest.approx(covariance[k][k] ** 0.5) for k in range(3)]


def test_a_live_batch_dated_far_ahead_is_never_the_latest(app, make):
    ahead = make("wrong").text.replace("1996-01-10T", "2098-01-10T")
    app.submissions.submit(make("right"))
    told = app.results.get(app.submissions.submit(submission_from_json(ahead.encode())).id)
    assert any(each.startswith("dated_ahead: ") for each in told.answer.warnings)
    found = item(app)
    assert found.latest_batch.batch == "right"
    assert app.spacecraft.overview().as_of == make("right").batch.time.text
    assert app.spacecraft.history("XTE").end.startswith("1996")
    # It is there all the same, and of a spacecraft with nothing else it is what there is.
    assert app.results.page().items[0].batch == "wrong"
    lone = ahead.replace('"XTE"', '"SWAS"').encode()
    app.submissions.submit(submission_from_json(lone))
    assert item(app, "SWAS").latest_batch.batch == "wrong"


def test_in_a_named_run_any_time_is_its_own(app):
    later = shifted(utc_now(), 86400.0 * 300)
    put(app, [result_row(app, later, run="plan")])
    assert item(app, run="plan").latest_batch.time == later.text


def test_while_live_is_empty_the_newest_run_is_the_one_to_look_at(app):
    assert app.runs.default() == "live"
    app.runs.watch("empty")
    put(app, [result_row(app, START, run="first")])
    put(app, [result_row(app, shifted(START, 1), run="second")])
    assert app.runs.default() == "second"
    put(app, [result_row(app, START)])
    assert app.runs.default() == "live"
