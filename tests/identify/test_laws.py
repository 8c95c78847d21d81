"""What an identification must not depend on: the axes it is written in, the order of the stars."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.vectors import from_ra_dec
from tests.reference.batches import quaternion_matrix, random_quaternion
from tests.reference.small_sky import band, cap, identify, named, run_catalog

seeds = st.integers(0, 2**32 - 1)


def scene(seed, kind):
    """A small random sky, five of its stars seen with noise, and where they are looked for."""
    rng = np.random.default_rng(seed)
    if kind == "cap":
        places = from_ra_dec(rng.uniform(-8, 8, 60), rng.uniform(-8, 8, 60))
        region = cap(radius_deg=9.0)
    else:
        places = from_ra_dec(rng.uniform(-15, 15, 60), rng.uniform(-5, 5, 60))
        region = band(half_width_deg=5.5)
    # No two magnitudes alike, so that the order of rows is the same in every frame.
    magnitudes = rng.permutation(60) * 0.05 + 3.0
    chosen = rng.choice(60, 5, replace=False)
    observed = places[chosen] + rng.normal(size=(5, 3)) * 1e-5
    observed /= np.linalg.norm(observed, axis=1, keepdims=True)
    seen = magnitudes[chosen] + rng.normal(size=5) * 0.1
    return rng, places, magnitudes, observed, seen, region


@pytest.mark.parametrize("kind", ["cap", "band"])
@settings(max_examples=60)
@given(seed=seeds)
def test_turning_the_sky_and_all_that_is_seen_of_it_changes_nothing(kind, seed):
    rng, places, magnitudes, observed, seen, region = scene(seed, kind)
    turn = quaternion_matrix(random_quaternion(rng))
    still = run_catalog(places, magnitudes)
    turned = run_catalog(places @ turn.T, magnitudes)
    aim_turned = type(region)(region.kind, turn @ region.axis, region.least_deg, region.most_deg)
    before = named(identify(still, observed, seen, region), still)
    after = named(identify(turned, observed @ turn.T, seen, aim_turned), turned)
    assert before == after


@pytest.mark.parametrize("kind", ["cap", "band"])
@settings(max_examples=60)
@given(seed=seeds)
def test_seeing_the_stars_in_another_order_reorders_the_outcome_and_nothing_else(kind, seed):
    rng, places, magnitudes, observed, seen, region = scene(seed, kind)
    catalog = run_catalog(places, magnitudes)
    order = rng.permutation(5)
    straight = named(identify(catalog, observed, seen, region), catalog)
    shuffled = named(identify(catalog, observed[order], seen[order], region), catalog)
    assert shuffled == [straight[k] for k in order]


@pytest.mark.parametrize("kind", ["cap", "band"])
@settings(max_examples=40)
@given(seed=seeds, factor=st.floats(1.0, 50.0))
def test_a_wider_separation_tolerance_never_takes_a_vote_away(kind, seed, factor):
    _, places, magnitudes, observed, seen, region = scene(seed, kind)
    catalog = run_catalog(places, magnitudes)
    narrow = identify(catalog, observed, seen, region)
    wide = identify(catalog, observed, seen, region, separation_deg=0.0066 * factor)
    assert (wide.votes >= narrow.votes).all()


@settings(max_examples=40)
@given(seed=seeds)
def test_the_tallies_say_what_the_outcome_is(seed):
    _, places, magnitudes, observed, seen, region = scene(seed, "cap")
    catalog = run_catalog(places, magnitudes)
    for outcome, star, votes, runner_up in named(
        identify(catalog, observed, seen, region, separation_deg=0.3), catalog
    ):
        assert votes >= runner_up >= 0
        if outcome == "unique":
            assert votes > runner_up
            assert isinstance(star, str)
        elif outcome == "ambiguous":
            assert votes == runner_up > 0
            assert len(star) >= 2
        else:
            assert votes == 0
            assert star is None
