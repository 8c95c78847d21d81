"""The client: every part together, and its live events."""

from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing

import httpx

from ..encoding import Query, path_of
from ..errors import Busy, EventsLost
from ..event_lines import Block, BlockReader, Event
from ..operations import Access, Alarms, Calibrations, Runs
from ..retrying import Patience
from ..spacecraft import Gyro, Spacecraft
from .backend import sleep
from .batches import AsyncBatches
from .connection import AsyncConnection
from .replays import AsyncReplays

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


class AsyncClient(AsyncBatches, AsyncReplays, Runs, Access, Alarms, Calibrations, Spacecraft, Gyro):
    """A client of the service at an address; a context manager that closes its connections.

    `token` is sent with each request.  A request that may be sent twice is sent again after a
    lost connection, and where the service asks for it, until the service has not answered for
    `give_up_after_s`.  `timeout_s` is how long one attempt may wait for the next part of an
    answer.  `trust_env` uses the proxies that the environment names; `verify` is the context of
    TLS, or False to trust every certificate.

    Raises `InvalidArgument`, a `ValueError`, for an address or a token that is none; every method
    raises `NoAnswer` and the `Problem` of the service's answer.
    """

    def events(
        self, *, run: str | None = None, spacecraft: str | None = None, after: int | None = None
    ) -> AsyncEvents:
        """Live events from now on, or those after the event of that number.

        They are followed through lost connections and restarts of the service.  Raises
        `EventsLost` where the service no longer keeps all that were missed, `NoAnswer` where it
        does not come back for `give_up_after_s`.

        >>> async for event in client.events(after=0):
        ...     if event.kind == "batches":
        ...         print(event.id, event.data.latest.batch)
        ...         break
        1 1996-010-0110
        """
        return AsyncEvents(self, {"run": run, "spacecraft": spacecraft}, after)
