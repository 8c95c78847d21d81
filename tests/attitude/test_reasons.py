"""Where no attitude can be had the reason is given, and never an exception."""

import math

import numpy as np
import pytest

from service.attitude.solution import AttitudeSolution, NoAttitude
from tests.attitude.cases import field_of_stars, random_attitude, seen, solved
from tests.reference.batches import rotation

STAR = np.array([[0.6, 0.0, 0.8]])


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_stars_give_no_attitude(count):
    assert solved(STAR[:count], STAR[:count], 2.0) is NoAttitude.FEWER_THAN_TWO_UNIQUE_STARS


@pytest.mark.parametrize(("share", "answered"), [(0.98, True), (1.02, False)])
@pytest.mark.parametrize("sigma_arcsec", [0.01, 2.0, 300.0])
def test_an_axis_worse_than_a_degree_is_no_attitude(share, answered, sigma_arcsec):
    """Two stars apart by s: the worst axis, between them, has sigma times the root of 2 over s."""
    worst_deg = share
    apart = math.sqrt(2.0) * sigma_arcsec / 3600.0 / worst_deg
    pair = np.vstack([STAR, (rotation([0.0, 1.0, 0.0], math.degrees(apart)) @ STAR.T).T])
    solution = solved(pair, pair, sigma_arcsec)
    assert isinstance(solution, AttitudeSolution) == answered
    if not answered:
        assert solution is NoAttitude.DEGENERATE_GEOMETRY


def test_the_covariance_that_is_told_decides_whether_an_axis_is_too_poor():
    """The widest pair has a star of 400 arcsec, which TRIAD rests upon and QUEST does not."""
    stars = np.vstack([rotation([0.0, 1.0, 0.0], deg) @ STAR[0] for deg in (0.0, 1.0, 4.0)])
    sigma = np.array([2.0, 2.0, 400.0])
    assert isinstance(solved(stars, stars, sigma), AttitudeSolution)
    assert solved(stars, stars, sigma, method="triad") is NoAttitude.DEGENERATE_GEOMETRY


def test_stars_in_one_place_are_degenerate():
    many = np.repeat(STAR, 5, axis=0)
    assert solved(many, many, 2.0) is NoAttitude.DEGENERATE_GEOMETRY


def test_opposite_stars_are_degenerate():
    pair = np.vstack([STAR, -STAR])
    assert solved(pair, pair, 2.0) is NoAttitude.DEGENERATE_GEOMETRY


def test_stars_that_share_one_identity_are_degenerate_and_no_error(rng):
    apart = field_of_stars(rng, STAR[0], 4.0, 4)
    assert solved(apart, np.repeat(STAR, 4, axis=0), 2.0) is NoAttitude.DEGENERATE_GEOMETRY


def test_two_of_several_stars_may_share_an_identity(rng):
    """The widest pair among them spans no plane in the catalog: another anchors TRIAD."""
    truth = random_attitude(rng)
    inertial = field_of_stars(rng, rng.normal(size=3), 1.0, 4)
    body = seen(rng, truth, inertial, 2.0)
    body = np.vstack([body, rotation(np.cross(body[0], body[1]), 6.0) @ body[0]])
    solution = solved(body, np.vstack([inertial, inertial[0]]), 2.0)
    assert isinstance(solution, AttitudeSolution)
    assert np.isfinite(solution.quest).all()
    assert np.isfinite(solution.triad).all()
    assert solution.suspect


@pytest.mark.parametrize("stars", [2, 3, 7])
def test_vectors_that_have_nothing_to_do_with_each_other_never_raise(stars, rng):
    for _ in range(300):
        body, inertial = (
            v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, stars, 3))
        )
        solution = solved(body, inertial, rng.uniform(0.1, 3000.0, size=stars))
        if isinstance(solution, AttitudeSolution):
            assert np.isfinite(solution.quaternion).all()
            assert np.linalg.norm(solution.quaternion) == pytest.approx(1.0)


def test_one_very_fine_star_beside_a_coarse_one_is_no_degenerate_geometry():
    """Weights that differ by ten decades lose no digit that the verdict needs."""
    pair = np.vstack([STAR, (rotation([0.0, 1.0, 0.0], 8.0) @ STAR.T).T])
    assert isinstance(solved(pair, pair, np.array([0.001, 100.0])), AttitudeSolution)
