"""Vectors, angles, rotations and quaternions keep their laws at every angle."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from service.vectors import (
    ARCSEC_PER_RADIAN,
    angle_between_deg,
    attitude_error_arcsec,
    coordinate_rotation,
    from_ra_dec,
    matrix_from_quaternion,
    quaternion_from_matrix,
    read_only,
    rotate_about,
    separation_deg,
    to_ra_dec,
    unit,
)

component = st.floats(-1, 1, allow_subnormal=False)
directions = (
    st.tuples(component, component, component)
    .filter(lambda v: math.hypot(*v) > 1e-3)
    .map(lambda v: np.array(v) / math.hypot(*v))
)
quaternions = (
    st.tuples(component, component, component, component)
    .filter(lambda q: math.hypot(*q) > 1e-3)
    .map(lambda q: np.array(q) / math.hypot(*q))
)


def upright(q):
    return -q if q[3] < 0 else q


def half_turn(axis):
    return np.array([*axis, 0.0])


@given(quaternions)
def test_an_attitude_matrix_is_orthonormal_and_right_handed(q):
    a = matrix_from_quaternion(q)
    assert a @ a.T == pytest.approx(np.eye(3), abs=1e-14)
    assert np.linalg.det(a) == pytest.approx(1.0, abs=1e-14)


@given(quaternions)
@example(half_turn([1.0, 0.0, 0.0]))
@example(half_turn([0.0, 1.0, 0.0]))
@example(half_turn([0.0, 0.0, 1.0]))
@example(half_turn(np.array([1.0, 1.0, 1.0]) / math.sqrt(3.0)))
@example(np.array([0.0, 0.0, 0.0, 1.0]))
@example(np.array([0.5, 0.5, 0.5, 0.5]))
def test_a_quaternion_survives_the_way_through_its_matrix(q):
    back = quaternion_from_matrix(matrix_from_quaternion(q))
    assert math.hypot(*back) == pytest.approx(1.0, abs=1e-15)
    assert back[3] >= 0.0
    # At a half turn either sign is the same attitude.
    assert min(np.abs(back - q).max(), np.abs(back + q).max()) < 1e-14


@given(directions)
def test_every_exact_half_turn_survives_the_way_through_its_matrix(axis):
    turn = 2.0 * np.outer(axis, axis) - np.eye(3)
    q = quaternion_from_matrix(turn)
    assert matrix_from_quaternion(q) == pytest.approx(turn, abs=1e-14)


@given(quaternions, quaternions)
def test_attitudes_compose_as_their_matrices_do(first, second):
    a, b = matrix_from_quaternion(first), matrix_from_quaternion(second)
    composed = quaternion_from_matrix(b @ a)
    # q of (second after first), in the order of coordinate transforms (Shuster 1993).
    v1, s1, v2, s2 = first[:3], first[3], second[:3], second[3]
    expected = np.array([*(s2 * v1 + s1 * v2 - np.cross(v2, v1)), s1 * s2 - v1 @ v2])
    assert min(np.abs(composed - expected).max(), np.abs(composed + expected).max()) < 1e-14


@given(directions, directions, st.sampled_from([0.0, 1e-3, 0.02, 1.0, 3600.0]))
def test_angles_are_right_at_a_thousandth_of_an_arcsecond_and_close_to_a_half_turn(
    v, aside, arcsec
):
    aside = aside - (aside @ v) * v
    if np.linalg.norm(aside) < 1e-3:
        return
    aside /= np.linalg.norm(aside)
    angle = arcsec / ARCSEC_PER_RADIAN
    turned = math.cos(angle) * v + math.sin(angle) * aside
    assert angle_between_deg(v, turned) * 3600.0 == pytest.approx(arcsec, abs=1e-9)
    assert separation_deg(v, turned) * 3600.0 == pytest.approx(arcsec, abs=1e-9)
    assert (180.0 - angle_between_deg(v, -turned)) * 3600.0 == pytest.approx(arcsec, abs=1e-9)
    assert (180.0 - separation_deg(v, -turned)) * 3600.0 == pytest.approx(arcsec, abs=1e-9)


def test_angles_between_many_vectors_come_in_their_shape():
    many = from_ra_dec([0.0, 90.0, 180.0], [0.0, 0.0, 0.0])
    assert angle_between_deg(many, many[0]) == pytest.approx([0.0, 90.0, 180.0], abs=1e-13)
    assert angle_between_deg(3.0 * many[1], many[0]) == pytest.approx(90.0)


@given(st.floats(0, 360, exclude_max=True), st.floats(-89.999, 89.999))
def test_right_ascension_and_declination_come_back_from_their_vector(ra_deg, dec_deg):
    ra, dec = to_ra_dec(from_ra_dec(ra_deg, dec_deg))
    assert 0.0 <= ra < 360.0
    assert abs((ra - ra_deg + 180.0) % 360.0 - 180.0) * math.cos(math.radians(dec_deg)) < 1e-12
    assert dec == pytest.approx(dec_deg, abs=1e-12)


def test_a_right_ascension_just_below_zero_is_not_360():
    ra, _ = to_ra_dec(np.array([1.0, -1e-20, 0.0]))
    assert float(ra) == 0.0


@given(directions, st.floats(-400, 400), directions)
def test_rotate_about_is_the_exponential_of_the_cross_product(axis, angle_deg, v):
    angle = math.radians(angle_deg)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    expected = v + math.sin(angle) * k @ v + (1 - math.cos(angle)) * k @ k @ v
    assert rotate_about(angle * axis, v) == pytest.approx(expected, abs=1e-14)


def test_no_rotation_leaves_a_vector_exactly_as_it_is():
    v = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]])
    assert (rotate_about(np.zeros((2, 3)), v) == v).all()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_coordinate_rotation_turns_the_axes_not_the_vectors(axis):
    following, last = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
    turned = coordinate_rotation(axis, 90.0)
    # The axes turned by 90 deg about x: the old y lies along minus the new z.
    assert turned @ following == pytest.approx(-last, abs=1e-15)
    assert turned @ last == pytest.approx(following, abs=1e-15)
    assert turned @ np.eye(3)[axis] == pytest.approx(np.eye(3)[axis], abs=0)


@given(quaternions, directions, st.floats(0, 600))
def test_the_attitude_error_is_the_rotation_vector_that_was_put_in(q, axis, arcsec):
    truth = matrix_from_quaternion(q)
    error = arcsec * axis
    k = error / ARCSEC_PER_RADIAN
    turned = np.stack([rotate_about(-k, column) for column in truth.T], axis=1)
    assert attitude_error_arcsec(turned, truth) == pytest.approx(error, abs=1e-8)


def test_unit_scales_each_row_and_gives_nan_for_a_zero_vector():
    scaled = unit([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0]])
    assert scaled[0] == pytest.approx([0.6, 0.0, 0.8])
    assert np.isnan(scaled[1]).all()


def test_a_read_only_array_refuses_to_be_written():
    with pytest.raises(ValueError, match="read-only"):
        read_only(np.zeros(3))[0] = 1.0
