"""Distribution of recorded events to all listeners of event streams, without gaps.

One task reads new events, at once when they were recorded and every second, should another
process not have been heard.  The latest are held in memory; each listener takes them
at its own pace and, when it has fallen far behind, reads from the records.  So
there is no queue that a slow listener could fill.
"""

import asyncio
import logging
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from anyio import CapacityLimiter
from anyio.to_thread import run_sync

from service.access import Caller
from service.app.factory import App
from service.errors import Busy, RateLimited, Unauthenticated
from service.storage.recording.events import Event

HELD = 2_000
READ_AT_ONCE = 500
POLL_S = 1.0
GATHER_S = 0.05
"""Delay after a commit in seconds, so that many events are read at once under load."""
HEARTBEAT_S = 15.0
LONGEST_S = 900.0
"""Duration of one stream in seconds; the listener then connects and authenticates again."""
MAX_LISTENERS = 100
MAX_OF_ONE_TOKEN = 10
"""Greatest number of simultaneous event streams of one token, so that others have room."""
ADMITTED_EVERY_S = 1.0
"""Interval of checks in the database that listeners of events still have access, in seconds."""
RETRY_MS = 2_000

log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(eq=False)
class Listener:
    """A client of an event stream, with the token or session that it presented."""

    caller: Caller
    token: str | None = None
    session: str | None = None
    is_admitted: bool = True


class Live:
    """Reads recorded events and serves them to a bounded number of listeners."""

    def __init__(self, app: App) -> None:
        self._app = app
        self._held: deque[Event] = deque(maxlen=HELD)
        self._last = 0
        self._news = asyncio.Event()
        self._poke = asyncio.Event()
        self._tasks: list[asyncio.Task[None]] = []
        self._listeners: set[Listener] = set()
        self._stopping = False
        self._threads = CapacityLimiter(4)

    async def start(self) -> None:
        """Start the tasks that follow recorded events and end the streams of revoked listeners."""
        self._poke = self._app.store.writer.bell.subscribe()
        self._last = await self._read(self._app.events.last)
        self._tasks = [
            asyncio.create_task(each) for each in (self._follow(), self._end_what_is_revoked())
        ]

    def stop(self) -> None:
        """End all event streams, and refuse new ones."""
        self._stopping = True
        self._tell()

    async def close(self) -> None:
        """Stop following recorded events, and end all streams."""
        self.stop()
        if self._tasks:
            self._app.store.writer.bell.unsubscribe(self._poke)
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)

    async def stream(
        self, listener: Listener, last: int | None, run: str | None, spacecraft: str | None
    ) -> AsyncIterator[bytes]:
        """Events after `last`, or from now on, as lines of an event stream.

        "Now" is this call, before the head of the answer is sent: a listener that has the head
        misses nothing.  The stream ends when the listener's token or session does; the caller
        says when the listener has left.  Raises `RateLimited` where the token has as many
        streams as it may, `Busy` where there are too many of all.
        """
        if self._stopping:
            raise Busy("the service is stopping")
        token_id = listener.caller.token_id
        of_token = sum(each.caller.token_id == token_id for each in self._listeners)
        if token_id is not None and of_token >= MAX_OF_ONE_TOKEN:
            message = f"{listener.caller.name} has {of_token} event streams open; close one first"
            raise RateLimited(message, 30)
        if len(self._listeners) >= MAX_LISTENERS:
            raise Busy(f"{len(self._listeners)} event streams are open already", 30)
        self._listeners.add(listener)
        if last is not None:
            newest = last
        else:
            try:
                last = await self._read(self._app.events.last)
                # A bound token must not learn the number of events of other spacecraft.
                newest = await self._read(self._app.events.last, listener.caller.spacecraft)
            except BaseException:
                self.leave(listener)
                raise
        begin = f"retry: {RETRY_MS}\n\n".encode() + _line(newest, "hello", f'{{"last":{newest}}}')
        return self._lines(listener, begin, last, run, spacecraft)

    def leave(self, listener: Listener) -> None:
        """Remove a listener, which makes room for another."""
        self._listeners.discard(listener)

    async def _lines(
        self, listener: Listener, begin: bytes, last: int, run: str | None, spacecraft: str | None
    ) -> AsyncIterator[bytes]:
        clock = asyncio.get_running_loop().time
        end_s = clock() + LONGEST_S
        yield begin
        heard_s = clock()
        while not self._stopping and listener.is_admitted and clock() < end_s:
            news = self._news
            found = await self._after(last)
            if found is None:
                last = await self._read(self._app.events.last)
                yield _line(last, "reset", f'{{"last":{last}}}')
                continue
            if found:
                last = found[-1].id
                named = None if spacecraft is None else (spacecraft,)
                lines = b"".join(
                    _line(each.id, each.kind, each.data)
                    for each in found
                    if each.concerns(run, named)
                )
                if lines:
                    heard_s = clock()
                    yield lines
                continue
            if clock() - heard_s >= HEARTBEAT_S:
                # Send the number alone: the listener reconnects from it, and receives no event.
                heard_s = clock()
                yield f": {HEARTBEAT_S:g} s without news\nid: {last}\n\n".encode()
            wait_s = min(heard_s + HEARTBEAT_S, end_s) - clock()
            try:
                async with asyncio.timeout(max(wait_s, 0.0)):
                    await news.wait()
            except TimeoutError:
                pass

    async def _after(self, last: int) -> Sequence[Event] | None:
        if last == self._last:
            return []
        if self._held and self._held[0].id <= last + 1 and last <= self._last:
            return [event for event in self._held if event.id > last]
        return await self._read(self._app.events.after, last, READ_AT_ONCE)

    async def _follow(self) -> None:
        while True:
            try:
                async with asyncio.timeout(POLL_S):
                    await self._poke.wait()
                await asyncio.sleep(GATHER_S)
            except TimeoutError:
                pass
            self._poke.clear()
            try:
                await self._take()
            except Exception as error:
                # The database is unavailable for a while: nothing is lost, events are sent later.
                log.warning("events could not be read: %s", error)

    async def _end_what_is_revoked(self) -> None:
        """End the streams of revoked or expired tokens and sessions."""
        while True:
            await asyncio.sleep(ADMITTED_EVERY_S)
            asked = {(each.token, each.session) for each in self._listeners}
            for token, session in asked:
                try:
                    await run_sync(
                        self._app.access.look_up_again, token, session, limiter=self._threads
                    )
                except Unauthenticated:
                    for each in self._listeners:
                        if (each.token, each.session) == (token, session):
                            each.is_admitted = False
                    self._tell()
                except Exception as error:
                    # While the database is unavailable, no listener can be checked.
                    log.warning("listeners could not be looked up: %s", error)
                    break

    async def _take(self) -> None:
        while found := await self._read(self._app.events.after, self._last, READ_AT_ONCE):
            self._held.extend(found)
            self._last = found[-1].id
            self._tell()
        if found is None:
            self._held.clear()
            self._last = await self._read(self._app.events.last)
            self._tell()

    def _tell(self) -> None:
        self._news.set()
        self._news = asyncio.Event()

    async def _read(self, ask: Callable[..., T], *arguments: object) -> T:
        return await run_sync(ask, *arguments, limiter=self._threads)


def _line(id: int, kind: str, data: str) -> bytes:
    return f"id: {id}\nevent: {kind}\ndata: {data}\n\n".encode()
