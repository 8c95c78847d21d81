"""Kernels that borrow what they are given: nothing is counted, nothing is made, nothing leaks."""

import sys

import numpy as np
import pytest
from numba import njit
from numba.core.errors import NumbaError

from service.attitude.kernels import information, quest
from service.identify.fov_rotation import rotation_rad
from service.uncounted import borrowing, uncounted
from service.vectors import unit


def test_what_borrows_leaves_the_counts_of_its_caller_alone(rng):
    vectors, weights = unit(rng.normal(size=(5, 3))), np.ones(5)
    quaternion, room, start = np.empty(4), np.empty((3, 3, 3)), np.array([0.0, 0.0, 0.0, 1.0])
    held = (vectors, weights, quaternion, room, start)
    before = [sys.getrefcount(array) for array in held]
    for _ in range(1_000):
        information(vectors, weights, room[0])
        quest(vectors, vectors, weights, start, quaternion, room)
        rotation_rad(vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], start, False)
    assert [sys.getrefcount(array) for array in held] == before


def test_what_its_caller_made_is_there_as_long_as_it_runs():
    @borrowing
    def total(rows):
        found = 0.0
        for row in rows:
            for value in row:
                found += value
        return found

    @njit
    def of_new_arrays(n):
        found = 0.0
        for k in range(n):
            made = np.full((3, 4), float(k))
            lent = uncounted(made)
            found += total(made) - total(lent[1:])
        return found

    assert of_new_arrays(1_000) == sum(4.0 * k for k in range(1_000))


def test_what_borrows_cannot_make_an_array():
    @borrowing
    def makes(n):
        return np.empty(n)[0]

    with pytest.raises(NumbaError):
        makes(3)
