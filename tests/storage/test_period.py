"""The stars and attitudes of a period: as recorded, with true sigmas, of a bounded fair sample."""

import json

import numpy as np
import pytest
from scipy import stats

from service.observations.schema import submission_from_json
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.storage.queries.period import period_stars, sample_period
from service.storage.queries.time_buckets import BucketFilter
from service.times import parse_utc, shifted
from service.vectors import angle_between_deg, from_ra_dec
from tests.storage.bulk import put, result_row

pytestmark = pytest.mark.both_databases

BATCHES = 60
WHOLE = {"start": parse_utc("1990-01-01T00:00:00Z"), "end": parse_utc("2010-01-01T00:00:00Z")}


def record(app, missions, sky, spacecraft, seed, batches=BATCHES):
    """A pass with the noise that the mission expects; the answers in order of time."""
    drawn = draw_pass(missions[spacecraft], sky, Pass(batches, seed))
    bodies = [each.batch for each in drawn]
    answers = app.submissions.submit_many([submission_from_json(json.dumps(b)) for b in bodies])
    assert all(not isinstance(each, Exception) for each in answers)
    page = app.results.page(spacecraft=spacecraft, limit=batches)
    return [app.results.get(each.id).answer for each in reversed(page.items)]


@pytest.mark.parametrize("spacecraft", ["XTE", "SOHO"])
def test_residuals_are_those_of_the_answers(app, missions, sky, seed, spacecraft):
    """In the order of the stars, each as long as the answer says."""
    answers = record(app, missions, sky, spacecraft, seed)
    found = app.results.period(spacecraft, **WHOLE)
    assert (found.total, found.read, found.other_catalog) == (BATCHES, BATCHES, 0)
    assert list(found.attitudes.time) == [answer.time for answer in answers]
    (tracker,) = found.trackers
    recorded = [
        np.nan if star.residual_arcsec is None else star.residual_arcsec
        for answer in answers
        for each in answer.observations
        for star in each.stars
        if star.star is not None
    ]
    assert np.hypot(*tracker.residual_arcsec.T) == pytest.approx(recorded, abs=1e-3, nan_ok=True)


@pytest.mark.parametrize("spacecraft", ["XTE", "SOHO"])
@pytest.mark.slow("postgresql")
def test_residuals_over_the_expected_are_unit_normal(app, missions, sky, seed, spacecraft, figures):
    record(app, missions, sky, spacecraft, seed, batches=200)
    (tracker,) = app.results.period(spacecraft, **WHOLE).trackers
    values = (tracker.residual_arcsec / tracker.expected_arcsec).ravel()
    values = values[np.isfinite(values)]
    figures(values=len(values), spread=round(float(values.std()), 3))
    assert len(values) > 1000
    # Of an attitude of few stars the residuals of one batch depend on each other.
    assert values.std() == pytest.approx(1.0, abs=0.06)
    assert stats.kstest(values, "norm").pvalue > 1e-3
    # Without what the attitude takes up they would be far too narrow.
    plain = (tracker.residual_arcsec / tracker.sigma_arcsec).ravel()
    assert np.nanstd(plain) < 0.9


def test_boresights_are_where_the_answers_attitudes_look(app, missions, sky, seed):
    answers = record(app, missions, sky, "XTE", seed)
    (tracker,) = app.results.period("XTE", **WHOLE).trackers
    for answer, boresight in zip(answers, tracker.boresight, strict=True):
        place = app.results.star_field(answer.id).trackers[0].boresight
        drawn = from_ra_dec(place.ra_deg, place.dec_deg)
        if answer.attitude is not None:
            assert angle_between_deg(boresight, drawn) < 1e-9
    assert tracker.region.most_deg == missions["XTE"].zone.radius_deg


def numbered(app, count):
    """So many batches a minute apart, without stars."""
    start = parse_utc("1999-03-01T00:00:00Z")
    put(app, [result_row(app, shifted(start, 60.0 * k), name=f"{k:05d}") for k in range(count)])


def sampled(app, **wanted):
    with app.store.reading() as connection:
        return sample_period(connection, BucketFilter("XTE", "live", **WHOLE), **wanted)


def minutes_of(found):
    """The minutes of the batches since the first of all, each the number of its batch."""
    first = parse_utc("1999-03-01T00:00:00Z").tai_ns
    return np.array([(row["time_ns"] - first) // 60_000_000_000 for row in found.rows])


def test_a_long_period_is_read_as_pairs_of_neighbours_spread_evenly(app):
    numbered(app, 3000)
    found = sampled(app, most=60)
    assert found.total == 3000
    number = minutes_of(found)
    assert 50 < len(number) <= 60
    # What is said to follow does, and every pair is one.
    assert (np.diff(number) == 1).tolist() == found.follows[1:].tolist()
    assert found.follows.sum() >= 28
    # A pair of each thirtieth of the period.
    assert np.diff(number).max() <= 200
    assert number[0] <= 100
    assert number[-1] >= 2900


def test_a_sample_follows_the_batches_not_the_clock(app):
    """Two dense hours, with a quiet month between them."""
    start = parse_utc("1999-03-01T00:00:00Z")
    times = [*np.arange(0, 3600, 4.0), *(30 * 86400.0 + np.arange(0, 3600, 4.0))]
    put(app, [result_row(app, shifted(start, each), name="b") for each in times])
    found = sampled(app, most=100)
    late = sum(row["time_ns"] > start.tai_ns + 86400 * 10**9 for row in found.rows)
    assert found.total == 1800
    assert len(found.rows) > 80
    assert 0.4 < late / len(found.rows) < 0.6


def test_a_short_period_is_read_whole_and_an_empty_one_is_empty(app, sky):
    assert period_stars(sampled(app), sky).read == 0
    numbered(app, 30)
    found = sampled(app, most=30)
    assert minutes_of(found).tolist() == list(range(30))
    assert found.follows.tolist() == [False, *[True] * 29]
    assert len(sampled(app, most=600).rows) == 30
