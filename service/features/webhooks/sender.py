"""Delivery of recorded events to webhooks, in a thread with its own event loop.

Every second, and after each commit, new events are queued for the webhooks that want them, and due
queues are delivered, a few per webhook at a time.  A queue has the events of one spacecraft for one
webhook: a failure there delays nothing else.  The thread does not block the service's event loop or
its writer.
"""

import asyncio
import logging
import random
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from sqlalchemy import Connection

from service.errors import Busy, Stopping
from service.features.webhooks import messages
from service.features.webhooks import records as webhooks
from service.features.webhooks.records import Attempt, Queue, Registered, Waiting
from service.settings import Network
from service.storage.recording.events import Event, events_after, first_event, last_event
from service.storage.recording.ids import unguessable_ulid
from service.storage.store import Store
from service.times import DAY_S, recorded_utc, shifted, utc_now

if TYPE_CHECKING:
    from service.features.webhooks.posts import Poster

log = logging.getLogger(__name__)

POLL_S = 1.0
GATHER_S = 0.2
"""Delay after a commit in seconds, so that many events are queued at once under load."""
PARALLEL = 4
"""Greatest number of parallel attempts for one webhook."""
READ_AT_ONCE = 500
DELIVERED_AT_ONCE = 20
"""Number of delivered events recorded in one transaction."""
NOTED_AFTER_S = 2.0
MAX_WAITING = 50_000
"""Greatest number of queued events of a webhook; later ones wait in the event list."""
DEAD_AFTER_S = DAY_S
FIRST_DELAY_S, LAST_DELAY_S = 5.0, 3600.0
JITTER = 0.2
NOTE_AGAIN_S = 1.0
"""Delay in seconds before recording an outcome again, after the writer was busy."""
STOP_S = 2.0
"""Seconds that attempts in progress may take when the service stops."""
MAX_TESTS = 4
LISTED_FOR_S = 5.0
"""Greatest age in seconds of the list of webhooks used: a token may have been revoked."""

T = TypeVar("T")


def retry_delay_s(attempts: int, share: float) -> float:
    """Delay in seconds after failed attempts: 5 s, doubled up to an hour, and a random part.

    `share` is a random number from 0 to 1, for an additional delay of up to a fifth.
    """
    doubled = FIRST_DELAY_S * 2.0 ** min(attempts - 1, 20)
    return min(doubled, LAST_DELAY_S) * (1.0 + JITTER * share)


