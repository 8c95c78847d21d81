"""Causes of ambiguous and unmatched stars, told from a day and the day before."""

import json
import re

import numpy as np
import pytest
from scipy.stats import hypergeom

from service.features.advice.causes import LEAST_BATCHES, is_over
from service.features.advice.part import AdviceService
from service.observations.schema import submission_from_json
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.times import DAY_S, parse_utc, shifted

BATCHES = 24
ZONE_DEG = 10.66
BEGIN = "1999-03-02T00:00:00.000Z"


def only_bright(body):
    """A batch of a tracker that reports its brightest two stars."""
    for each in body["observations"]:
        each["stars"] = sorted(each["stars"], key=lambda star: star["magnitude"])[:2]


def fainter(body):
    """A batch whose magnitudes are half a magnitude too faint."""
    for each in body["observations"]:
        for star in each["stars"]:
            star["magnitude"] += 0.5


def fly(app, mission, start, seed, change=None, identifier="verified", **wanted):
    asked = Pass(BATCHES, seed, start=start, cadence_s=600.0, troubles=NO_TROUBLES, **wanted)
    bodies = [each.batch for each in draw_pass(mission, app.sky, asked)]
    for body in bodies:
        body |= {"batch": body["time"], "options": {"identifier": identifier}}
        if change is not None:
            change(body)
    answers = app.submissions.submit_many([submission_from_json(json.dumps(b)) for b in bodies])
    assert all(not isinstance(each, Exception) for each in answers)


@pytest.fixture
def compare(app, missions, seed):
    """Fly a good day and the next one as asked; the ambiguity of the second."""
    begin = parse_utc(BEGIN)

    def compared(**changed):
        fly(app, missions["XTE"], shifted(begin, -DAY_S).text, seed)
        fly(app, missions["XTE"], BEGIN, seed + 1, **changed)
        return app.part(AdviceService).ambiguity("XTE", "live", begin, shifted(begin, DAY_S))

    return compared


@pytest.mark.parametrize(
    ("changed", "cause"),
    [
        ({"noise_arcsec": 60.0}, "STARTRACKER_1 is noisy."),
        (
            {"a_priori_error_deg": 9.0, "identifier": "starid"},
            "The a priori attitude is worse than before.",
        ),
        ({"false_stars": 2}, "STARTRACKER_1 reports points that are no stars of the catalog."),
        (
            {"change": only_bright, "noise_arcsec": 30.0, "identifier": "starid"},
            "STARTRACKER_1 has lost sensitivity: it reports fewer stars.",
        ),
        (
            {"change": fainter, "identifier": "starid"},
            "The magnitudes of STARTRACKER_1 have shifted.",
        ),
    ],
)
def test_the_cause_of_a_bad_day_is_named_with_what_it_explains(compare, changed, cause):
    found = compare(**changed)
    assert found.batches == found.total == BATCHES
    assert found.counts_before is not None
    told = {each.text: each for each in found.causes}
    assert cause in told
    assert 0 < told[cause].batches <= BATCHES
    assert told[cause].remedy
    assert re.fullmatch(r"\d+ of \d+ ambiguous or unmatched stars\.", told[cause].effect)
    explained = [each.batches for each in found.causes]
    assert explained == sorted(explained, reverse=True)


def test_angles_of_wrong_identifications_blame_neither_zone_nor_a_priori_attitude(app, compare):
    def loose(body):
        body["options"]["tolerances"] = {"separation_deg": 0.05}

    found = compare(change=loose, identifier="starid", stars=3)
    page = app.results.page(spacecraft="XTE", start=parse_utc(BEGIN), limit=BATCHES)
    wrong = [each for each in page.items if (each.measures["a_priori_angle_deg"] or 0) > ZONE_DEG]
    assert len(wrong) >= LEAST_BATCHES
    assert {each.status for each in wrong} == {"suspect"}
    assert found.causes
    assert not [each for each in found.causes if "a priori" in each.text]


def test_a_day_like_the_one_before_has_no_cause_and_no_certain_change(compare):
    found = compare()
    assert found.causes == []
    assert not any(each.is_certain for each in found.parts)
    assert found.parts[0].before is not None


def test_without_an_earlier_day_nothing_is_compared(app, missions, seed):
    fly(app, missions["XTE"], BEGIN, seed, false_stars=2)
    begin = parse_utc(BEGIN)
    found = app.part(AdviceService).ambiguity("XTE", "live", begin, shifted(begin, DAY_S))
    assert found.counts_before is None
    assert all(each.before is None for each in found.parts)
    assert ["no stars of the catalog" in each.text for each in found.causes] == [True]


def test_a_cause_that_ended_says_since_when(app, missions, seed):
    begin = parse_utc(BEGIN)
    fly(app, missions["XTE"], BEGIN, seed, false_stars=2)
    fly(app, missions["XTE"], shifted(begin, BATCHES * 600.0).text, seed)
    found = app.part(AdviceService).ambiguity("XTE", "live", begin, shifted(begin, DAY_S))
    (cause,) = found.causes
    assert cause.over_since is not None
    last = shifted(begin, BATCHES * 600.0).text
    assert BEGIN < cause.over_since < last


@pytest.mark.parametrize("share", [0.1, 0.3, 0.9, 1.0])
def test_a_cause_is_over_beyond_one_chance_in_a_thousand(share):
    """The chance is scipy's, of none among the last batches in a random order."""
    count = 100
    for quiet in range(1, 90):
        explained = np.diff(np.floor(share * np.arange(count + 1))) > 0
        explained = np.append(explained, np.zeros(quiet, bool))
        last = np.flatnonzero(explained)[-1]
        after = len(explained) - 1 - last
        chance = hypergeom.pmf(0, len(explained), explained.sum(), after)
        assert is_over(explained, np.arange(len(explained))) == (chance < 0.001), quiet


def test_a_cause_that_lasts_is_hardly_ever_called_over(rng):
    """Also where it comes and goes: no longer than it was away before is it away now."""
    masks = rng.random((5000, 72)) < rng.uniform(0.1, 0.9, (5000, 1))
    found = [is_over(each, np.arange(72)) for each in masks if each.sum() >= LEAST_BATCHES]
    assert np.mean(found) < 0.002
    comes_and_goes = np.tile(np.repeat([True, False], 12), 3)
    assert not is_over(comes_and_goes, np.arange(72))


def test_a_period_without_batches_has_no_parts(app):
    begin = parse_utc(BEGIN)
    found = app.part(AdviceService).ambiguity("XTE", "live", begin, shifted(begin, DAY_S))
    assert (found.parts, found.causes, found.batches) == ([], [], 0)
