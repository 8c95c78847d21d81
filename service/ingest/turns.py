"""Turns of tracked batches: of each spacecraft and run one at a time, the earliest first."""

import heapq
from collections.abc import Hashable
from itertools import count
from typing import Generic, TypeVar

T = TypeVar("T")


class Turns(Generic[T]):
    """Those of one key that wait while another of it is at work.  The caller holds a lock."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, list[tuple[int, int, T]]] = {}
        """Of each key that has one at work: the time of a batch, a number, the batch."""
        self._numbers = count()

    def enter(self, key: Hashable, time_ns: int, item: T) -> bool:
        """Whether it may begin; if not, `leave` gives it when its turn has come."""
        waiting = self._waiting.get(key)
        if waiting is None:
            self._waiting[key] = []
            return True
        heapq.heappush(waiting, (time_ns, next(self._numbers), item))
        return False

    def leave(self, key: Hashable) -> T | None:
        """The next of a key, whose last one is done; None where none waits."""
        waiting = self._waiting[key]
        if waiting:
            return heapq.heappop(waiting)[2]
        del self._waiting[key]
        return None
