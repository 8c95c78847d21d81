"""A page of many spacecraft says the same as the overview of each."""

import numpy as np
import pytest

from service.times import parse_utc, shifted, utc_now
from tests.storage.bulk import put, result_row

pytestmark = pytest.mark.both_databases

START = parse_utc("1999-03-01T00:00:00Z")


def fleet(app, period="day", run="live"):
    return app.spacecraft.fleet(sorted(app.missions), run, period)


def row(shown, name="XTE"):
    return next(each for each in shown.rows if each.name == name)


def cells_of(shown, count, name="XTE"):
    return shown.cells.counts[count][[each.name for each in shown.rows].index(name)]


def test_the_last_hour_is_that_of_the_overview(app):
    rows = [result_row(app, shifted(START, 317.0 * k), ambiguous=k % 4) for k in range(400)]
    put(app, [*rows, result_row(app, shifted(START, 126_000), spacecraft="SWAS", unmatched=2)])
    for item in app.spacecraft.overview().items:
        found = row(fleet(app), item.name)
        assert found.last_hour == (
            item.last_hour if item.last_hour and item.last_hour.batches else None
        )
        assert found.latest_batch == item.latest_batch
        assert found.age_s == item.age_s
        assert found.state == item.state


@pytest.mark.parametrize(("period", "columns"), [("hour", 30), ("day", 48), ("week", 42)])
def test_cells_hold_every_batch_of_the_period(app, period, columns):
    put(app, [result_row(app, shifted(START, 300.0 * k), ambiguous=1) for k in range(2500)])
    shown = fleet(app, period)
    assert shown.cells.columns == columns
    end_s = shown.cells.start_s + columns * shown.cells.width_s
    batches = cells_of(shown, "batches")
    per_cell = shown.cells.width_s / 300
    assert set(batches[1:-1]) <= {np.floor(per_cell), np.ceil(per_cell)}
    assert end_s % shown.cells.width_s == 0
    assert (cells_of(shown, "ambiguous") == batches).all()
    assert not cells_of(shown, "batches", "SOHO").any()


def test_a_day_with_many_batches_is_shown_by_the_hour(app, monkeypatch):
    put(app, [result_row(app, shifted(START, 300.0 * k)) for k in range(400)])
    by_batch = cells_of(fleet(app), "batches")
    monkeypatch.setattr("service.storage.queries.fleet.MOST_SUMMED", 0)
    by_hour = fleet(app)
    assert by_hour.cells.columns == 24
    assert (
        cells_of(by_hour, "batches")[:-1].tolist()
        == by_batch.reshape(-1, 2).sum(axis=1)[:-1].tolist()
    )


def test_a_live_batch_dated_far_ahead_is_not_the_latest_unless_it_is_alone(app):
    ahead = shifted(utc_now(), 86400.0 * 300)
    put(app, [result_row(app, START), result_row(app, ahead)])
    put(app, [result_row(app, ahead, spacecraft="SWAS")])
    shown = fleet(app)
    assert shown.as_of == START
    assert row(shown).latest_batch.time == START.text
    assert row(shown, "SWAS").latest_batch.time == ahead.text


def test_the_last_attitude_and_the_trackers_are_those_of_the_answers(app, make):
    first = app.submissions.submit(make("b1"))
    app.submissions.submit(make("b2", kind="one_star", after_s=60))
    found = row(fleet(app))
    assert found.state == "no_attitude"
    assert not found.has_attitude
    assert found.last_attitude.id == first.id
    known = app.spacecraft.overview().items
    sigma_arcsec = next(each for each in known if each.name == "XTE").sigma_arcsec
    assert list(found.last_attitude.sigma_arcsec) == pytest.approx(sigma_arcsec)
    assert [(each.tracker, each.observed) for each in found.trackers] == [("STARTRACKER_1", 1)]


def test_without_a_batch_nothing_is_made_up(app):
    shown = fleet(app, run="nothing")
    assert shown.as_of is None
    assert shown.cells is None
    assert {each.state for each in shown.rows} == {"no_batches"}
