"""Kernels that borrow what they are given: nothing is counted, nothing is made, nothing leaks."""

import sys

import numpy as np
import pytest
from numba import njit
from numba.core.errors import NumbaError

from service.attitude.kernels import information, quest
from service.identify.fov_rotation import rotation_rad
from service.uncounted import borrowing
from service.vectors import unit


def test_what_borrows_leaves_the_counts_of_its_caller_alone() -> None:
    rng = np.random.default_rng(8)
    vectors, weights = unit(rng.normal(size=(5, 3))), np.ones(5)
    quaternion, room, start = np.empty(4), np.empty((3, 3, 3)), np.array([0.0, 0.0, 0.0, 1.0])
    held = (vectors, weights, quaternion, room, start)
    before = [sys.getrefcount(array) for array in held]
    for _ in range(1_000):
        information(vectors, weights, room[0])
        quest(vectors, vectors, weights, start, quaternion, room)
        rotation_rad(vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], start, False)
    assert [sys.getrefcount(array) for array in held] == before


def test_what_is_made_by_who_calls_outlives_what_borrows() -> None:
    @borrowing
    def total(rows):  # type: ignore[no-untyped-def]
        found = 0.0
        for row in rows:
            for value in row:
                found += value
        return found

    @njit
    def of_new_arrays(n):  # type: ignore[no-untyped-def]
        found = 0.0
        for k in range(n):
            made = np.full((3, 4), float(k))
            found += total(made) - total(made[1:])
        return found

    assert of_new_arrays(1_000) == sum(4.0 * k for k in range(1_000))


def test_what_borrows_cannot_make_an_array() -> None:
    @borrowing
    def makes(n):  # type: ignore[no-untyped-def]
        return np.empty(n)[0]

    with pytest.raises(NumbaError):
        makes(3)