class WebhookSender:
    """Delivers events to webhooks, from `start` to `stop`."""

    def __init__(
        self, store: Store, allowed: Sequence[Network], is_open: Callable[[], bool]
    ) -> None:
        """Prepare a sender; `allowed` are networks that webhooks may reach though not public.

        `is_open` is true if access is open, so that a webhook needs no token.
        """
        self._store = store
        self._allowed = allowed
        self._is_open = is_open
        self._turn = Turn(store, unguessable_ulid())
        self._webhooks: dict[str, Registered] = {}
        self._listed_s = -LISTED_FOR_S
        self._changes = 0
        self._positions: dict[str, int] = {}
        self._is_stopping = False
        self._under_way: dict[Queue, asyncio.Task[None]] = {}
        self._tests = threading.BoundedSemaphore(MAX_TESTS)
        self._readers = ThreadPoolExecutor(2, "webhook-reader")
        self._poster: Poster | None = None
        self._started = threading.Event()
        self._thread: threading.Thread | None = None
        self.log = messages.DeliveryLog()

    def start(self) -> None:
        """Start the delivery thread, unless it runs."""
        if self._thread is not None:
            return
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._main()), name="webhooks", daemon=True
        )
        self._thread.start()
        self._started.wait()

    def stop(self) -> None:
        """Stop the thread; attempts in progress get a short time, and their success is recorded."""
        if self._thread is None:
            return
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join()
        self._thread = None
        self._readers.shutdown(wait=False)

    def changed(self) -> None:
        """Reload the webhooks before the next delivery, after one was added, changed or deleted."""
        self._changes += 1
        self._listed_s = -LISTED_FOR_S
        if self._thread is not None:
            self._poke()

    def try_out(self, webhook: Registered) -> tuple[str, messages.Outcome]:
        """Send a test event and wait; returns its message id and the outcome.

        Raises `Busy` during too many tests, or if this process does not deliver.
        """
        if self._thread is None:
            raise Busy("webhooks are not delivered by this process now")
        if not self._tests.acquire(blocking=False):
            raise Busy(f"{MAX_TESTS} tests of webhooks are under way", int(messages.TOTAL_S))
        id, body = messages.test_message(webhook.id, utc_now().text)
        sending = self._post(webhook, id, body)
        try:
            return id, asyncio.run_coroutine_threadsafe(sending, self._loop).result()
        except CancelledError:
            raise Busy("the service is stopping") from None
        finally:
            self._tests.release()

    # ---- the sender's thread -----------------------------------------------------------------

    async def _main(self) -> None:
        self._loop, self._news = asyncio.get_running_loop(), self._store.writer.bell.subscribe()
        task = asyncio.current_task()
        assert task is not None
        self._task = task
        self._started.set()
        try:
            with suppress(asyncio.CancelledError):
                await self._go_on()
        finally:
            self._store.writer.bell.unsubscribe(self._news)
            self._is_stopping = True
            under_way = list(self._under_way.values())
            if under_way:
                await asyncio.wait(under_way, timeout=STOP_S)
            for each in under_way:
                each.cancel()
            await asyncio.gather(*under_way, return_exceptions=True)
            with suppress(Exception):
                await self._turn.give_up()
            if self._poster is not None:
                await self._poster.close()

    async def _go_on(self) -> None:
        while True:
            self._news.clear()
            try:
                await self._round()
            except Exception as error:
                # The database is unavailable: nothing is lost, events are delivered later.
                log.warning("webhooks are not delivered: %s", error)
                await asyncio.sleep(POLL_S)
            with suppress(TimeoutError):
                async with asyncio.timeout(POLL_S):
                    await self._news.wait()
                    await asyncio.sleep(GATHER_S)

    def _poke(self) -> None:
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._news.set)

    async def _round(self) -> None:
        now_s = time.monotonic()
        if now_s - self._listed_s >= POLL_S:
            changes = self._changes
            known = await self._read(self._list)
            self._webhooks = {webhook.id: webhook for webhook in known}
            self.log.listed(known)
            # The list may lack changes made while it was read.
            self._listed_s = now_s if changes == self._changes else -LISTED_FOR_S
        if not self._store.is_projecting:
            # Another service delivers.
            await self._turn.give_up()
            return
        if not self._webhooks or not await self._turn.take(self._read):
            return
        active = [each for each in self._webhooks.values() if each.state == "active"]
        if active:
            last, waiting = await self._read(self._last_and_waiting)
            for webhook in active:
                await self._queue_news(webhook, last, MAX_WAITING - waiting.get(webhook.id, 0))
            await self._begin_due()

    async def _queue_news(self, webhook: Registered, last: int, room: int) -> None:
        """Queue the events up to `last` that a webhook wants, while its queue has room."""
        position = self._positions.get(webhook.id, webhook.position)
        # `position` is beyond `last` if events were recorded after `last` was read.
        while position < last and room > 0:
            found, missed = await self._read(self._after, position)
            now = utc_now().text
            wanted = [event for event in found if messages.wants(webhook, event)]
            rows = [messages.delivery_row(webhook.id, event, now) for event in wanted]
            after = found[-1].id if found else last
            if missed:
                log.warning("webhook %s misses %d events that were deleted", webhook.id, missed)
            move = partial(
                webhooks.queue_events,
                id=webhook.id,
                before=position,
                after=after,
                missed=missed,
                rows=rows,
            )
            if not await self._change(move):
                # The position was moved or the webhook deleted elsewhere: that state is valid.
                self._positions.pop(webhook.id, None)
                self.changed()
                return
            self._positions[webhook.id] = position = after
            room -= len(rows)

    async def _begin_due(self) -> None:
        now = utc_now().text
        counts = Counter(queue.webhook_id for queue in self._under_way)
        for queue, due in await self._read(self._heads):
            if due > now:
                break
            if queue in self._under_way or counts[queue.webhook_id] >= PARALLEL:
                continue
            if self._receiver(queue.webhook_id) is not None:
                counts[queue.webhook_id] += 1
                self._under_way[queue] = asyncio.create_task(self._work_through(queue))

    def _receiver(self, webhook_id: str) -> Registered | None:
        """The webhook, if this process may send to it now; otherwise None."""
        webhook = self._webhooks.get(webhook_id)
        is_listed = time.monotonic() - self._listed_s < LISTED_FOR_S
        if webhook is None or webhook.state != "active":
            return None
        if self._is_stopping or not self._turn.is_fresh:
            return None
        is_held = webhook.held_until is not None and utc_now().text < webhook.held_until
        return webhook if is_listed and not is_held else None

    async def _work_through(self, queue: Queue) -> None:
        """Deliver the first events of a queue in order, until one fails."""
        try:
            await self._deliver(queue)
        except Exception as error:
            # An error of one receiver must not end the task of all; its events are tried again.
            log.warning("the deliveries of a webhook were interrupted: %s", error)
        else:
            self._poke()
        finally:
            del self._under_way[queue]

    async def _deliver(self, queue: Queue) -> None:
        begun_s = time.monotonic()
        done: list[int] = []
        failed, outcome, receiver = None, None, None
        try:
            for waiting in await self._read(self._next_of, queue):
                webhook = self._receiver(queue.webhook_id)
                if webhook is None:
                    break
                receiver = webhook
                outcome = await self._post(webhook, waiting.message_id, waiting.body.encode())
                if not outcome.delivered:
                    failed = waiting
                    break
                done.append(waiting.event_id)
                if time.monotonic() - begun_s >= NOTED_AFTER_S:
                    break
        finally:
            # Recorded even if the service stops meanwhile.
            if receiver is not None and outcome is not None:
                attempt = self._attempt(receiver, queue, done, failed, outcome)
                await self._note(attempt)
                if attempt.gone or attempt.held_until is not None:
                    self.changed()

    async def _note(self, attempt: Attempt) -> None:
        """Record the result of attempts; the queue waits, so that nothing is sent twice."""
        while True:
            try:
                return await self._change(partial(webhooks.settle, attempt=attempt))
            except Busy as error:
                if self._is_stopping or isinstance(error, Stopping):
                    raise
                log.warning("deliveries of a webhook cannot be noted yet: %s", error)
            await asyncio.sleep(NOTE_AGAIN_S)

    async def _post(self, webhook: Registered, message_id: str, body: bytes) -> messages.Outcome:
        now, unix_s = utc_now().text, int(time.time())
        headers = messages.signed_headers(webhook.secrets(now), message_id, unix_s, body)
        if self._poster is None:
            # Late import: httpx, and the certificates of all authorities, take a while to load.
            from service.features.webhooks.posts import Poster

            self._poster = Poster(self._allowed)
        return await self._poster.post(webhook.url, headers, body)

    def _attempt(
        self,
        webhook: Registered,
        queue: Queue,
        done: Sequence[int],
        failed: Waiting | None,
        outcome: messages.Outcome,
    ) -> Attempt:
        now = utc_now()
        self.log.delivered(webhook, len(done))
        if failed is None:
            return Attempt(queue, now.text, done, status=outcome.status)
        end = shifted(recorded_utc(failed.queued), DEAD_AFTER_S).text
        is_dead = end <= now.text and outcome.status != messages.GONE
        self.log.failed(webhook, failed.event_id, outcome.fault, is_dead)
        asked_s = min(outcome.retry_after_s or 0.0, DEAD_AFTER_S)
        delay_s = max(retry_delay_s(failed.attempts + 1, random.random()), asked_s)
        holds = asked_s > 0 and outcome.status in (messages.TOO_MANY, messages.UNAVAILABLE)
        return Attempt(
            queue,
            now.text,
            done,
            failed,
            due=None if is_dead else min(shifted(now, delay_s).text, max(end, now.text)),
            status=outcome.status,
            fault=outcome.fault,
            held_until=shifted(now, asked_s).text if holds else None,
            gone=outcome.status == messages.GONE,
        )

    # ---- the records -------------------------------------------------------------------------

    async def _read(self, ask: Callable[..., T], *arguments: Any) -> T:
        return await self._loop.run_in_executor(self._readers, ask, *arguments)

    async def _change(self, change: Callable[[Connection], T]) -> T:
        return await asyncio.to_thread(self._store.writer.change, change)

    def _list(self) -> Sequence[Registered]:
        with self._store.reading_record() as connection:
            if not webhooks.count_webhooks(connection):
                return ()
        is_open = self._is_open()
        with self._store.reading_record() as connection:
            return webhooks.registered_webhooks(connection, utc_now().text, is_open)

    def _last_and_waiting(self) -> tuple[int, dict[str, int]]:
        with self._store.reading_record() as connection:
            return last_event(connection), webhooks.count_waiting(connection)

    def _after(self, position: int) -> tuple[Sequence[Event], int]:
        """Next stored events after a position, and the number of deleted ones before them."""
        with self._store.reading_record() as connection:
            found = events_after(connection, position, READ_AT_ONCE)
            if found is not None:
                return found, 0
            first = first_event(connection)
            if first is None or first <= position:
                return (), 0
            kept = events_after(connection, first - 1, READ_AT_ONCE)
            return kept or (), first - 1 - position

    def _heads(self) -> list[tuple[Queue, str]]:
        with self._store.reading_record() as connection:
            return webhooks.heads(connection)

    def _next_of(self, queue: Queue) -> list[Waiting]:
        with self._store.reading_record() as connection:
            return webhooks.next_of(connection, queue, DELIVERED_AT_ONCE)


