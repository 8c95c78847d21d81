"""Functions that differ between waiting in an event loop and in a thread: for a thread."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeAlias, TypeVar

T = TypeVar("T")
R = TypeVar("R")

Source: TypeAlias = Iterable[T]

sleep = time.sleep
iterated = iter


def bounded_map(function: Callable[[T], R], source: Source[T], at_once: int) -> Iterator[R]:
    """Apply a function to each item, at most `at_once` at a time; results in order.

    An item is taken from the source only when there is room for it.
    """
    window: deque[Future[R]] = deque()
    pool = ThreadPoolExecutor(at_once, thread_name_prefix="acquire-client")
    try:
        for item in source:
            window.append(pool.submit(function, item))
            while window and (len(window) >= at_once or window[0].done()):
                yield window.popleft().result()
        while window:
            yield window.popleft().result()
    finally:
        # Wait for requests in progress; do not start the others.
        pool.shutdown(cancel_futures=True)
