"""The Sun where the almanac has it, seen from where the spacecraft is."""

import numpy as np
import pytest

from service.sky.ephemeris import sun_direction
from service.times import parse_utc
from service.vectors import angle_between_deg, from_ra_dec, to_ra_dec

# Right ascension and declination of the Sun in degrees: the almanac's solstices and equinoxes
# (of date, turned to J2000 by general precession), and noon of 2000 January 1.
ALMANAC = [
    ("2000-01-01T11:58:55.816Z", 281.29, -23.03),
    ("2000-03-20T07:35:00Z", 0.0, 0.0),
    ("2000-06-21T01:48:00Z", 90.0, 23.44),
    ("2000-09-22T17:28:00Z", 180.0, 0.0),
    ("2000-12-21T13:37:00Z", 270.0, -23.44),
    ("1996-06-21T02:24:00Z", 90.05, 23.44),
]


@pytest.mark.parametrize(("text", "ra_deg", "dec_deg"), ALMANAC)
def test_the_sun_is_where_the_almanac_has_it(text, ra_deg, dec_deg):
    off = angle_between_deg(sun_direction(parse_utc(text), None), from_ra_dec(ra_deg, dec_deg))
    assert float(off) < 0.03


def test_the_sun_moves_eastward_by_about_a_degree_a_day():
    ra = [
        float(to_ra_dec(sun_direction(parse_utc(f"1996-01-{d:02d}T00:00:00Z"), None))[0])
        for d in (10, 11)
    ]
    assert 0.9 < ra[1] - ra[0] < 1.2


def test_the_direction_points_from_the_spacecraft_to_the_sun():
    time = parse_utc("1996-01-10T12:00:00Z")
    from_earth = sun_direction(time, None)
    assert sun_direction(time, [0.0, 0.0, 0.0]) == pytest.approx(from_earth, abs=1e-15)
    # Almost at the Sun, and beyond it: it lies ahead, then behind.
    assert sun_direction(time, 1.4e8 * from_earth) @ from_earth == pytest.approx(1.0)
    assert sun_direction(time, 1.6e8 * from_earth) @ from_earth == pytest.approx(-1.0)
    # A step to one side moves the Sun to the other.
    side = np.cross(from_earth, [0.0, 0.0, 1.0])
    assert sun_direction(time, 1e6 * side) @ side < 0
