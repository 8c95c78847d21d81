"""The pair index holds every pair up to the largest separation, once, in order."""

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from service.sky.geometry.directions import separation_rad
from service.sky.geometry.pairs import build_pairs
from service.vectors import from_ra_dec


def sky(seed, count, spread_deg):
    rng = np.random.default_rng(seed)
    if spread_deg >= 180:
        v = rng.normal(size=(count, 3))
        return v / np.linalg.norm(v, axis=1, keepdims=True)
    return from_ra_dec(
        rng.uniform(0, spread_deg, count), rng.uniform(-spread_deg, spread_deg, count) / 2
    )


def brute_force(directions, limit_deg):
    """Separation and rows of every pair, by the tangent."""
    pairs = []
    for i, j in combinations(range(len(directions)), 2):
        a, b = directions[i], directions[j]
        angle = math.atan2(np.linalg.norm(np.cross(a, b)), a @ b)
        if angle <= math.radians(limit_deg):
            pairs.append((angle, i, j))
    return sorted(pairs)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 60),
    spread_deg=st.sampled_from([0.1, 5.0, 40.0, 180.0]),
    limit_deg=st.sampled_from([0.01, 1.0, 4.0, 8.0, 60.0]),
)
@example(seed=0, count=0, spread_deg=5.0, limit_deg=8.0)
@example(seed=0, count=1, spread_deg=5.0, limit_deg=8.0)
@example(seed=0, count=2, spread_deg=0.1, limit_deg=60.0)
@example(seed=0, count=60, spread_deg=0.1, limit_deg=1.0)  # more pairs than room was made for
def test_the_index_is_what_brute_force_finds(seed, count, spread_deg, limit_deg):
    directions = sky(seed, count, spread_deg)
    index = build_pairs(directions, limit_deg)
    expected = brute_force(directions, limit_deg)
    assert index.count == len(expected)
    assert index.separation_rad == pytest.approx([p[0] for p in expected], abs=1e-14)
    found = set(zip(index.brighter.tolist(), index.dimmer.tolist(), strict=True))
    assert found == {(i, j) for _, i, j in expected}
    assert (np.diff(index.separation_rad) >= 0).all()
    assert (index.brighter < index.dimmer).all()


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(2, 60),
    low=st.floats(0, 1),
    width=st.floats(0, 0.2),
)
def test_a_look_up_by_bins_misses_no_pair(seed, count, low, width):
    index = build_pairs(sky(seed, count, 5.0), 8.0)
    low, high = low * math.radians(8.0), (low + width) * math.radians(8.0)
    first_bin = min(int(low * index.bins_per_rad), len(index.bin_start) - 2)
    start = index.bin_start[first_bin]
    assert (index.separation_rad[:start] < low).all()
    assert index.bin_start[0] == 0
    assert index.bin_start[-1] == index.count
    assert (np.diff(index.bin_start) >= 0).all()
    # Bins are narrow: a look-up begins close to the first pair that it wants.
    wanted = np.searchsorted(index.separation_rad, [low, high])
    assert wanted[0] >= start


@pytest.mark.parametrize("arcsec", [1e-3, 1.0, 3600.0])
def test_separations_are_right_from_a_thousandth_of_an_arcsecond_to_a_half_turn(arcsec):
    angle = math.radians(arcsec / 3600.0)
    one, other = np.array([1.0, 0.0, 0.0]), np.array([math.cos(angle), math.sin(angle), 0.0])
    assert separation_rad(one, other) == pytest.approx(angle, abs=1e-16)
    assert separation_rad(one, -other) == pytest.approx(math.pi - angle, abs=1e-15)
    assert separation_rad(one, one) == 0.0


def test_stars_in_one_place_are_a_pair_of_separation_zero():
    index = build_pairs(np.repeat([[0.0, 0.0, 1.0]], 3, axis=0), 1.0)
    assert index.separation_rad.tolist() == [0.0, 0.0, 0.0]
    assert list(zip(index.brighter, index.dimmer, strict=True)) == [(0, 1), (0, 2), (1, 2)]


def test_what_is_held_is_counted_and_locked():
    index = build_pairs(sky(1, 30, 5.0), 8.0)
    arrays = (index.separation_rad, index.brighter, index.dimmer, index.bin_start)
    assert index.nbytes == sum(array.nbytes for array in arrays)
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_many_pairs_of_one_separation_are_in_order_of_their_stars():
    """As of stars that a grid was drawn by: more to a bin than are sorted one by one."""
    steps = from_ra_dec(np.arange(90.0), np.zeros(90))
    # A copy, in the order of memory that kernels are compiled for.
    index = build_pairs(steps[::-1].copy(), 2.5)
    first = index.separation_rad < math.radians(1.5)
    assert first.sum() == 89
    got = [index.separation_rad, index.brighter, index.dimmer]
    order = np.lexsort(got[::-1])
    assert (order == np.arange(index.count)).all()
