"""Kernels that borrow what they are given: nothing is counted, nothing is made, nothing leaks."""

import fcntl
import multiprocessing
import sys
import time

import numba
import numpy as np
import pytest
from numba.core import event
from numba.core.caching import IndexDataCacheFile
from numba.core.errors import NumbaError

from service.attitude.covariance import information
from service.attitude.quest import quest
from service.compiled.arrays import borrowed_view
from service.compiled.jit import _BitcodeLibrary, njit, njit_inlined, njit_no_refcount
from service.identify.voting.fov_rotation import rotation_rad
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
    @njit_no_refcount
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
            view = borrowed_view(made)
            found += total(made) - total(view[1:])
        return found

    assert of_new_arrays(1_000) == sum(4.0 * k for k in range(1_000))


def test_what_borrows_cannot_make_an_array():
    @njit_no_refcount
    def makes(n):
        return np.empty(n)[0]

    with pytest.raises(NumbaError):
        makes(3)


def test_only_what_python_calls_becomes_machine_code():
    @njit_no_refcount
    def doubled(x):
        return 2.0 * x

    @njit
    def doubled_twice(x):
        return doubled(doubled(x))

    assert doubled_twice(3.0) == 12.0
    assert len(doubled_twice.overloads) == 1
    assert not doubled.overloads
    assert doubled(3.0) == 6.0
    assert len(doubled.overloads) == 1


def test_what_a_copied_part_calls_is_not_copied_with_it():
    """Else each level of calls would multiply the code of the one below."""

    @njit_no_refcount
    def called(value):
        return value + 1.0

    @njit_inlined
    def part(value):
        return called(value) * called(2.0 * value)

    @njit_no_refcount
    def kernel(value):
        return part(value)

    assert kernel(1.0) == 6.0
    for each, is_copied in ((called, False), (part, True)):
        (compiled,) = each._inner.overloads.values()
        code = compiled.library.get_llvm_str()
        assert each.__name__ in code
        assert ("alwaysinline" in code) == is_copied


def test_a_kernel_is_compiled_once_for_all_constants_that_kernels_call_it_with():
    @njit_no_refcount
    def scaled(value, factor):
        return value * factor

    @njit
    def outer(value, factor):
        return scaled(value, 2) + scaled(value, 3) + scaled(value, factor)

    assert outer(1.0, 4) == 9.0
    assert len(scaled._inner.overloads) == 1


def test_a_kernel_that_needs_a_constant_still_gets_it():
    @njit_no_refcount
    def part(values, place):
        return values[place]  # of different types, so that the place tells which

    @njit
    def outer(value):
        values = value, True
        return part(values, 0) if part(values, 1) else 0.0

    assert outer(5.0) == 5.0


def test_a_kernel_that_many_kernels_call_is_linked_once():
    """Else each level of calls would hold the code of all below it."""

    @njit_no_refcount
    def lowest(value):
        return value + 1.0

    @njit_no_refcount
    def left(value):
        return lowest(value) * 2.0

    @njit_no_refcount
    def right(value):
        return left(value) + lowest(value)

    @njit
    def outer(value):
        return right(value) + left(value) + lowest(value)

    assert outer(1.0) == 12.0
    for each in (left, right):
        (compiled,) = each._inner.overloads.values()
        code = compiled.library.get_llvm_str()
        assert [
            line for line in code.splitlines() if line.startswith("define") and "lowest" in line
        ] == []


def test_an_error_in_what_a_kernel_calls_is_raised():
    @njit
    def checked(x):
        if x < 0.0:
            raise ValueError("negative")
        return x

    @njit
    def outer(x):
        return checked(x) + 1.0

    assert outer(1.0) == 2.0
    with pytest.raises(ValueError, match="negative"):
        outer(-1.0)


def _save_with(start, kind):
    """Compile one kernel for one kind of number, and save it when the others are ready, too."""
    found = _twice_the_sum.py_func
    save = IndexDataCacheFile._save_index

    def slowly(cache_file, overloads):
        time.sleep(0.2)  # between reading the index and writing it
        save(cache_file, overloads)

    IndexDataCacheFile._save_index = slowly
    start.wait(60)
    assert njit(found)(kind(3)) == kind(6)


@njit
def _twice_the_sum(value):
    return value + value


def test_processes_that_save_one_kernel_at_once_lose_no_entry(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    context = multiprocessing.get_context("spawn")
    start = context.Barrier(2)
    savers = [
        context.Process(target=_save_with, args=(start, kind)) for kind in (np.int64, np.float64)
    ]
    for each in savers:
        each.start()
    for each in savers:
        each.join()
        assert each.exitcode == 0
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    kept = njit(_twice_the_sum.py_func)
    assert (kept(np.int64(3)), kept(np.float64(3.0))) == (6, 6.0)
    assert sum(kept.stats.cache_hits.values()) == 2
    assert not kept.stats.cache_misses


def _compile_counted(start, compiled):
    """Compile a kernel when the others are ready, too, and count it where it was compiled."""
    kernel = njit(_twice_the_sum.py_func)
    start.wait(60)
    with event.install_recorder("numba:compile") as recorder:
        assert kernel(3) == 6
    with compiled.get_lock():
        compiled.value += any(each.is_start for _, each in recorder.buffer)


def test_of_several_processes_that_need_a_kernel_one_compiles_it(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    context = multiprocessing.get_context("spawn")
    start, compiled = context.Barrier(4), context.Value("i", 0)
    processes = [context.Process(target=_compile_counted, args=(start, compiled)) for _ in range(4)]
    for each in processes:
        each.start()
    for each in processes:
        each.join()
        assert each.exitcode == 0
    assert compiled.value == 1


def test_a_kernel_that_does_not_compile_holds_nobody_up(monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))

    @njit
    def halved(x):
        return x / 2

    for _ in range(2):
        with pytest.raises(NumbaError):
            halved("text")
    assert halved(3.0) == 1.5
    for lock in tmp_path.rglob("*.lock"):
        with lock.open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_what_numba_adds_to_a_kernel_has_no_machine_code_either(monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))  # nothing is compiled yet

    @njit
    def least(values):
        return np.sort(values)[0]

    with event.install_recorder("numba:compile") as recorder:
        assert least(np.array([3.0, 1.0, 2.0])) == 1.0
    added = {each.data["dispatcher"] for _, each in recorder.buffer} - {least}
    libraries = [kind.library for each in added for kind in each.overloads.values()]
    assert len(libraries) > 2
    assert {type(library) for library in libraries} == {_BitcodeLibrary}
