"""Live events, followed through lost connections and restarts of the service."""

from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing

import httpx

from ..encoding import Query, path_of
from ..errors import Busy, EventsLost
from ..event_lines import Block, BlockReader, Event
from ..retrying import Patience
from .backend import sleep
from .connection import AsyncConnection

SILENCE_S = 45.0
"""The service sends something every 15 seconds; without it the connection is lost."""


class AsyncEvents:
    """Live events: iterate over it.  No event is left out, and none comes twice.

    `last` is the number of the latest event that was handed out, or that the service says to be
    the latest; iterating again, or `events(after=last)` of another client, goes on after it.
    None: nothing was heard yet.
    """

    def __init__(self, connection: AsyncConnection, query: Query, after: int | None) -> None:
        self._connection, self._query = connection, query
        self.last = after

    async def __aiter__(self) -> AsyncIterator[Event]:
        patience = Patience(self._connection.give_up_after_s)
        while True:
            try:
                async with aclosing(self._blocks()) as blocks:
                    async for block in blocks:
                        patience.answered()
                        if (event := self._taken(block)) is not None:
                            patience.progressed()
                            yield event
                # The service ends every stream after a time, and when it stops.
                wait_s = patience.after_end()
            except Busy as problem:
                wait_s = patience.after_problem(problem)
            except httpx.RequestError as error:
                wait_s = patience.after_loss(error, self._connection.url)
            await sleep(wait_s)

    async def _blocks(self) -> AsyncGenerator[Block, None]:
        headers = {} if self.last is None else {"Last-Event-ID": str(self.last)}
        path, reader = path_of("events"), BlockReader()
        async with self._connection.stream(path, self._query, headers, SILENCE_S) as pieces:
            async for piece in pieces:
                for block in reader.feed(piece):
                    yield block

    def _taken(self, block: Block) -> Event | None:
        """The event of a block, which is not there for what only tells the place in the stream."""
        if block.kind == "reset" and block.id is not None:
            after, self.last = self.last, block.id
            raise EventsLost(after, block.id)
        if block.kind == "hello" or block.data is None:
            self.last = block.id if block.id is not None else self.last
            return None
        event = block.event()
        self.last = event.id
        return event
