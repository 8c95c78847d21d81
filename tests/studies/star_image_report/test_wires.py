"""IM-4: the cross of a wire mesh, as the laboratory of the report saw it."""

import numpy as np
import pytest

from studies.star_image_report.wires import (
    INCH_M,
    Mesh,
    along_p,
    filtered,
    first_tail_null_rad,
    mesh_intensity,
    order_angle_rad,
    shares_of_light,
    tail,
)
from tests.features.pictures.optics import DIAMETER_M, LASER_M, MESH

THIN_M, THICK_M = 0.00443 * INCH_M, 0.00663 * INCH_M


def orders(numbers):
    return np.array([order_angle_rad(m, LASER_M, MESH) for m in numbers])


@pytest.fixture(scope="module")
def screen():
    across = MESH.across(DIAMETER_M)
    return filtered(DIAMETER_M, across, across)


def test_orders_5_10_and_15_vanish_and_four_are_left_in_a_dash(screen):
    """The 4th, 8th and 12th null of the opening: 4/5 of the pitch is open."""
    light = along_p(screen, LASER_M, orders(range(1, 17)))
    assert light[[4, 9, 14]] == pytest.approx(0.0, abs=2e-5)
    assert light[:4] == pytest.approx([0.0495, 0.0380, 0.0167, 0.0036], rel=0.02)
    assert light[[3, 5]] == pytest.approx([3.6e-3, 1.4e-3], rel=0.03)


def test_equation_4_1_gives_the_orders_to_the_roundness_of_the_aperture(screen):
    at = orders(range(5))
    formula = mesh_intensity(at, 0.0, LASER_M, MESH, openings=9)
    assert formula / formula[0] == pytest.approx([1.0, 0.0535, 0.0353, 0.0160, 0.0036], rel=0.02)
    light = along_p(screen, LASER_M, at[1:])
    assert light == pytest.approx(formula[1:] / formula[0], rel=0.09)


def test_the_constant_of_4_1_makes_it_the_light_of_a_square_of_openings():
    """s^4 / lambda² and N^4: by the transform of 5 x 5 openings, in all directions."""
    from service.features.pictures.centroids.optics import Pupil, centres, image_at
    from studies.star_image_report.transfer import between_wires

    cell = MESH.pitch_m / 100
    place = centres(500, cell)
    grating = between_wires(place, cell, MESH.wires(6))
    square = Pupil(grating[:, None] * grating[None, :], cell)
    p = np.linspace(0, 2.3, 12) * LASER_M / MESH.pitch_m
    direct = image_at(square, LASER_M, p, 0.3 * p)
    formula = mesh_intensity(p[None, :], 0.3 * p[:, None], LASER_M, MESH, 5)
    assert direct == pytest.approx(formula, rel=2e-3, abs=1e-4 * formula.max())


@pytest.mark.parametrize("inches", [0.00443, 0.00663, 0.007, 0.011])
def test_the_first_null_of_a_tail_is_at_lambda_over_the_wire(inches):
    wire = inches * INCH_M
    one = filtered(DIAMETER_M, [(0.0, wire)], [])
    expected = LASER_M / wire
    found = first_tail_null_rad(one, LASER_M, DIAMETER_M, 0.7 * expected, 1.3 * expected)
    assert found == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(
    ("wires", "shares"),
    [
        (0, (0.964, 0.022, 0.015)),
        (1, (0.922, 0.061, 0.017)),
        (2, (0.879, 0.102, 0.019)),
        (4, (0.791, 0.182, 0.027)),
        (8, (0.647, 0.302, 0.051)),
    ],
)
def test_more_wires_put_more_light_into_tails_and_beside_them(wires, shares):
    pupil = filtered(DIAMETER_M, MESH.wires(wires), MESH.wires(wires), cells=600, width=2.0)
    found = shares_of_light(pupil, LASER_M, 0.5 * LASER_M / MESH.pitch_m)
    assert found == pytest.approx(shares, abs=0.003)


def test_the_light_of_a_full_mesh_goes_by_the_product_of_the_axes():
    """(1 - e)², 2 e (1 - e), e², the rest being the skirt of the Airy disc."""
    across = MESH.across(DIAMETER_M)
    pupil = filtered(DIAMETER_M, across, across, cells=600, width=2.0)
    found = shares_of_light(pupil, LASER_M, 0.5 * LASER_M / MESH.pitch_m)
    assert found == pytest.approx((0.627, 0.319, 0.054), abs=0.003)
    assert MESH.shares() == pytest.approx((0.643, 0.318, 0.039), abs=0.001)
    assert found == pytest.approx(MESH.shares(), abs=0.02)
    # Eight wires one way and two the other spread less than five each way.
    lopsided, even = (1 - 0.8) * (1 - 0.95), (1 - 0.875) ** 2
    assert Mesh(1.0, 0.125).shares()[2] == pytest.approx(even)
    assert lopsided < even


P_RAD = np.linspace(0.8 * LASER_M / THICK_M, 1.8 * LASER_M / THIN_M, 200)
FRINGE_RAD = 2.0 * LASER_M / DIAMETER_M


def depth(wires):
    """The darkest place of a tail over its mean, before the null that both wires share."""
    light = tail(filtered(DIAMETER_M, wires, []), LASER_M, P_RAD, FRINGE_RAD)
    return light.min() / light.mean()


def pair(separation_inches):
    half = separation_inches * INCH_M / 2
    return [(-half, THIN_M), (half, THICK_M)]


def test_two_diameters_fill_each_other_s_nulls():
    """Apodisation: a lone wire leaves some thousandths, a pair half the aperture apart a third."""
    assert depth([(0.0, THIN_M)]) < 0.02
    assert depth([(0.0, THICK_M)]) < 0.02
    assert depth(pair(0.271)) > 0.16


def test_any_separation_with_fringes_finer_than_the_lobes_apodises():
    """The report's best, the radius of the aperture, is hardly better than others."""
    assert depth(pair(0.05)) < 0.5 * depth(pair(0.125))
    assert depth(pair(0.125)) > 0.1
    assert depth(pair(0.4)) > 0.16


def test_the_null_that_both_share_stays():
    """Twice lambda over the thin wire is three times lambda over the thick: a third is needed."""
    p = np.array([1.5, 2.0]) * LASER_M / THIN_M
    lobe, common = tail(filtered(DIAMETER_M, pair(0.271), []), LASER_M, p, FRINGE_RAD)
    assert common < 0.02 * lobe
