"""Functions that differ between waiting in an event loop and in a thread: for an event loop."""

import asyncio
from collections import deque
from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable, Iterable
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")

Source = Iterable[T] | AsyncIterable[T]

sleep = asyncio.sleep


async def iterated(source: Source[T]) -> AsyncIterator[T]:
    """Iterate over the items of an asynchronous or a plain source."""
    if isinstance(source, AsyncIterable):
        async for item in source:
            yield item
    else:
        for item in source:
            yield item


async def bounded_map(
    function: Callable[[T], Awaitable[R]], source: Source[T], at_once: int
) -> AsyncIterator[R]:
    """Apply a function to each item, at most `at_once` at a time; results in order.

    An item is taken from the source only when there is room for it.
    """

    async def result(item: T) -> R:
        return await function(item)

    window: deque[asyncio.Task[R]] = deque()
    try:
        async for item in iterated(source):
            window.append(asyncio.create_task(result(item)))
            while window and (len(window) >= at_once or window[0].done()):
                yield await window.popleft()
        while window:
            yield await window.popleft()
    finally:
        for task in window:
            task.cancel()
        await asyncio.gather(*window, return_exceptions=True)
