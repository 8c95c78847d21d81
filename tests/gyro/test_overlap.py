"""Which samples of two blocks have the same time, held against comparing each with each."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from service.gyro.blocks import SAME_TIME_NS, first_shared_ns, tai_ns_of, times_of_steps

TIMES = st.lists(st.integers(0, 60), min_size=1, max_size=12).map(
    # Small steps, so that many come near one another: below, at and beyond the bound.
    lambda steps: 250 * np.cumsum(np.array(steps, np.int64) + 4)
)


def by_comparing_all(times_ns, others_ns):
    shared = [
        int(one)
        for one in times_ns
        if any(abs(int(one) - int(e)) < SAME_TIME_NS for e in others_ns)
    ]
    return shared[0] if shared else None


@given(TIMES, TIMES, st.integers(-20_000, 20_000))
def test_a_shared_time_is_found_if_and_only_if_two_samples_are_that_near(one, other, offset_ns):
    other = other + offset_ns
    assert first_shared_ns(one, other) == by_comparing_all(one, other)
    assert (first_shared_ns(other, one) is None) == (first_shared_ns(one, other) is None)


def test_samples_between_those_of_another_block_are_no_overlap():
    gap, filling = np.array([0, 10, 50, 60]) * 10**9, np.array([20, 30, 40]) * 10**9
    assert first_shared_ns(filling, gap) is None


def test_the_same_sample_is_found_where_both_times_were_rounded():
    """A third of a second has no exact time: the start of a later block is rounded to 1 ns."""
    one = tai_ns_of(0, times_of_steps(1 / 3, 1000))
    other = tai_ns_of(333_333_333, times_of_steps(1 / 3, 5))
    assert first_shared_ns(other, one) == 333_333_333
