"""One compiled call from identified stars to the attitude gives what its steps give."""

import numpy as np
import pytest

from service.attitude.solution import AttitudeSolution, NoAttitude, solve_attitude
from service.identify.attitude_from_matches import attitude_of, matched_vectors
from service.vectors import matrix_from_quaternion, read_only
from tests.attitude.cases import ARCSEC, field_of_stars, random_attitude, seen

SUN_AU = 0.99
TRACKERS = ("STARTRACKER_1", "STARTRACKER_2")


def scene(rng, n, named):
    """Observed vectors and sigmas, rows of the catalog, and the catalog itself."""
    catalog = field_of_stars(rng, rng.normal(size=3), 6.0, 40)
    star = rng.choice(len(catalog), n, replace=False)
    sigma_arcsec = rng.uniform(2.0, 8.0, n)
    body = seen(rng, random_attitude(rng), catalog[star], sigma_arcsec)
    star[rng.permutation(n)[named:]] = -1
    return read_only(body), sigma_arcsec / ARCSEC, star, read_only(catalog)


@pytest.mark.parametrize("method", ["quest", "triad"])
@pytest.mark.parametrize("named", [2, 3, 7])
@pytest.mark.parametrize("trackers", [TRACKERS[:1], TRACKERS])
def test_the_one_call_is_its_steps(method, named, trackers):
    rng = np.random.default_rng([named, len(method), len(trackers)])
    body, sigma_rad, star, catalog = scene(rng, 7, named)
    velocity = rng.normal(size=3) * 3e-5
    tracker_of = np.arange(7) % 2 if len(trackers) == 2 else None
    found = attitude_of(
        body, sigma_rad, star, tracker_of, trackers, catalog, velocity, SUN_AU, method
    )
    observed, reference, sigma = matched_vectors(body, sigma_rad, star, catalog, velocity, SUN_AU)
    used = star >= 0
    part = np.zeros(named, np.int64) if tracker_of is None else tracker_of[used]
    steps = solve_attitude(observed, reference, sigma, part, trackers, method)
    assert isinstance(found, AttitudeSolution)
    assert found.quaternion.tolist() == steps.quaternion.tolist()
    assert found.matrix == pytest.approx(matrix_from_quaternion(found.quaternion), abs=1e-15)
    assert found.covariance_arcsec2.tolist() == steps.covariance_arcsec2.tolist()
    assert (found.taste, found.suspect) == (steps.taste, steps.suspect)
    assert found.trackers == steps.trackers
    assert len(found.trackers) == (0 if tracker_of is None else 2)
    assert found.residual_arcsec[used].tolist() == steps.residual_arcsec.tolist()
    assert np.isnan(found.residual_arcsec[~used]).all()


@pytest.mark.parametrize("named", [0, 1])
def test_fewer_than_two_identities_give_the_reason(named):
    body, sigma_rad, star, catalog = scene(np.random.default_rng(1), 5, named)
    found = attitude_of(
        body, sigma_rad, star, None, TRACKERS[:1], catalog, np.zeros(3), SUN_AU, "quest"
    )
    assert found is NoAttitude.FEWER_THAN_TWO_UNIQUE_STARS


def test_stars_in_one_direction_give_the_reason():
    body, sigma_rad, star, catalog = scene(np.random.default_rng(2), 5, 5)
    same = read_only(np.repeat(body[:1], 5, axis=0))
    found = attitude_of(
        same, sigma_rad, star, None, TRACKERS[:1], catalog, np.zeros(3), SUN_AU, "quest"
    )
    assert found is NoAttitude.DEGENERATE_GEOMETRY
