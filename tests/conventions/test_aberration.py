"""Aberration against formulas written out here, and what it does to an attitude."""

import json
import math

import erfa
import numpy as np
import pytest

from service.acquire import acquire
from service.observations.schema import submission_from_json
from service.sky.ephemeris import apparent, observer_velocity
from service.times import parse_utc
from service.vectors import ARCSEC_PER_RADIAN, angle_between_deg, matrix_from_quaternion
from tests.reference.batches import matrix_quaternion, quaternion_matrix, random_quaternion

EPOCH = parse_utc("1996-01-10T12:00:00Z")
LIGHT_KM_PER_S = 299792.458


def classical(star, velocity_c):
    """The direction of star plus velocity: first order in v/c."""
    return (star + velocity_c) / np.linalg.norm(star + velocity_c)


def relativistic(star, velocity_c):
    """Lorentz-transformed direction (Explanatory Supplement 1992, eq. 3.252-3)."""
    inverse_gamma = math.sqrt(1.0 - velocity_c @ velocity_c)
    along = star @ velocity_c
    seen = (inverse_gamma * star + velocity_c + along * velocity_c / (1 + inverse_gamma)) / (
        1 + along
    )
    return seen / np.linalg.norm(seen)


def velocity_written_out(velocity_km_per_s):
    """Earth's barycentric velocity with the spacecraft's own added, in units of c."""
    tt = erfa.taitt(*erfa.utctai(*erfa.dtf2d("UTC", 1996, 1, 10, 12, 0, 0.0)))
    earth_km_per_s = erfa.epv00(*tt)[1]["v"] * 149597870.7 / 86400.0
    return (earth_km_per_s + np.array(velocity_km_per_s)) / LIGHT_KM_PER_S


def arcsec(a, b):
    return float(angle_between_deg(a, b)) * 3600.0


def across(v):
    v = np.cross(v, [0.3, -0.2, 0.9])
    return v / np.linalg.norm(v)


def test_a_star_across_earth_s_way_is_shifted_by_twenty_and_a_half_arcseconds():
    velocity = observer_velocity(EPOCH, None)
    star = across(velocity)
    # Kappa, 20.4955 arcsec at mean speed; Earth is near perihelion in January.
    assert arcsec(apparent(star, velocity, EPOCH), star) == pytest.approx(20.8, abs=0.1)
    # From month to month it swings by the eccentricity either way.
    year = [
        np.linalg.norm(observer_velocity(parse_utc(f"1996-{m:02d}-01T00:00:00Z"), None))
        for m in range(1, 13)
    ]
    assert np.mean(year) * ARCSEC_PER_RADIAN == pytest.approx(20.4955, abs=0.02)


def test_stars_crowd_towards_the_apex():
    velocity = observer_velocity(EPOCH, None)
    apex = velocity / np.linalg.norm(velocity)
    star = across(velocity) + 0.5 * apex
    star /= np.linalg.norm(star)
    assert arcsec(apparent(star, velocity, EPOCH), apex) < arcsec(star, apex)
    for pole in (apex, -apex):
        assert arcsec(apparent(pole, velocity, EPOCH), pole) < 1e-6


@pytest.mark.parametrize("velocity_km_per_s", [None, (0.0, 7.5, 0.0), (-3.0, 1.0, 6.5)])
def test_the_first_order_and_the_relativistic_formula_agree_with_what_is_used(
    velocity_km_per_s, rng
):
    velocity = observer_velocity(EPOCH, velocity_km_per_s)
    for star in rng.normal(size=(50, 3)):
        star /= np.linalg.norm(star)
        seen = apparent(star, velocity, EPOCH)
        # Second order is v^2/c^2 = 1e-8, 2 mas; the Sun's own bending in the formula is far less.
        assert arcsec(seen, classical(star, velocity)) < 3e-3
        assert arcsec(seen, relativistic(star, velocity)) < 5e-4


def test_a_low_orbit_adds_five_arcseconds():
    earth = observer_velocity(EPOCH, None)
    star = across(earth)
    orbit = 7.5 * star  # towards the star: no shift of its own; across it: 5.2 arcsec
    sideways = 7.5 * np.cross(star, earth) / np.linalg.norm(earth)
    along = apparent(star, observer_velocity(EPOCH, orbit), EPOCH)
    aside = apparent(star, observer_velocity(EPOCH, sideways), EPOCH)
    only_earth = apparent(star, earth, EPOCH)
    assert arcsec(along, only_earth) < 0.01
    assert arcsec(aside, only_earth) == pytest.approx(
        7.5 / LIGHT_KM_PER_S * ARCSEC_PER_RADIAN, abs=0.01
    )


