"""What is packed is unpacked bit for bit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.gyro.blocks import pack, unpack

BITS = st.integers(0, 2**64 - 1)


def bits(values):
    return np.ascontiguousarray(values).view(np.uint64)


@given(st.lists(st.tuples(BITS, BITS, BITS), min_size=1, max_size=50))
def test_rates_of_any_bits_come_back_as_they_were(rows):
    """NaN with a payload, minus zero and infinities are bits as others are."""
    values = np.array(rows, np.uint64).view(np.float64)
    found = unpack(pack(values), values.shape)
    assert np.array_equal(bits(found), bits(values))


@given(st.lists(BITS, min_size=1, max_size=50))
def test_times_of_any_bits_come_back_as_they_were(row):
    values = np.array(row, np.uint64).view(np.float64)
    assert np.array_equal(bits(unpack(pack(values), values.shape)), bits(values))


def test_equal_arrays_become_equal_bytes_whatever_their_memory_looks_like(rng):
    values = rng.normal(size=(100, 3))
    assert pack(values) == pack(np.asfortranarray(values)) == pack(values.astype(">f8"))


def test_counts_of_a_gyro_take_less_than_a_quarter_of_their_size(rng):
    counts = np.round(rng.normal(0, 40, (10_000, 3)) + 500)
    assert len(pack(counts * 2.5e-7)) < counts.nbytes / 4


@pytest.mark.parametrize("damage", [lambda b: b[:-9], lambda b: b"y" + b[1:], lambda b: b""])
def test_damaged_bytes_are_refused(rng, damage):
    values = rng.normal(size=(10, 3))
    with pytest.raises(ValueError, match="cannot be decompressed"):
        unpack(damage(pack(values)), values.shape)


def test_another_number_of_samples_is_refused(rng):
    with pytest.raises(ValueError, match="30 numbers are no 11 x 3"):
        unpack(pack(rng.normal(size=(10, 3))), (11, 3))
