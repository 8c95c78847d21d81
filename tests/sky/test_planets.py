"""Planets against JPL's DE421, evaluated with Skyfield: astrometric places seen from Earth."""

import numpy as np
import pytest

from service.sky.ephemeris import PLANETS, planet_place
from service.times import parse_utc
from service.vectors import ARCSEC_PER_RADIAN

DE421 = [
    ("1975-04-07T06:00:00Z", "Mercury", (0.99503769, 0.09938119, 0.00483366)),
    ("1975-04-07T06:00:00Z", "Venus", (0.60987461, 0.72028777, 0.33051247)),
    ("1975-04-07T06:00:00Z", "Mars", (0.83729374, -0.49225087, -0.23796696)),
    ("1975-04-07T06:00:00Z", "Jupiter", (0.99591589, 0.08850869, 0.01782543)),
    ("1975-04-07T06:00:00Z", "Saturn", (-0.22173454, 0.89601770, 0.38468959)),
    ("1975-04-07T06:00:00Z", "Uranus", (-0.85377206, -0.48149479, -0.19808088)),
    ("1975-04-07T06:00:00Z", "Neptune", (-0.30920785, -0.88314802, -0.35276065)),
    ("1996-01-10T06:00:00Z", "Mercury", (0.57662818, -0.75476064, -0.31278797)),
    ("1996-01-10T06:00:00Z", "Venus", (0.80894285, -0.52677021, -0.26100693)),
    ("1996-01-10T06:00:00Z", "Mars", (0.52184489, -0.77491053, -0.35663928)),
    ("1996-01-10T06:00:00Z", "Jupiter", (0.02824421, -0.91872329, -0.39389056)),
    ("1996-01-10T06:00:00Z", "Saturn", (0.98455735, -0.14257418, -0.10158460)),
    ("1996-01-10T06:00:00Z", "Uranus", (0.49906633, -0.79130518, -0.35322644)),
    ("1996-01-10T06:00:00Z", "Neptune", (0.42393140, -0.83430379, -0.35244766)),
    ("2008-11-30T06:00:00Z", "Mercury", (-0.32845510, -0.85907122, -0.39257342)),
    ("2008-11-30T06:00:00Z", "Venus", (0.35497664, -0.84030850, -0.40972333)),
    ("2008-11-30T06:00:00Z", "Mars", (-0.34369353, -0.85873883, -0.38005575)),
    ("2008-11-30T06:00:00Z", "Jupiter", (0.37296153, -0.84865321, -0.37508323)),
    ("2008-11-30T06:00:00Z", "Saturn", (-0.98642977, 0.13428118, 0.09447150)),
    ("2008-11-30T06:00:00Z", "Uranus", (0.98022579, -0.17576267, -0.09091140)),
    ("2008-11-30T06:00:00Z", "Neptune", (0.78328085, -0.56789496, -0.25291585)),
    ("2026-11-24T06:00:00Z", "Mercury", (-0.73686320, -0.63449571, -0.23334055)),
    ("2026-11-24T06:00:00Z", "Venus", (-0.91020872, -0.38283691, -0.15797465)),
    ("2026-11-24T06:00:00Z", "Mars", (-0.85586637, 0.45847042, 0.23936921)),
    ("2026-11-24T06:00:00Z", "Jupiter", (-0.82971802, 0.50659887, 0.23436209)),
    ("2026-11-24T06:00:00Z", "Saturn", (0.98971360, 0.14254961, 0.01210759)),
    ("2026-11-24T06:00:00Z", "Uranus", (0.44833820, 0.82115306, 0.35312960)),
    ("2026-11-24T06:00:00Z", "Neptune", (0.99943045, 0.03104508, -0.01322762)),
    ("2045-07-01T06:00:00Z", "Mercury", (-0.56869189, 0.75564934, 0.32493630)),
    ("2045-07-01T06:00:00Z", "Venus", (-0.59039023, 0.72842923, 0.34760644)),
    ("2045-07-01T06:00:00Z", "Mars", (0.10039071, 0.90950864, 0.40338040)),
    ("2045-07-01T06:00:00Z", "Jupiter", (0.94904407, -0.28068834, -0.14328088)),
    ("2045-07-01T06:00:00Z", "Saturn", (-0.41243606, -0.84853341, -0.33149291)),
    ("2045-07-01T06:00:00Z", "Uranus", (-0.80633590, 0.53763142, 0.24652562)),
    ("2045-07-01T06:00:00Z", "Neptune", (0.69654152, 0.66976068, 0.25739181)),
]
EARTH_RADIUS_KM = np.array([6378.0, 0.0, 0.0])


@pytest.mark.parametrize(("time", "name", "place"), DE421)
def test_a_planet_is_within_its_stated_error_of_de421(time, name, place):
    planet = next(each for each in PLANETS if each.name == name)
    found = planet_place(planet, parse_utc(time), np.zeros(3))
    off_arcsec = np.linalg.norm(found.direction - np.array(place)) * ARCSEC_PER_RADIAN
    assert off_arcsec < found.error_arcsec
    # Half a minute of arc is said of all of them.
    assert off_arcsec < 60.0


def test_the_parallax_of_a_position_is_within_the_error_without_one():
    venus, moment = PLANETS[1], parse_utc("2022-01-09T00:00:00Z")
    centre = planet_place(venus, moment, np.zeros(3))
    aside = planet_place(venus, moment, EARTH_RADIUS_KM)
    shift = np.linalg.norm(aside.direction - centre.direction) * ARCSEC_PER_RADIAN
    # At inferior conjunction Venus is 0.27 au away.
    assert 10.0 < shift < 33.0
    assert planet_place(venus, moment, None).error_arcsec > centre.error_arcsec + shift