BEAT_S = 3.0
FRESH_S = 8.0
"""Greatest age in seconds of the last heartbeat for a new attempt, which takes at most 10 s."""
TAKE_OVER_S = 20.0
"""Seconds without a heartbeat after which another process takes over, and attempts have ended."""

Read = Callable[[Callable[[], tuple[str | None, int]]], Awaitable[tuple[str | None, int]]]


class Turn:
    """Claim of one process to deliver events, kept by heartbeats in the database."""

    def __init__(self, store: Store, name: str) -> None:
        self._store = store
        self._name = name
        self._is_held = False
        self._beat = -1
        self._seen_s = 0.0
        self._beaten_s = 0.0

    @property
    def is_fresh(self) -> bool:
        """True if this process holds the claim, and no other can take over within seconds."""
        return self._is_held and time.monotonic() - self._beaten_s < FRESH_S

    async def take(self, read: Read) -> bool:
        """Take or renew the claim; True if this process delivers.  Call every few seconds."""
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
        """Release the claim, so that another process can deliver at once."""
        if self._is_held:
            self._is_held = False
            await self._hold(None)

    async def _hold(self, name: str | None) -> bool:
        asked_s = time.monotonic()
        change = partial(webhooks.hold_sender, holder=name, beat=self._beat)
        if not await asyncio.to_thread(self._store.writer.change, change):
            return False
        self._beat += 1
        self._beaten_s = asked_s
        return True

    def _read(self) -> tuple[str | None, int]:
        with self._store.reading_record() as connection:
            return webhooks.read_sender(connection)
