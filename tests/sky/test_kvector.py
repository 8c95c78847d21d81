"""The k-vector gives exactly the rows of a range, at the cost of about one row too many."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from service.sky.geometry.kvector import bracket, build_kvector, rows_within

VALUES = st.lists(
    st.floats(-1e6, 1e6, allow_nan=False) | st.sampled_from([0.0, -1.0, 713.2]), max_size=60
)
BOUND = st.floats(-2e6, 2e6, allow_nan=False) | st.sampled_from(
    [0.0, -1.0, 713.2, float("inf"), float("-inf")]
)


def found(values, low, high):
    index = build_kvector(np.sort(np.array(values, dtype=float)))
    return index, rows_within(
        index.value, index.below, index.slope, index.intercept, float(low), float(high)
    )


@settings(max_examples=300)
@given(values=VALUES, low=BOUND, high=BOUND)
@example(values=[], low=0.0, high=1.0)
@example(values=[5.0], low=5.0, high=5.0)
@example(values=[0.0, 0.0, 0.0], low=0.0, high=0.0)
@example(values=[1.0, 1.0 + 2**-52], low=1.0, high=1.0)
def test_the_rows_of_any_range_are_those_of_a_bisection(values, low, high):
    index, (first, end) = found(values, low, high)
    expected = np.flatnonzero((index.value >= low) & (index.value <= high))
    assert list(range(first, end)) == expected.tolist()


@given(values=st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=60))
def test_every_value_is_found_under_itself(values):
    for value in values:
        index, (first, end) = found(values, value, value)
        assert (index.value[first:end] == value).all()
        assert end - first == values.count(value)


def test_the_bracket_contains_the_range_and_is_about_a_row_wider(rng):
    """On projections like those of guide triangles, windows of three sigmas of a pixel."""
    index = build_kvector(np.sort(rng.normal(0.0, 350.0, 25_000)))
    excess = []
    for centre in rng.uniform(-600.0, 900.0, 2_000):
        low, high = centre - 8.6, centre + 8.6
        first, end = bracket(index.below, index.slope, index.intercept, low, high)
        inside = np.flatnonzero((index.value >= low) & (index.value <= high))
        if len(inside):
            assert first <= inside[0]
            assert end > inside[-1]
            excess.append(end - first - len(inside))
    assert np.mean(excess) < 3.0


def test_the_line_of_mortari_and_neta_has_no_value_below_it_and_all_at_its_end(rng):
    value = np.sort(rng.uniform(-696.0, 1293.0, 500))
    index = build_kvector(value)
    line = index.slope * np.arange(1, 501) + index.intercept
    assert line[0] <= value[0]
    assert line[-1] >= value[-1]
    assert index.below[0] == 0
    assert index.below[-1] == 500
    counted = [(value <= z).sum() for z in line[1:-1]]
    assert index.below[1:-1].tolist() == counted
    assert index.slope == pytest.approx((value[-1] - value[0]) / 499, rel=1e-12)
