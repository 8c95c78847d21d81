"""The order, the sign and the direction of quaternions, beside every neighbour's convention."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.vectors import (
    coordinate_rotation,
    matrix_from_quaternion,
    quaternion_from_matrix,
)

C, S = math.cos(math.radians(30.0)), math.sin(math.radians(30.0))
HALF_C, HALF_S = math.cos(math.radians(15.0)), math.sin(math.radians(15.0))

# Axes turned by +30 deg about x, y, z: A takes inertial components to body components.
ABOUT = {
    "x": ([HALF_S, 0, 0, HALF_C], [[1, 0, 0], [0, C, S], [0, -S, C]]),
    "y": ([0, HALF_S, 0, HALF_C], [[C, 0, -S], [0, 1, 0], [S, 0, C]]),
    "z": ([0, 0, HALF_S, HALF_C], [[C, S, 0], [-S, C, 0], [0, 0, 1]]),
}


def test_thirty_degrees_about_z_is_the_standard_s_example():
    """CCSDS 504.0-B: scalar last, positive; a coordinate transform from inertial to body."""
    q = quaternion_from_matrix(coordinate_rotation(2, 30.0))
    assert q == pytest.approx([0.0, 0.0, 0.2588, 0.9659], abs=5e-5)


@pytest.mark.parametrize("axis", ABOUT)
def test_the_matrix_of_a_turn_about_an_axis_is_as_written_out(axis):
    q, a = ABOUT[axis]
    assert matrix_from_quaternion(q) == pytest.approx(np.array(a), abs=1e-15)
    assert quaternion_from_matrix(np.array(a)) == pytest.approx(q, abs=1e-15)
    assert coordinate_rotation("xyz".index(axis), 30.0) == pytest.approx(np.array(a), abs=1e-15)


def test_a_matrix_with_every_component_is_as_written_out():
    """Shuster's A(q) for q = (1, 3, 5, 1) / 6, worked out by hand."""
    q = np.array([1.0, 3.0, 5.0, 1.0]) / 6.0
    by_hand = np.array([[-32, 16, 4], [-4, -16, 32], [16, 28, 16]]) / 36.0
    assert matrix_from_quaternion(q) == pytest.approx(by_hand, abs=1e-15)


def test_an_inertial_star_on_x_is_seen_towards_minus_y_after_the_axes_turned_to_the_left():
    body = matrix_from_quaternion(ABOUT["z"][0]) @ [1.0, 0.0, 0.0]
    assert body == pytest.approx([C, -S, 0.0], abs=1e-15)


@pytest.mark.parametrize("axis", ABOUT)
def test_scipy_s_rotation_of_the_transposed_matrix_has_the_service_s_components(axis):
    q, a = ABOUT[axis]
    a = np.array(a)
    assert Rotation.from_matrix(a.T).as_quat() == pytest.approx(q, abs=1e-15)
    # The matrix itself gives the conjugate: the classic trap.
    conjugate = [-q[0], -q[1], -q[2], q[3]]
    assert Rotation.from_matrix(a).as_quat() == pytest.approx(conjugate, abs=1e-15)


@pytest.mark.parametrize("axis", ABOUT)
def test_spice_s_quaternion_is_scalar_first_and_the_conjugate(axis):
    """SPICE's m2q(A), by its own definition: cos(t/2), sin(t/2) n for a turn of vectors by t."""
    q, a = ABOUT[axis]
    turn = -math.radians(30.0)
    n = np.eye(3)["xyz".index(axis)]
    m2q = np.array([math.cos(turn / 2), *(math.sin(turn / 2) * n)])
    w, v = m2q[0], m2q[1:]
    k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    assert np.eye(3) + 2 * w * k + 2 * k @ k == pytest.approx(np.array(a), abs=1e-15)
    assert [*-v, w] == pytest.approx(q, abs=1e-15)


def test_the_scalar_is_never_negative():
    q = -np.array(ABOUT["z"][0])
    assert quaternion_from_matrix(matrix_from_quaternion(q))[3] > 0
