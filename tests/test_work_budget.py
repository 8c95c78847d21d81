"""The work for one batch ends at a bound that is counted, and the answer says so."""

import json

import numpy as np
import pytest

from service.acquire import acquire
from service.acquire.result import WORK_BOUND_HIT
from service.identify.budget import MAX_WORK, WorkBudget
from service.identify.identification import Outcome
from service.identify.sighting import Sighting
from service.identify.voting.starid import identify_by_votes
from service.missions.identifiers import IDENTIFIERS
from service.observations.schema import submission_from_json
from tests.reference.sightings import identified
from tests.reference.two_group_views import MOMENT, Views


@pytest.fixture
def views(sky, missions, seed):
    return lambda mission: Views(missions[mission], sky, np.random.default_rng(seed))


def batch_of(views, group, sigma_arcsec=None, **options):
    """A batch of points as a client sends it, about an a priori attitude."""
    stars = [
        {"vector": vector, "magnitude": magnitude}
        | ({} if sigma_arcsec is None else {"sigma_arcsec": sigma_arcsec})
        for vector, magnitude in zip(
            group.direction.tolist(), group.magnitude_mag.tolist(), strict=True
        )
    ]
    body = {
        "spacecraft": views.mission.name,
        "batch": "costly",
        "time": MOMENT.text,
        "a_priori": {"quaternion": views.prior(group.attitude).quaternion.tolist()},
        "body_rates_deg_per_s": [0.0, 0.0, 0.0],
        "aberration": "ignore",
        "options": options,
        "observations": [{"tracker": views.mission.trackers[0].name, "stars": stars}],
    }
    return submission_from_json(json.dumps(body)).batch


@pytest.fixture
def spent(monkeypatch):
    """The units that every batch spends, in order."""
    budgets = []

    class Counted(WorkBudget):
        def __init__(self, *given):
            super().__init__(*given)
            self.spent = 0
            budgets.append(self)

        def spend(self, units):
            self.spent += units
            super().spend(units)

    monkeypatch.setattr("service.acquire.pipeline.WorkBudget", Counted)
    return lambda: [budget.spent for budget in budgets]


@pytest.mark.parametrize("mission", ["XTE", pytest.param("SOHO", marks=pytest.mark.slow)])
@pytest.mark.slow("XTE")
def test_a_costly_batch_ends_at_the_bound_and_says_so(views, mission, spent):
    drawn = views(mission)
    batch = batch_of(drawn, drawn.random_points(250), 600.0)
    once, again = (acquire(batch, drawn.mission, drawn.sky) for _ in range(2))
    assert any(each.startswith(WORK_BOUND_HIT) for each in once.warnings)
    assert once.counts["unique"] == 0
    assert once.warnings == again.warnings
    assert [each.identification.outcome.tolist() for each in once.trackers] == [
        each.identification.outcome.tolist() for each in again.trackers
    ]
    # A search sees that it is at its bound after the hypothesis in hand.
    assert spent()[0] == spent()[1] < 1.1 * MAX_WORK


@pytest.mark.parametrize("mission", ["XTE", "SWAS", "SOHO"])
def test_a_batch_of_stars_spends_a_hundredth_of_the_bound_at_most(views, mission, spent):
    drawn = views(mission)
    for stars in (3, 5, 5, 5):
        batch = batch_of(drawn, drawn.field(stars))
        found = acquire(batch, drawn.mission, drawn.sky)
        assert not any(each.startswith(WORK_BOUND_HIT) for each in found.warnings)
    assert 0 < max(spent()) < MAX_WORK / 100


def by_votes(sighting):
    return identified(identify_by_votes, sighting, weighs=False)


@pytest.mark.parametrize("match_groups", [False, True])
def test_votes_that_cannot_all_be_cast_are_not_counted(views, match_groups, monkeypatch):
    caught: list[Sighting] = []
    entry = IDENTIFIERS["starid"]
    monkeypatch.setitem(
        IDENTIFIERS,
        "starid",
        type(entry)("starid", lambda each: caught.append(each) or by_votes(each), "caught"),
    )
    drawn = views("XTE")
    tests = {"match_groups": match_groups}
    batch = batch_of(drawn, drawn.field(5), identifier="starid", tests=tests)
    found = acquire(batch, drawn.mission, drawn.sky)
    assert found.counts["unique"] == 5
    (sighting,) = caught
    sighting.budget.left = 0
    cut = by_votes(sighting)
    assert cut.bounded
    assert cut.votes.tolist() == [0] * 5
    assert (cut.outcome == int(Outcome.UNMATCHED)).all()


def test_a_share_is_spent_of_the_whole():
    whole = WorkBudget(100)
    share = whole.share(3, 4)
    assert share.left == 75
    share.spend(10)
    assert (share.left, whole.left, whole.was_hit) == (65, 90, False)
    share.spend(100)
    assert (share.left, whole.left, whole.was_hit) == (0, 0, True)
