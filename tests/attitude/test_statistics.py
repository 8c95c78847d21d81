"""Covariance, residuals and TASTE are what the noise that was put in makes them."""

import numpy as np
import pytest
from scipy.stats import chi2

from service.attitude.solution import METHODS, taste_bound
from service.vectors import attitude_error_arcsec, matrix_from_quaternion
from tests.attitude.cases import field_of_stars, random_attitude, seen, solved
from tests.chance import assert_chi_square, at_least, at_most
from tests.reference.batches import rotation
from tests.scale import draws

DRAWS = draws(1000, 3000)
MANY = draws(4000, 20_000)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("stars", "radius_deg"), [(2, 4.0), (5, 4.0), (5, 60.0)])
def test_errors_and_taste_are_distributed_as_they_are_predicted(stars, radius_deg, method, rng):
    """The sums of e^T P^-1 e and of TASTE are chi-square with 3 and 2N - 3 degrees of freedom.

    So are their tails.
    """
    squares, tastes = np.empty(DRAWS), np.empty(DRAWS)
    freedom = 2 * stars - 3
    for k in range(DRAWS):
        truth = random_attitude(rng)
        inertial = field_of_stars(rng, rng.normal(size=3), radius_deg, stars)
        # Stars close together give no attitude at all: not what is asked about here.
        while np.min(np.linalg.norm(inertial - inertial[0], axis=1)[1:]) < 0.005:
            inertial = field_of_stars(rng, rng.normal(size=3), radius_deg, stars)
        sigma = rng.uniform(1.0, 6.0, size=stars)
        solution = solved(seen(rng, truth, inertial, sigma), inertial, sigma, method=method)
        error = attitude_error_arcsec(matrix_from_quaternion(solution.quaternion), truth)
        squares[k] = error @ np.linalg.solve(solution.covariance_arcsec2, error)
        tastes[k] = solution.taste
        assert solution.degrees_of_freedom == freedom
        assert solution.suspect == (solution.taste > taste_bound(freedom))
    assert_chi_square(squares, 3)
    assert_chi_square(tastes, freedom)
    # 14.16 is the 99.73 % point for three degrees of freedom.
    for beyond, expected in ((squares > 14.16, 0.0027), (tastes > taste_bound(freedom), 0.001)):
        assert at_least(DRAWS, expected) <= beyond.sum() <= at_most(DRAWS, expected)


SCENES = {
    "coarse and fine star": ([(0.0, 0.0), (5.0, 0.0)], [9.0, 2.0]),
    "star a right angle away": ([(0.0, 0.0), (90.0, 0.0)], [2.0, 5.0]),
    "star beyond a right angle": ([(0.0, 0.0), (130.0, 0.0)], [4.0, 3.0]),
    "narrow field": ([(0.0, 0.0), (0.05, 0.01), (0.02, 0.05)], [2.0, 3.0, 1.0]),
    "two widest pairs alike": ([(0.0, 0.0), (2.0, 0.0), (0.0, 2.0), (2.0, 2.0)], [3.0] * 4),
    "coarse stars apart": ([(-3.0, 0.0), (3.0, 0.0), (0.0, 2.0), (1.0, -2.0)], [8.0, 12.0, 2, 1]),
}
"""Places in degrees of longitude and latitude, and sigmas in arcsec."""


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", SCENES)
def test_of_given_stars_the_errors_scatter_as_the_covariance_of_the_method_says(name, method, rng):
    places, sigma = SCENES[name]
    longitude, latitude = np.radians(np.array(places)).T
    inertial = np.column_stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ]
    )
    truth = random_attitude(rng)
    squares, residuals = np.empty(MANY), np.empty(MANY)
    errors = np.empty((MANY, 3))
    for k in range(MANY):
        solution = solved(seen(rng, truth, inertial, sigma), inertial, sigma, method=method)
        errors[k] = attitude_error_arcsec(matrix_from_quaternion(solution.quaternion), truth)
        squares[k] = errors[k] @ np.linalg.solve(solution.covariance_arcsec2, errors[k])
        residuals[k] = (solution.residual_rms_arcsec / solution.predicted_rms_arcsec) ** 2
    assert_chi_square(squares, 3)
    assert (squares > 14.16).sum() <= at_most(MANY, 0.0027)
    # No axis is biased: the mean error is zero within its own noise.
    mean = errors.mean(axis=0)
    assert MANY * mean @ np.linalg.solve(np.cov(errors.T), mean) < chi2.isf(1e-5, 3)
    # The square of the rms is chi-square with at least one degree of freedom over its mean.
    assert residuals.mean() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / MANY))


