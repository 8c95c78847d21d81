"""The one cache, of whatever is expensive to build and can be built again.

Least recently used things go first when the bound in bytes is passed.
Concurrent requests for one key build it once: the others wait for the first.
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
"""A build may take many times the memory of its result."""


class Sized(Protocol):
    """Anything that knows how many bytes it holds."""

    @property
    def nbytes(self) -> int:
        """Bytes held in memory."""
        ...


T = TypeVar("T", bound=Sized)


class NotAtHand(Exception):
    """To get the thing would take long, and this caller must not wait."""


@dataclass
class CacheEntry(Generic[T]):
    """One cached thing, and its use so far."""

    key: Hashable
    thing: T
    build_us: int
    hits: int = 0


@dataclass(frozen=True)
class CacheState:
    """The state of a cache: its entries, least recently used first, and its counters."""

    entries: tuple[CacheEntry[Sized], ...]
    nbytes: int
    max_bytes: int
    hits: int
    misses: int
    evictions: int
    build_us: int


@dataclass
class LruCache:
    """A cache bounded in bytes; safe to use from many threads."""

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
        """The thing under `key`, built by `build` where it is missing, and whether it was there.

        An error of `build` reaches every waiting caller and leaves nothing behind.
        Where the thing is missing and `find_builder` gives a builder, the caller neither builds
        nor waits: that builder builds it, unless this is under way, and `BeingBuilt` is raised.
        Without `wait` what is missing is not built: `NotAtHand` is raised.
        """
        with self._lock:
            entry = self._entries.get(key)
            if entry is not None:
                self._entries.move_to_end(key)
                entry.hits += 1
                self._hits += 1
                # One cache holds things of several types; a key always names the same type.
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
        """Build a thing and keep the promise of it, which holds the error where there is one."""
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
        # The newest stays even where it alone passes the bound: it is in use.
        while self._nbytes > self.max_bytes and len(self._entries) > 1:
            _, oldest = self._entries.popitem(last=False)
            self._nbytes -= oldest.thing.nbytes
            self._evictions += 1

    def drop(self, chosen: Callable[[Hashable], bool] = lambda key: True) -> int:
        """Drop every entry whose key is chosen; how many there were."""
        with self._lock:
            keys = [key for key in self._entries if chosen(key)]
            for key in keys:
                self._nbytes -= self._entries.pop(key).thing.nbytes
        return len(keys)

    def state(self) -> CacheState:
        """The present state."""
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
