"""The shelf holds its bound, forgets the least recently used, and builds each thing once."""

import threading
import time
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.sky.shelf import Shelf

THREADS = 50


@dataclass(frozen=True)
class Thing:
    nbytes: int


requests = st.lists(st.tuples(st.integers(0, 9), st.booleans()), max_size=80)


@given(requests, st.integers(0, 60))
def test_it_is_an_lru_cache_bounded_in_bytes(asked, max_bytes):
    """Beside a plain model: the same hits, the same entries in the same order, the same bytes."""
    shelf = Shelf(max_bytes)
    model: OrderedDict[int, int] = OrderedDict()
    hits = evictions = 0
    for key, dropped in asked:
        if dropped:
            assert shelf.drop(lambda k, key=key: k == key) == int(model.pop(key, None) is not None)
            continue
        size = 3 * key + 1
        thing, was_there = shelf.get(key, lambda size=size: Thing(size))
        assert thing == Thing(size)
        assert was_there == (key in model)
        hits += was_there
        model[key] = size
        model.move_to_end(key)
        while sum(model.values()) > max_bytes and len(model) > 1:
            model.popitem(last=False)
            evictions += 1
        state = shelf.state()
        assert [entry.key for entry in state.entries] == list(model)
        assert state.nbytes == sum(model.values()) == sum(e.thing.nbytes for e in state.entries)
        assert state.nbytes <= max_bytes or len(state.entries) == 1
        assert (state.hits, state.evictions) == (hits, evictions)


def test_a_thing_larger_than_the_shelf_is_given_and_kept_until_the_next():
    shelf = Shelf(max_bytes=10)
    assert shelf.get("large", lambda: Thing(1000)) == (Thing(1000), False)
    assert shelf.get("large", lambda: Thing(1000)) == (Thing(1000), True)
    shelf.get("small", lambda: Thing(1))
    assert [entry.key for entry in shelf.state().entries] == ["small"]


def together(count, work):
    """Run `work(k)` in as many threads at the same moment; results or exceptions in order."""
    barrier = threading.Barrier(count)

    def one(k):
        barrier.wait()
        try:
            return work(k)
        except Exception as error:  # handed to the test to look at
            return error

    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(one, range(count)))


def test_fifty_first_requests_at_once_build_the_thing_once():
    shelf, built = Shelf(1000), []

    def build():
        time.sleep(0.05)
        built.append(1)
        return Thing(7)

    results = together(THREADS, lambda k: shelf.get("zone", build))
    assert len(built) == 1
    assert {id(thing) for thing, _ in results} == {id(results[0][0])}
    assert sum(not was_there for _, was_there in results) == 1
    state = shelf.state()
    assert (state.hits, state.misses) == (THREADS - 1, 1)


def test_different_things_are_built_side_by_side():
    shelf, inside = Shelf(1000), threading.Barrier(2)

    def build():
        # Passed only where two builders are at work at once.
        inside.wait(timeout=10)
        return Thing(1)

    results = together(2, lambda k: shelf.get(k, build))
    assert [was_there for _, was_there in results] == [False, False]


def test_an_error_reaches_every_waiting_caller_and_leaves_nothing_behind():
    shelf, tried = Shelf(1000), []

    def fail():
        time.sleep(0.05)
        tried.append(1)
        raise ValueError("no such zone")

    results = together(THREADS, lambda k: shelf.get("zone", fail))
    assert all(isinstance(result, ValueError) for result in results)
    # Every builder's error is seen by those who waited for that builder.
    assert 1 <= len(tried) < THREADS
    assert shelf.state().entries == ()
    assert shelf.get("zone", lambda: Thing(5)) == (Thing(5), False)
    assert shelf.get("zone", fail) == (Thing(5), True)


def test_dropping_while_something_is_built_harms_neither():
    shelf, started, go_on = Shelf(1000), threading.Event(), threading.Event()

    def build():
        started.set()
        go_on.wait(10)
        return Thing(5)

    with ThreadPoolExecutor(1) as pool:
        promise = pool.submit(shelf.get, "zone", build)
        started.wait(10)
        assert shelf.drop() == 0
        go_on.set()
        assert promise.result(10) == (Thing(5), False)
    assert shelf.state().nbytes == 5


def test_many_threads_leave_the_books_balanced(seed):
    shelf = Shelf(max_bytes=100)

    def work(k):
        for step in range(200):
            key = (k * 31 + step * 17 + seed) % 23
            thing, _ = shelf.get(key, lambda key=key: Thing(key + 1))
            assert thing.nbytes == key + 1
            if step % 50 == 49:
                shelf.drop(lambda held: held == key)  # noqa: B023  used at once

    assert together(16, work) == [None] * 16
    state = shelf.state()
    assert state.nbytes == sum(entry.thing.nbytes for entry in state.entries) <= 100
    assert state.hits + state.misses == 16 * 200


def test_every_key_is_dropped_without_a_choice():
    shelf = Shelf(100)
    for key in range(3):
        shelf.get(key, lambda: Thing(1))
    assert shelf.drop() == 3
    assert shelf.state().nbytes == 0


@pytest.mark.parametrize("kind", [KeyboardInterrupt, MemoryError])
def test_not_even_an_interruption_leaves_a_promise_behind(kind):
    shelf = Shelf(100)

    def interrupted():
        raise kind

    with pytest.raises(kind):
        shelf.get("zone", interrupted)
    assert shelf.get("zone", lambda: Thing(1)) == (Thing(1), False)
