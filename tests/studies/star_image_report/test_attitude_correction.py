"""IM-9: pitch, yaw and roll of a pattern of stars."""

import math

import numpy as np
import pytest

from service.errors import BadInput
from studies.star_image_report.scanning import by_positions, by_two_scans, sigmas


def turned(points, roll, du, dv):
    c, s = math.cos(roll), math.sin(roll)
    return points @ np.array([[c, -s], [s, c]]).T + (du, dv)


PAIR = np.array([[-0.05, 0.0], [0.05, 0.0]])


@pytest.mark.parametrize("roll", [0.01, 0.2, -0.7, math.pi / 2, -math.pi / 2])
def test_two_stars_tell_a_roll_and_a_move_exactly(roll):
    seen = turned(PAIR, roll, 0.003, -0.002)
    (a1, b1), (a2, b2) = seen - PAIR
    found = by_two_scans(a1, b1, a2, b2, 0.05)
    assert (found.du, found.dv, found.roll_rad) == pytest.approx((0.003, -0.002, roll), abs=1e-14)


def test_errors_are_as_predicted(rng):
    sigma, u0, trials = 1e-4, 0.05, 4000
    noise = rng.normal(0, sigma, (trials, 4))
    found = [by_two_scans(*each, u0) for each in noise]
    spread = np.std([(f.du, f.dv, f.roll_rad) for f in found], axis=0)
    of_move, of_roll = sigmas(sigma, u0)
    assert of_move == pytest.approx(7.07e-5, rel=1e-3)
    assert of_roll == pytest.approx(1.414e-3, rel=1e-3)
    assert spread == pytest.approx([of_move, of_move, of_roll], rel=5 / math.sqrt(2 * trials))


def test_half_a_turn_looks_like_none_to_two_scans_of_equal_stars():
    """The report says so; told apart, the stars give it away."""
    seen = turned(PAIR, math.pi - 0.01, 0.0, 0.0)[::-1]
    (a1, b1), (a2, b2) = seen - PAIR
    assert by_two_scans(a1, b1, a2, b2, 0.05).roll_rad == pytest.approx(-0.01)
    assert by_positions(PAIR, seen[::-1]).roll_rad == pytest.approx(math.pi - 0.01)


def test_any_pattern_off_the_boresight_needs_its_roll_first(rng):
    """7.23 and 7.24 hold for a pair about the boresight only."""
    nominal = np.array([0.3, 0.1]) + rng.uniform(-0.1, 0.1, (5, 2))
    for roll in (0.01, -2.5):
        seen = turned(nominal, roll, 0.01, -0.02)
        found = by_positions(nominal, seen)
        assert (found.du, found.dv) == pytest.approx((0.01, -0.02), abs=1e-12)
        assert found.roll_rad == pytest.approx(roll)
        naive = (seen - nominal).mean(axis=0)
        assert np.abs(naive - (0.01, -0.02)).max() > 1e-4


def test_patterns_without_a_direction_are_refused():
    with pytest.raises(BadInput, match="two stars"):
        by_positions([[0.0, 0.0]], [[0.0, 0.0]])
    with pytest.raises(BadInput, match="one place"):
        by_positions([[1.0, 0.0]] * 2, [[0.0, 0.0]] * 2)
    with pytest.raises(BadInput, match="half_distance"):
        by_two_scans(0, 0, 0, 0, 0.0)
