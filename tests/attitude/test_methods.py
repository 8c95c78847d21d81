"""QUEST solves Wahba's problem at every angle, and TRIAD is the textbook's."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from service.vectors import matrix_from_quaternion
from tests.attitude.cases import ARCSEC, field_of_stars, random_attitude, seen, solved
from tests.reference.attitude_by_svd import agreement, random_cases

axes = (
    st.tuples(*[st.floats(-1, 1, allow_subnormal=False)] * 3)
    .filter(lambda v: np.hypot(*v[:2]) + abs(v[2]) > 1e-2)
    .map(lambda v: np.array(v) / np.linalg.norm(v))
)


def apart_arcsec(a, b):
    return 2.0 * np.arcsin(min(1.0, np.linalg.norm(a - b) / np.sqrt(8.0))) * ARCSEC


@pytest.mark.parametrize("stars", [2, 3, 5, 12])
@pytest.mark.parametrize("kind", ["half_turn", "narrow", "unequal", "wide"])
def test_quest_is_the_singular_value_decomposition_s_attitude(kind, stars, rng):
    """Within thirty roundings times the condition: what the decomposition itself can hold."""
    found = agreement(random_cases(rng, 100, stars, kind))
    assert found.refused < found.cases
    assert found.wrongly_refused == 0
    assert (found.apart_rad <= found.bound_rad).all()
    assert (found.apart_rad <= 0.01 * found.sigma_rad).all()
    assert np.median(found.apart_rad) * ARCSEC <= 1e-6


@given(axes)
@example(np.array([1.0, 0.0, 0.0]))
@example(np.array([0.0, 1.0, 0.0]))
@example(np.array([0.0, 0.0, 1.0]))
@pytest.mark.parametrize("stars", [2, 5])
def test_an_exact_half_turn_about_any_axis_is_found(stars, axis):
    rng = np.random.default_rng(stars)
    truth = 2.0 * np.outer(axis, axis) - np.eye(3)
    inertial = field_of_stars(rng, [0.3, -0.2, 0.9], 4.0, stars)
    solution = solved(inertial @ truth.T, inertial, 2.0)
    assert apart_arcsec(matrix_from_quaternion(solution.quest), truth) < 1e-5
    assert apart_arcsec(matrix_from_quaternion(solution.triad), truth) < 1e-5
    assert solution.quaternion[3] >= 0.0


def test_without_a_turn_the_quaternion_is_the_identity():
    inertial = np.eye(3)
    solution = solved(inertial, inertial, 1.0)
    assert solution.quaternion == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=1e-16)


@pytest.mark.parametrize("stars", [2, 3, 8])
def test_two_stars_and_more_give_the_least_loss_there_is(stars, rng):
    """No small turn away from the solution has a smaller weighted sum of squares."""
    truth = random_attitude(rng)
    inertial = field_of_stars(rng, rng.normal(size=3), 4.0, stars)
    sigma = rng.uniform(1.0, 20.0, size=stars)
    body = seen(rng, truth, inertial, sigma)
    attitude = matrix_from_quaternion(solved(body, inertial, sigma).quest)

    def loss(a):
        return float(np.sum(((body - inertial @ a.T) / (sigma[:, None] / ARCSEC)) ** 2))

    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        x, y, z = axis * 3.0 / ARCSEC
        turn = np.eye(3) - np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        assert loss(turn @ attitude) >= loss(attitude) * (1 - 1e-9)


def test_triad_takes_the_widest_pair_and_holds_the_finer_star_exactly(rng):
    truth = random_attitude(rng)
    inertial = field_of_stars(rng, [1.0, 2.0, -0.5], 4.0, 6)
    sigma = np.array([3.0, 1.0, 2.0, 5.0, 4.0, 6.0])
    body = seen(rng, truth, inertial, 200.0)
    cosines = inertial @ inertial.T
    i, j = np.unravel_index(np.argmin(cosines), cosines.shape)
    anchor, other = (i, j) if sigma[i] < sigma[j] else (j, i)

    def frame(v, w):
        second = np.cross(v, w) / np.linalg.norm(np.cross(v, w))
        return np.column_stack([v, second, np.cross(v, second)])

    textbook = frame(body[anchor], body[other]) @ frame(inertial[anchor], inertial[other]).T
    solution = solved(body, inertial, sigma, method="triad")
    assert solution.method == "triad"
    assert solution.quaternion == pytest.approx(solution.triad, abs=0)
    assert matrix_from_quaternion(solution.triad) == pytest.approx(textbook, abs=1e-12)
    assert solution.residual_arcsec[anchor] < 1e-6 < solution.residual_arcsec[other]


@pytest.mark.parametrize("method", ["quest", "triad"])
def test_the_chosen_method_s_quaternion_and_residuals_are_the_solution_s(method, rng):
    truth = random_attitude(rng)
    inertial = field_of_stars(rng, rng.normal(size=3), 4.0, 5)
    body = seen(rng, truth, inertial, 3.0)
    solution = solved(body, inertial, 3.0, method=method)
    attitude = matrix_from_quaternion(solution.quaternion)
    expected = np.linalg.norm(body - inertial @ attitude.T, axis=1) * ARCSEC
    assert solution.residual_arcsec == pytest.approx(expected, abs=1e-6)
    assert solution.residual_rms_arcsec == pytest.approx(np.sqrt(np.mean(expected**2)))


@pytest.mark.parametrize("method", ["quest", "triad"])
def test_taste_is_that_of_the_optimal_attitude_whichever_is_chosen(method, rng):
    inertial = field_of_stars(rng, rng.normal(size=3), 4.0, 5)
    body = seen(rng, random_attitude(rng), inertial, 3.0)
    solution = solved(body, inertial, 3.0, method=method)
    apart = body - inertial @ matrix_from_quaternion(solution.quest).T
    assert solution.taste == pytest.approx(np.sum((apart * ARCSEC / 3.0) ** 2))
    assert solution.degrees_of_freedom == 7


def test_the_angle_between_triad_and_quest_is_that_of_the_turn_between_them(rng):
    inertial = field_of_stars(rng, rng.normal(size=3), 4.0, 5)
    solution = solved(seen(rng, random_attitude(rng), inertial, 5.0), inertial, 5.0)
    a, b = matrix_from_quaternion(solution.triad), matrix_from_quaternion(solution.quest)
    assert solution.triad_quest_angle_arcsec == pytest.approx(apart_arcsec(a, b), rel=1e-6)


def test_quest_weighs_the_stars_by_their_sigma(rng):
    """A star ten thousand times worse than the others moves nothing."""
    truth = random_attitude(rng)
    inertial = field_of_stars(rng, rng.normal(size=3), 4.0, 4)
    body = inertial @ truth.T
    body[3] = seen(rng, truth, inertial[3:], 3000.0)[0]
    solution = solved(body, inertial, np.array([0.1, 0.1, 0.1, 3000.0]))
    assert apart_arcsec(matrix_from_quaternion(solution.quest), truth) < 0.1
