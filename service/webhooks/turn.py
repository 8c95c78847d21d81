"""Whether this process delivers, where several share a database; see `storage.webhooks.sender`."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from functools import partial
from typing import TypeVar

from service.storage.store import Store
from service.storage.webhooks.deliveries import hold_sender, read_sender

BEAT_S = 3.0
FRESH_S = 8.0
"""No attempt is begun when the last beat is older; one takes ten seconds at most."""
TAKE_OVER_S = 20.0
"""So that the last attempt of a process that stood still is over before another one begins."""

T = TypeVar("T")
Read = Callable[[Callable[[], tuple[str | None, int]]], Awaitable[tuple[str | None, int]]]


class Turn:
    """The claim of one process to deliver."""

    def __init__(self, store: Store, name: str) -> None:
        self._store = store
        self._name = name
        self._is_held = False
        self._beat = -1
        self._seen_s = 0.0
        self._beaten_s = 0.0

    @property
    def is_fresh(self) -> bool:
        """Whether this process delivers, and no other can do so within the next seconds."""
        return self._is_held and time.monotonic() - self._beaten_s < FRESH_S

    async def take(self, read: Read) -> bool:
        """Whether this process delivers now; call it at least every few seconds."""
        now_s = time.monotonic()
        if self._is_held:
            if now_s - self._beaten_s >= BEAT_S:
                self._is_held = await self._hold(self._name)
            return self._is_held
        holder, beat = await read(self._read)
        if beat != self._beat:
            self._beat, self._seen_s = beat, now_s
        if holder in (None, self._name) or now_s - self._seen_s >= TAKE_OVER_S:
            self._is_held = await self._hold(self._name)
        return self._is_held

    async def give_up(self) -> None:
        """Let another process deliver at once."""
        if self._is_held:
            self._is_held = False
            await self._hold(None)

    async def _hold(self, name: str | None) -> bool:
        asked_s = time.monotonic()
        change = partial(hold_sender, holder=name, beat=self._beat)
        if not await asyncio.wrap_future(self._store.writer.change(change)):
            return False
        self._beat += 1
        self._beaten_s = asked_s
        return True

    def _read(self) -> tuple[str | None, int]:
        with self._store.reading_record() as connection:
            return read_sender(connection)
