"""Guide triangles are those of each star's nearest neighbours, whatever finds them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.sky.geometry.triangles import (
    LEAST_SEPARATION_DEG,
    SIDE_SCALE,
    build_triangles,
    pairs_of_slaves,
    principal_axis,
)
from service.vectors import angle_between_deg, unit


def sky(seed, count, spread):
    rng = np.random.default_rng(seed)
    return unit(rng.normal(size=3) + spread * rng.normal(size=(count, 3)))


def brute_force(direction, reach_deg, slaves):
    """Rows and sides of every triangle, by sorting all separations."""
    triangles = []
    for master in range(len(direction)):
        separation = angle_between_deg(direction[master], direction)
        near = [
            k
            for k in np.argsort(separation, kind="stable")
            if LEAST_SEPARATION_DEG <= separation[k] <= reach_deg
        ][:slaves]
        for a in range(len(near)):
            for b in range(a + 1, len(near)):
                if a < 2:
                    rows = (master, int(near[a]), int(near[b]))
                    m, i, j = direction[list(rows)]
                    sides = [np.linalg.norm(m - i), np.linalg.norm(m - j), np.linalg.norm(i - j)]
                    triangles.append((rows, SIDE_SCALE * np.array(sides)))
    return dict(triangles)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 40),
    spread=st.sampled_from([0.002, 0.05, 10.0]),
    slaves=st.integers(2, 6),
)
def test_triangles_and_sides_are_what_brute_force_finds(seed, count, spread, slaves):
    direction = sky(seed, count, spread)
    index = build_triangles(direction, 5.0, slaves)
    expected = brute_force(direction, 5.0, slaves)
    found = {tuple(rows): side for rows, side in zip(index.star.tolist(), index.side, strict=True)}
    assert found.keys() == expected.keys()
    for rows, side in found.items():
        assert side == pytest.approx(expected[rows], abs=1e-4)
    assert (np.diff(index.projection.value) >= 0).all()


def test_four_slaves_make_five_triangles_with_the_first_or_the_second():
    assert pairs_of_slaves(4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3)]
    assert [len(pairs_of_slaves(n)) for n in (2, 3, 5, 6)] == [1, 3, 7, 9]


def test_five_degrees_are_a_chord_of_872_units():
    """The paper prints 872.8, which is neither this nor the arc."""
    direction = np.array([[1.0, 0, 0], [math.cos(math.radians(5)), math.sin(math.radians(5)), 0]])
    assert SIDE_SCALE * np.linalg.norm(direction[0] - direction[1]) == pytest.approx(
        872.39, abs=0.01
    )


def test_the_axis_is_the_first_right_singular_vector(rng):
    """Held against a singular value decomposition of the centred sides."""
    side = (
        rng.normal(size=(400, 3)) * [90.0, 120.0, 200.0] @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    )
    mean, axis, explained = principal_axis(side)
    _, singular, rows = np.linalg.svd(side - mean, full_matrices=False)
    assert abs(axis @ rows[0]) == pytest.approx(1.0, abs=1e-12)
    assert axis.sum() > 0
    assert explained == pytest.approx(singular**2 / (singular**2).sum())
