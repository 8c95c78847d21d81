"""Velocities add up, apparent directions stay unit vectors, the Sun is seen from where one is."""

import erfa
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.sky.ephemeris import apparent, ecliptic_north, observer_velocity, sun_direction
from service.times import parse_utc, utc_of_unix
from service.vectors import angle_between_deg, from_ra_dec

EPOCH = parse_utc("1996-01-10T12:00:00Z")
LIGHT_KM_PER_S = 299792.458

places = st.tuples(st.floats(0, 360), st.floats(-90, 90)).map(lambda p: from_ra_dec(*p))


def test_earth_s_own_velocity_is_thirty_kilometres_a_second():
    speed = np.linalg.norm(observer_velocity(EPOCH, None)) * LIGHT_KM_PER_S
    assert 29.2 < speed < 30.4


def test_the_spacecraft_s_velocity_is_added_in_kilometres_a_second():
    earth = observer_velocity(EPOCH, None)
    moving = observer_velocity(EPOCH, [1.0, -7.5, 0.25])
    assert (moving - earth) * LIGHT_KM_PER_S == pytest.approx([1.0, -7.5, 0.25], abs=1e-10)


def test_earth_s_velocity_is_the_change_of_its_place():
    """A day apart either way, from erfa's own positions about the barycentre."""
    tt1, tt2 = EPOCH.tt
    before, after = (erfa.epv00(tt1, tt2 + step)[1]["p"] for step in (-0.5, 0.5))
    au_per_day = LIGHT_KM_PER_S * 86400.0 / 149597870.7
    expected = (after - before) / au_per_day
    assert observer_velocity(EPOCH, None) == pytest.approx(expected, rel=1e-4, abs=1e-9)


@given(places)
def test_apparent_directions_are_unit_vectors_shifted_towards_the_apex(star):
    velocity = observer_velocity(EPOCH, [0.0, 7.5, 0.0])
    seen = apparent(star, velocity, EPOCH)
    assert np.linalg.norm(seen) == pytest.approx(1.0, abs=1e-14)
    assert seen @ velocity >= star @ velocity - 1e-15
    # In the plane of star and velocity.
    assert abs(np.cross(star, velocity) @ seen) < 1e-15


def test_many_directions_are_shifted_as_each_alone():
    many = from_ra_dec(np.arange(0, 360, 30), np.linspace(-80, 80, 12))
    velocity = observer_velocity(EPOCH, None)
    alone = [apparent(v, velocity, EPOCH) for v in many]
    assert apparent(many, velocity, EPOCH) == pytest.approx(np.array(alone), abs=0)


def test_from_a_halo_orbit_the_sun_is_elsewhere_than_from_earth():
    """650,000 km across the line to the Sun, from 148 million: a quarter of a degree."""
    from_earth = sun_direction(EPOCH, None)
    across = np.cross(from_earth, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    position_km = 1.5e6 * from_earth + 6.5e5 * across
    off = float(angle_between_deg(sun_direction(EPOCH, position_km), from_earth))
    assert off == pytest.approx(0.256, abs=0.004)
    # One looks back across the line: the Sun moves to the other side.
    assert sun_direction(EPOCH, position_km) @ across < 0


def test_ecliptic_north_is_perpendicular_to_the_sun_all_year():
    for month in range(1, 13):
        time = parse_utc(f"1996-{month:02d}-10T12:00:00Z")
        sun, north = sun_direction(time, None), ecliptic_north(time)
        assert abs(90.0 - float(angle_between_deg(sun, north))) < 0.001
        assert np.linalg.norm(north) == pytest.approx(1.0)


def test_ecliptic_north_of_j2000_lies_at_eighteen_hours():
    north = ecliptic_north(parse_utc("2000-01-01T12:00:00Z"))
    assert float(angle_between_deg(north, from_ra_dec(270.0, 90.0 - 23.4392911))) < 1e-4


@given(st.floats(63_072_000, 4_102_358_400))
def test_between_steps_earth_is_where_erfa_has_it(unix_s):
    """Within half a metre, and within a micrometre a second, from 1972 to 2099."""
    moment = utc_of_unix(unix_s)
    heliocentric, barycentric = erfa.epv00(*moment.tt)
    metres_per_au = 149_597_870_700.0
    off = sun_direction(moment, None) + heliocentric["p"] / np.linalg.norm(heliocentric["p"])
    assert np.abs(off).max() * metres_per_au < 0.5
    velocity = observer_velocity(moment, None) * LIGHT_KM_PER_S * 1e3
    expected = barycentric["v"] * metres_per_au / 86400.0
    assert velocity == pytest.approx(expected, abs=1e-6)