def test_the_covariance_is_the_inverse_of_the_information_in_body_axes(rng):
    truth = random_attitude(rng)
    inertial = field_of_stars(rng, rng.normal(size=3), 4.0, 5)
    sigma = rng.uniform(1.0, 9.0, size=5)
    body = seen(rng, truth, inertial, sigma)
    matrix = sum((np.eye(3) - np.outer(b, b)) / s**2 for b, s in zip(body, sigma, strict=True))
    found = solved(body, inertial, sigma).covariance_arcsec2
    assert found == pytest.approx(np.linalg.inv(matrix), rel=1e-7)
    assert found == pytest.approx(found.T, abs=0)


@pytest.mark.parametrize(
    ("freedom", "bound"), [(1, 10.828), (3, 16.266), (5, 20.515), (7, 24.322), (17, 40.790)]
)
def test_the_bound_of_suspicion_is_the_table_s_99_9_percent_point(freedom, bound):
    assert taste_bound(freedom) == pytest.approx(bound, abs=5e-4)


def test_a_star_under_a_wrong_name_makes_the_solution_suspect(rng):
    truth = random_attitude(rng)
    inertial = field_of_stars(rng, rng.normal(size=3), 4.0, 5)
    # Half of the noise that is allowed for: one sound solution in a thousand is suspect, too.
    body = seen(rng, truth, inertial, 1.0)
    assert not solved(body, inertial, 2.0).suspect
    across = np.cross(inertial[2], rng.normal(size=3))
    inertial[2] = rotation(across, 0.01) @ inertial[2]
    assert solved(body, inertial, 2.0).suspect


class TestOutlier:
    """Three trackers look three ways; one of them is misaligned."""

    BORESIGHTS = ((1.0, 0.0, 0.0), (-0.3, 0.9, 0.2), (0.0, -0.2, 1.0))

    def solution(self, rng, counts, misaligned, arcsec, method="quest"):
        truth = random_attitude(rng)
        body, inertial, trackers = [], [], []
        for k, count in enumerate(counts):
            stars = field_of_stars(rng, truth.T @ np.array(self.BORESIGHTS[k]), 3.0, count)
            turn = np.eye(3)
            if k == misaligned:
                # Across its boresight, where a narrow field is sure of what it sees.
                aside = np.cross(self.BORESIGHTS[k], rng.normal(size=3))
                turn = rotation(aside, arcsec / 3600.0)
            body.append(seen(rng, truth, stars, 2.0) @ turn.T)
            inertial.append(stars)
            trackers += [k] * count
        return solved(np.vstack(body), np.vstack(inertial), 2.0, trackers, method)

    @pytest.mark.parametrize("counts", [(5, 5, 5), (8, 3, 3), (3, 3, 8), (2, 12, 2)])
    @pytest.mark.parametrize("misaligned", [0, 1, 2])
    def test_the_misaligned_tracker_is_named_however_many_stars_it_has(
        self, counts, misaligned, rng
    ):
        named = 0
        for _ in range(60):
            solution = self.solution(rng, counts, misaligned, 120.0)
            named += [fit.outlier for fit in solution.trackers] == [
                k == misaligned for k in range(3)
            ]
        # Of thousands, at most sixteen in a thousand were not.
        assert named >= at_least(60, 0.98)

    @pytest.mark.parametrize("method", METHODS)
    def test_trackers_that_agree_have_no_outlier_and_share_the_taste(self, method, rng):
        solution = self.solution(rng, (4, 5, 6), None, 0.0, method)
        if not solution.suspect:
            assert not any(fit.outlier for fit in solution.trackers)
        assert [fit.stars for fit in solution.trackers] == [4, 5, 6]
        assert sum(fit.taste for fit in solution.trackers) == pytest.approx(solution.taste)

    def test_of_two_sound_trackers_that_disagree_neither_is_named(self, rng):
        named = sum(
            any(fit.outlier for fit in self.solution(rng, (6, 6), 1, 120.0).trackers)
            for _ in range(40)
        )
        # Of thousands one in a hundred was.
        assert named <= at_most(40, 0.015)

    def test_of_two_trackers_the_one_that_disagrees_with_itself_is_named(self, rng):
        truth = random_attitude(rng)
        stars = [field_of_stars(rng, truth.T @ np.array(b), 3.0, 6) for b in self.BORESIGHTS[:2]]
        body = np.vstack([seen(rng, truth, stars[0], 2.0), seen(rng, truth, stars[1], 60.0)])
        solution = solved(body, np.vstack(stars), 2.0, [0] * 6 + [1] * 6)
        assert [fit.outlier for fit in solution.trackers] == [False, True]

    def test_one_tracker_is_compared_with_nothing(self, rng):
        inertial = field_of_stars(rng, rng.normal(size=3), 4.0, 5)
        assert solved(inertial, inertial, 2.0).trackers == ()


def test_the_bounds_are_scipy_s_up_to_the_most_stars_that_a_batch_may_have():
    freedoms = [*range(1, 400, 2), 2 * 250 - 3, 2 * 16 * 250 - 3]
    bounds = [taste_bound(freedom) for freedom in freedoms]
    assert bounds == pytest.approx(chi2.isf(0.001, freedoms), rel=1e-10)
