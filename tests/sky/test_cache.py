"""The shelf holds its bound, forgets the least recently used, and builds each thing once."""

import threading
import time
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import BeingBuilt
from service.sky.cache import LruCache

THREADS = 50


@dataclass(frozen=True)
class Thing:
    nbytes: int


requests = st.lists(st.tuples(st.integers(0, 9), st.booleans()), max_size=80)


@given(requests, st.integers(0, 60))
def test_it_is_an_lru_cache_bounded_in_bytes(asked, max_bytes):
    """Beside a plain model: the same hits, the same entries in the same order, the same bytes."""
    cache = LruCache(max_bytes)
    model: OrderedDict[int, int] = OrderedDict()
    hits = evictions = 0
    for key, dropped in asked:
        if dropped:
            assert cache.drop(lambda k, key=key: k == key) == int(model.pop(key, None) is not None)
            continue
        size = 3 * key + 1
        thing, was_there = cache.get(key, lambda size=size: Thing(size))
        assert thing == Thing(size)
        assert was_there == (key in model)
        hits += was_there
        model[key] = size
        model.move_to_end(key)
        while sum(model.values()) > max_bytes and len(model) > 1:
            model.popitem(last=False)
            evictions += 1
        state = cache.state()
        assert [entry.key for entry in state.entries] == list(model)
        assert state.nbytes == sum(model.values()) == sum(e.thing.nbytes for e in state.entries)
        assert state.nbytes <= max_bytes or len(state.entries) == 1
        assert (state.hits, state.evictions) == (hits, evictions)


def test_a_thing_larger_than_the_shelf_is_given_and_kept_until_the_next():
    cache = LruCache(max_bytes=10)
    assert cache.get("large", lambda: Thing(1000)) == (Thing(1000), False)
    assert cache.get("large", lambda: Thing(1000)) == (Thing(1000), True)
    cache.get("small", lambda: Thing(1))
    assert [entry.key for entry in cache.state().entries] == ["small"]


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
    cache, built = LruCache(1000), []

    def build():
        time.sleep(0.05)
        built.append(1)
        return Thing(7)

    results = together(THREADS, lambda k: cache.get("zone", build))
    assert len(built) == 1
    assert {id(thing) for thing, _ in results} == {id(results[0][0])}
    assert sum(not was_there for _, was_there in results) == 1
    state = cache.state()
    assert (state.hits, state.misses) == (THREADS - 1, 1)


def test_different_things_are_built_side_by_side():
    cache, inside = LruCache(1000), threading.Barrier(2)

    def build():
        # Passed only where two builders are at work at once.
        inside.wait(timeout=10)
        return Thing(1)

    results = together(2, lambda k: cache.get(k, build))
    assert [was_there for _, was_there in results] == [False, False]


def test_an_error_reaches_every_waiting_caller_and_leaves_nothing_behind():
    cache, tried = LruCache(1000), []

    def fail():
        time.sleep(0.05)
        tried.append(1)
        raise ValueError("no such zone")

    results = together(THREADS, lambda k: cache.get("zone", fail))
    assert all(isinstance(result, ValueError) for result in results)
    # Every builder's error is seen by those who waited for that builder.
    assert 1 <= len(tried) < THREADS
    assert cache.state().entries == ()
    assert cache.get("zone", lambda: Thing(5)) == (Thing(5), False)
    assert cache.get("zone", fail) == (Thing(5), True)


def test_with_a_builder_the_caller_neither_builds_nor_waits():
    cache, go_on, builders = LruCache(1000), threading.Event(), []

    def build():
        go_on.wait(10)
        builders.append(threading.get_ident())
        return Thing(5)

    with ThreadPoolExecutor(1) as elsewhere:
        promises = []
        for _ in range(3):
            with pytest.raises(BeingBuilt) as waits:
                cache.get("index", build, lambda: elsewhere)
            promises.append(waits.value.done)
        go_on.set()
        assert [each.result(10) for each in promises] == [Thing(5)] * 3
    assert len(builders) == 1
    assert builders[0] != threading.get_ident()
    assert cache.get("index", build, lambda: elsewhere) == (Thing(5), True)


def test_dropping_while_something_is_built_harms_neither():
    cache, started, go_on = LruCache(1000), threading.Event(), threading.Event()

    def build():
        started.set()
        go_on.wait(10)
        return Thing(5)

    with ThreadPoolExecutor(1) as pool:
        promise = pool.submit(cache.get, "zone", build)
        started.wait(10)
        assert cache.drop() == 0
        go_on.set()
        assert promise.result(10) == (Thing(5), False)
    assert cache.state().nbytes == 5


def test_many_threads_leave_the_books_balanced(seed):
    cache = LruCache(max_bytes=100)

    def work(k):
        for step in range(200):
            key = (k * 31 + step * 17 + seed) % 23
            thing, _ = cache.get(key, lambda key=key: Thing(key + 1))
            assert thing.nbytes == key + 1
            if step % 50 == 49:
                cache.drop(lambda held: held == key)  # noqa: B023  used at once

    assert together(16, work) == [None] * 16
    state = cache.state()
    assert state.nbytes == sum(entry.thing.nbytes for entry in state.entries) <= 100
    assert state.hits + state.misses == 16 * 200


def test_every_key_is_dropped_without_a_choice():
    cache = LruCache(100)
    for key in range(3):
        cache.get(key, lambda: Thing(1))
    assert cache.drop() == 3
    assert cache.state().nbytes == 0


@pytest.mark.parametrize("kind", [KeyboardInterrupt, MemoryError])
def test_not_even_an_interruption_leaves_a_promise_behind(kind):
    cache = LruCache(100)

    def interrupted():
        raise kind

    with pytest.raises(kind):
        cache.get("zone", interrupted)
    assert cache.get("zone", lambda: Thing(1)) == (Thing(1), False)