@pytest.fixture
def seen_from_orbit(rng, sky, missions):
    """An XTE batch of exact apparent directions, its true attitude, and the velocity."""
    catalog = sky.run_catalog(missions["XTE"], EPOCH)
    velocity_km_per_s = [3.0, -6.0, 3.5]
    velocity = velocity_written_out(velocity_km_per_s)
    while True:
        truth = quaternion_matrix(random_quaternion(rng))
        rows = np.flatnonzero(catalog.direction @ truth[0] > math.cos(math.radians(3.9)))[:6]
        speed_across = np.linalg.norm(np.cross(truth[0], velocity)) / np.linalg.norm(velocity)
        if len(rows) == 6 and speed_across > 0.9:
            break
    of_day = catalog.direction_at(EPOCH)
    seen = np.array([relativistic(of_day[row], velocity) for row in rows])
    body = seen @ truth.T

    def attitude(aberration, vectors=body, velocity_km_per_s=velocity_km_per_s):
        batch = {
            "spacecraft": "XTE",
            "batch": "1",
            "time": EPOCH.text,
            "a_priori": {"quaternion": matrix_quaternion(truth).tolist()},
            "aberration": aberration,
            "velocity_km_per_s": velocity_km_per_s,
            "options": {"identifier": "starid"},
            "observations": [
                {
                    "tracker": "STARTRACKER_1",
                    "stars": [
                        {"vector": v[[1, 2, 0]].tolist(), "magnitude": float(m)}
                        for v, m in zip(vectors, catalog.magnitude_mag[rows], strict=True)
                    ],
                }
            ],
        }
        found = acquire(submission_from_json(json.dumps(batch)).batch, missions["XTE"], sky)
        assert found.counts["unique"] == 6
        return found

    return truth, velocity, of_day[rows], attitude


def off_arcsec(found, truth):
    a = matrix_from_quaternion(found.solution.quaternion)
    return 2.0 * math.asin(np.linalg.norm(a - truth) / 8**0.5) * ARCSEC_PER_RADIAN


def test_corrected_here_or_upstream_the_attitude_is_right(seen_from_orbit):
    truth, _, directions, attitude = seen_from_orbit
    assert off_arcsec(attitude("to_correct"), truth) < 0.01
    geometric = directions @ truth.T
    assert off_arcsec(attitude("applied_upstream", geometric), truth) < 0.01


def test_ignored_the_attitude_is_off_by_the_shift_itself(seen_from_orbit):
    truth, velocity, _, attitude = seen_from_orbit
    shift = np.linalg.norm(np.cross(truth[0], velocity)) * ARCSEC_PER_RADIAN
    assert 15.0 < shift < 27.0
    found = attitude("ignore")
    # The common shift of the field, and a little of the difference across it.
    assert off_arcsec(found, truth) == pytest.approx(shift, rel=0.1)


def test_applied_twice_the_attitude_is_off_the_other_way(seen_from_orbit):
    truth, velocity, directions, attitude = seen_from_orbit
    shift = np.linalg.norm(np.cross(truth[0], velocity)) * ARCSEC_PER_RADIAN
    geometric = directions @ truth.T
    assert off_arcsec(attitude("to_correct", geometric), truth) == pytest.approx(shift, rel=0.1)


def test_without_a_velocity_earth_s_alone_is_taken_and_said(seen_from_orbit):
    truth, _, _, attitude = seen_from_orbit
    found = attitude("to_correct", velocity_km_per_s=None)
    assert any("velocity" in warning for warning in found.warnings)
    assert 0.5 < off_arcsec(found, truth) < 5.6
    assert not any("velocity" in warning for warning in attitude("to_correct").warnings)


def test_votes_and_observed_vectors_are_the_same_whatever_is_done_about_aberration(seen_from_orbit):
    _, _, _, attitude = seen_from_orbit
    found = [attitude(kind).trackers[0] for kind in ("to_correct", "applied_upstream", "ignore")]
    for each in found[1:]:
        assert (each.identification.votes == found[0].identification.votes).all()
        assert (each.corrected.direction_body == found[0].corrected.direction_body).all()
