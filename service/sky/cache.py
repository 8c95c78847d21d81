"""A memory cache for objects that are expensive to build and can be built again.

The least recently used entries are evicted first when the size limit is exceeded. Concurrent
requests for one key build it once: the others wait for the first.
"""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from service.errors import BeingBuilt

BUILDS_AT_ONCE = 2
"""Largest number of objects built at a time; each may take many times its result's memory."""


class Sized(Protocol):
    """The protocol of cached objects, which know their size in bytes."""

    @property
    def nbytes(self) -> int:
        """The size of the object in memory, in bytes."""
        ...


T = TypeVar("T", bound=Sized)


class NotAtHand(Exception):
    """An error: the item is not cached, and the caller must not wait for its build."""


@dataclass
class CacheEntry(Generic[T]):
    """One cached item, with the time of its build and its number of hits."""

    key: Hashable
    thing: T
    build_us: int
    hits: int = 0


@dataclass(frozen=True)
class CacheState:
    """A snapshot of a cache: its entries, least recently used first, and its counters."""

    entries: tuple[CacheEntry[Sized], ...]
    nbytes: int
    max_bytes: int
    hits: int
    misses: int
    evictions: int
    build_us: int


@dataclass
class LruCache:
    """A thread-safe cache of limited size that evicts the least recently used entries."""

    max_bytes: int
    _entries: "OrderedDict[Hashable, CacheEntry[Sized]]" = field(default_factory=OrderedDict)
    _building: "dict[Hashable, Future[Sized]]" = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _building_slots: threading.Semaphore = field(
        default_factory=lambda: threading.Semaphore(BUILDS_AT_ONCE)
    )
    _nbytes: int = 0
    _hits: int = 0
    _misses: int = 0
    _evictions: int = 0
    _build_us: int = 0

    def get(
        self,
        key: Hashable,
        build: Callable[[], T],
        find_builder: Callable[[], Executor | None] = lambda: None,
        wait: bool = True,
    ) -> tuple[T, bool]:
        """The item under `key`, built by `build` if missing, and true unless this call built it.

        An error of `build` is raised for every waiting caller, and nothing is cached. If the item
        is missing and `find_builder` returns a builder, the caller neither builds nor waits: that
        builder starts the build, unless one is running, and `BeingBuilt` is raised. Without `wait`
        a missing item is not built: `NotAtHand` is raised.
        """
        with self._lock:
            entry = self._entries.get(key)
            if entry is not None:
                self._entries.move_to_end(key)
                entry.hits += 1
                self._hits += 1
                # One cache holds items of several types; a key always has the same type.
                return entry.thing, True  # type: ignore[return-value]
            if not wait:
                raise NotAtHand
            promise = self._building.get(key)
            mine = promise is None
            if promise is None:
                promise = self._building[key] = Future()
                self._misses += 1
            else:
                self._hits += 1
        builder = find_builder()
        if mine and builder is None:
            self._build(key, build, promise)
            return promise.result(), False  # type: ignore[return-value]
        if mine and builder is not None:
            builder.submit(self._build, key, build, promise)
        if builder is not None:
            raise BeingBuilt(promise)
        return promise.result(), True  # type: ignore[return-value]

    def _build(self, key: Hashable, build: Callable[[], Sized], promise: "Future[Sized]") -> None:
        """Build an item and fulfil its promise, with the error if the build fails."""
        try:
            with self._building_slots:
                started = time.perf_counter_ns()
                thing = build()
        except BaseException as error:
            with self._lock:
                del self._building[key]
            promise.set_exception(error)
            return
        build_us = (time.perf_counter_ns() - started) // 1000
        with self._lock:
            del self._building[key]
            self._put(CacheEntry(key, thing, build_us))
        promise.set_result(thing)

    def _put(self, entry: CacheEntry[Sized]) -> None:
        self._entries[entry.key] = entry
        self._nbytes += entry.thing.nbytes
        self._build_us += entry.build_us
        # The newest entry stays even if it alone exceeds the limit, since it is in use.
        while self._nbytes > self.max_bytes and len(self._entries) > 1:
            _, oldest = self._entries.popitem(last=False)
            self._nbytes -= oldest.thing.nbytes
            self._evictions += 1

    def drop(self, chosen: Callable[[Hashable], bool] = lambda key: True) -> int:
        """Remove every entry whose key is chosen; returns the number removed."""
        with self._lock:
            keys = [key for key in self._entries if chosen(key)]
            for key in keys:
                self._nbytes -= self._entries.pop(key).thing.nbytes
        return len(keys)

    def state(self) -> CacheState:
        """A snapshot of the cache's entries and counters."""
        with self._lock:
            return CacheState(
                tuple(self._entries.values()),
                self._nbytes,
                self.max_bytes,
                self._hits,
                self._misses,
                self._evictions,
                self._build_us,
            )
