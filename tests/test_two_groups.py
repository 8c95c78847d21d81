"""Views with two groups of stars, or none, give no wrong attitude that is called good."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.acquire import acquire
from service.observations.schema import submission_from_json
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.vectors import rotate_about
from tests.chance import at_least, at_most
from tests.features.advice.passes import mission_like
from tests.reference.two_group_views import GHOST_SHIFT_DEG, Views
from tests.reference.two_groups import acquired, is_at, is_good, simple, two_groups
from tests.scale import draws

BATCHES = draws(12, 25)


@pytest.fixture
def views(sky, missions, seed):
    return lambda mission, *place: Views(
        missions[mission], sky, np.random.default_rng([seed, *place])
    )


@pytest.mark.parametrize("with_prior", [True, False])
@pytest.mark.parametrize("stars", [6, 10])
@pytest.mark.parametrize("kind", ["ghosts", "slews"])
@pytest.mark.parametrize("mission", ["XTE", "SOHO"])
def test_of_two_groups_neither_is_passed_over(views, mission, kind, stars, with_prior):
    """The answer is no good one that is wrong, and where both groups are sound it names both."""
    counted = two_groups(views(mission, stars), kind, stars, with_prior, BATCHES)
    assert counted.batches == BATCHES
    assert counted.good_and_wrong == 0
    assert counted.of_these_with_rival == counted.smaller_good_alone
    assert counted.named_wrong <= at_most(counted.named, 0.02)


def test_the_rival_is_the_attitude_of_the_other_group(views):
    """Halves of ten stars before and after a slew: one is the answer, the other one its rival."""
    drawn = views("XTE")
    for _ in range(BATCHES):
        before, after = drawn.slew(10)
        batch, order = drawn.batch(before, after, prior=drawn.prior(before.attitude))
        found = acquired(drawn, batch)
        assert found.solution is not None
        assert found.solution.suspect
        assert found.rival is not None
        attitudes = found.solution, found.rival.solution
        assert any(is_at(attitudes[0], group.attitude) for group in (before, after))
        assert any(is_at(attitudes[1], group.attitude) for group in (before, after))
        assert 0.0 < found.rival.probability <= 0.5
        (named,) = found.rival.star
        truth = np.concatenate([before.star, after.star])[order]
        assert (named[named >= 0] == truth[named >= 0]).all()
        assert (named >= 0).sum() >= 3
        assert any(text.startswith("rival_attitude: ") for text in found.warnings)


def test_single_groups_have_no_rival(views):
    """Real stars alone, with or without a point that is none, are answered as before."""
    drawn = views("XTE")
    counted = simple(drawn, (drawn.field(6) for _ in range(10 * BATCHES)), True)
    assert counted.right >= at_least(counted.batches, 0.98)
    assert counted.wrong == counted.doubted == 0
    good = 0
    for _ in range(BATCHES):
        group = drawn.field(5)
        both = drawn.batch(group, drawn.random_points(3), prior=drawn.prior(group.attitude))[0]
        found = acquired(drawn, both)
        assert found.rival is None
        good += is_good(found)
    assert good >= at_least(BATCHES, 0.95)


def test_stars_that_are_sent_twice_are_no_second_group(views):
    drawn = views("XTE")
    for _ in range(BATCHES):
        group = drawn.field(5)
        again = drawn.group(group.attitude, group.star)
        found = acquired(drawn, drawn.batch(group, again, prior=drawn.prior(group.attitude))[0])
        assert found.rival is None


@pytest.mark.parametrize("with_prior", [True, False])
def test_reflections_in_one_of_two_trackers_are_named(sky, seed, with_prior):
    """The other tracker tells which group is real, and the reflections are named all the same."""
    mission = mission_like("XTE", second_tracker={})
    turn = np.radians([0.3, 0.0, 0.0])
    tried = named = 0
    for drawn in draw_pass(mission, sky, Pass(200, seed, stars=6, angles_share=0.0)):
        body = drawn.batch
        first, second = (each["stars"] for each in body["observations"])
        if min(len(first), len(second)) < 5:
            continue
        if named and tried >= BATCHES:
            break
        tried += 1
        ghosts = [s | {"vector": rotate_about(turn, np.array(s["vector"])).tolist()} for s in first]
        body["observations"][0]["stars"] = first + ghosts
        if not with_prior:
            body["a_priori"] = None
        found = acquire(submission_from_json(json.dumps(body)).batch, mission, sky)
        if found.solution is not None and not found.solution.suspect:
            # The first tracker's stars lay beyond the zone: the attitude is the other tracker's.
            assert found.solution.trackers[0].stars == 0
            truth = Rotation.from_quat(drawn.truth["quaternion"]).inv().as_matrix()
            assert is_at(found.solution, truth)
        named += found.rival is not None
    assert named >= 1


@pytest.mark.parametrize("stars", [5, 10])
def test_a_mirrored_field_is_not_called_good_and_the_answer_names_the_mirror(views, stars):
    """Of mirrored fields, 1 to 2.5 % have three stars that fit somewhere by themselves."""
    drawn = views("XTE", stars)
    told = False
    # Of 100 fields at least one, so that 2,000 without any are no chance.
    for number in range(2000):
        group = drawn.mirrored(stars)
        found = acquired(drawn, drawn.batch(group, prior=drawn.prior(group.attitude))[0])
        assert not is_good(found)
        told |= any(text.startswith("mirrored_field: ") for text in found.warnings)
        if told and number >= 8 * BATCHES:
            break
    assert told


def test_three_stars_that_fit_better_in_a_mirror_suggest_no_mirrored_sensor(views):
    """Three stars fit a mirror by chance at times; a mirrored sensor shows in larger fields."""
    drawn = views("SOHO", 3)
    fitted = 0
    for _ in range(8 * BATCHES):
        group = drawn.mirrored(3)
        found = acquired(drawn, drawn.batch(group, prior=drawn.prior(group.attitude))[0])
        assert not any(text.startswith("mirrored_field: ") for text in found.warnings)
        fitted += found.trackers[0].identification.mirrored
    assert fitted


@pytest.mark.parametrize("points", [2, 3, 5, 8])
def test_points_that_are_no_stars_give_no_good_attitude(views, points):
    drawn = views("XTE", points)
    group = (drawn.random_points(points) for _ in range(16 * BATCHES))
    assert simple(drawn, group, False).wrong <= 1


def test_equal_reflections_are_weighed_with_all_their_stars(views):
    """Among both groups the whole sky names some stars of one; that is no reason for the other."""
    drawn = views("SOHO", 10)
    for _ in range(12 * BATCHES):
        real = drawn.field(10)
        ghost = drawn.group(drawn.shifted(real.attitude, *GHOST_SHIFT_DEG), real.star)
        batch, order = drawn.batch(real, ghost, prior=drawn.prior(real.attitude))
        identification = acquired(drawn, batch).trackers[0].identification
        is_ghost = np.repeat([False, True], 10)[order]
        assert not (identification.unique & is_ghost).any()
