"""Follower of a message stream: submits the messages of a durable NATS JetStream consumer.

    stream ──► consumer ──► follower ──► service ──► committed ──► acknowledged
                               └──► refused: subject of refusals, and terminated

A message is a batch or a gyro block, as JSON.  It is acknowledged after the service has committed
it; one that is delivered again, because a follower ended in between, gets the stored answer.
Several followers of one consumer share its messages: the distributed queue is that of NATS.

A `Submit` hands a message over: `over_http` to a service that listens somewhere,
`service.web.own_follower` to the service that the follower runs in.
"""

import asyncio
import json
import logging
import ssl
import time
from collections import Counter as Counts
from collections.abc import Awaitable, Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error as NatsError
from nats.errors import MaxPayloadError
from nats.errors import TimeoutError as NatsTimeout
from nats.js import JetStreamContext
from nats.js.api import AckPolicy, ConsumerConfig, ConsumerInfo
from nats.js.errors import APIError, NoStreamResponseError, NotFoundError
from prometheus_client import CollectorRegistry, Counter, Gauge

from service.errors import AcquisitionError, BadConfiguration
from service.features.follow.source import Source
from service.gyro.blocks import is_gyro_line

ACK_WAIT_S = 30.0
"""Seconds without a sign of life after which NATS delivers a message to another follower."""
BEAT_S = 10.0
PAUSE_S = 1
BEGIN_AGAIN_S = 5.0
TRIES = 5
"""Number of times that the service fails at a message before the follower refuses it."""
UNKEPT_S = 60.0
"""Seconds before a follower asks again whether a stream keeps a subject."""
MESSAGE_TOO_LARGE = 10_054
"""NATS error code for a message larger than a stream accepts."""
SEQUENCE, DELIVERED = "Acquire-Sequence", "Acquire-Delivered"
"""Headers of refusals and answers: the message's number in its stream, and its deliveries."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Answer:
    """Answer of the service to a recorded message."""

    body: bytes
    is_repeated: bool
    """True if the message was already recorded before."""


Submit = Callable[[bytes], Awaitable[Answer]]
"""Function that submits a message, and waits until it is recorded.

Raises `NotNow`, `Refused`, or another exception that concerns no single message.
"""


class NotNow(Exception):
    """Raised if the service accepts no message now; a later attempt may succeed."""


class Refused(Exception):
    """Raised if the service refuses a message, or fails at it."""

    def __init__(self, problem: Mapping[str, Any], has_failed: bool) -> None:
        """Keep the problem; `has_failed`: the service is at fault, another attempt may succeed."""
        super().__init__(problem["detail"])
        self.problem, self.has_failed = problem, has_failed


class Metrics:
    """Counters of a follower, for Prometheus and for its summary."""

    def __init__(self, registry: CollectorRegistry | None = None) -> None:
        """Create the counters in `registry`, or in a new one."""
        self.registry = CollectorRegistry() if registry is None else registry
        self._messages = Counter(
            "starid_follow_messages",
            "Messages of the stream by what came of them: recorded, repeated or refused.",
            ["outcome"],
            registry=self.registry,
        )
        self._redelivered = Counter(
            "starid_follow_redelivered",
            "Messages that had been delivered before.",
            registry=self.registry,
        )
        self._lag = Gauge(
            "starid_follow_lag",
            "Messages of the stream that the consumer has not delivered yet.",
            registry=self.registry,
        )
        self.counts = dict.fromkeys(("recorded", "repeated", "refused", "redelivered"), 0)
        self.lag = 0

    def count(self, outcome: str) -> None:
        """Count a finished message by its outcome."""
        self.counts[outcome] += 1
        self._messages.labels(outcome).inc()

    def count_redelivered(self) -> None:
        """Count a message that was delivered before."""
        self.counts["redelivered"] += 1
        self._redelivered.inc()

    def set_lag(self, pending: int) -> None:
        """Record the number of messages that the consumer has still to deliver."""
        self.lag = pending
        self._lag.set(pending)


class Follower:
    """Submits messages of a stream until stopped; unfinished ones go to another follower."""

    def __init__(
        self,
        source: Source,
        submit: Submit,
        metrics: Metrics,
        progress: Callable[[Metrics], object] = lambda metrics: None,
    ) -> None:
        """Prepare to follow a stream; `progress` is called with the counters every few seconds."""
        self._source, self._submit = source, submit
        self._metrics, self._progress = metrics, progress
        self._stopped = asyncio.Event()
        self._is_service_busy = False
        self._failures: Counts[int] = Counts()
        """Number of failed attempts by message, identified by its place in the stream."""
        self._unkept_until_s: dict[str, float] = {}
        """Subjects that no stream keeps, and the time of the next check."""

    def stop(self) -> None:
        """Take no more messages, and end after those in progress."""
        self._stopped.set()

    async def run(self, until_empty: bool = False) -> None:
        """Follow the stream; with `until_empty`, until nothing is left to deliver.

        Raises `BadConfiguration` if NATS has no such stream or refuses the connection, and
        exceptions of `submit` that concern no single message.
        """
        connection = await self._connected()
        if connection is None:
            return
        self._connection = connection
        self._failures.clear()
        try:
            stream = connection.jetstream()
            await self._require_consumer(stream)
            subscription = await stream.pull_subscribe_bind(
                consumer=self._source.consumer, stream=self._source.stream
            )
            beside = asyncio.create_task(self._report(stream))
            try:
                while not self._stopped.is_set():
                    try:
                        fetched = await subscription.fetch(self._source.concurrency, timeout=1.0)
                    except TimeoutError:
                        if await self._is_empty(stream) and until_empty:
                            return
                        continue
                    except NatsError as error:
                        log.warning("no messages come now: %s", error)
                        await asyncio.sleep(PAUSE_S)
                        continue
                    async with asyncio.TaskGroup() as tasks:
                        for message in fetched:
                            tasks.create_task(self._take(stream, message))
            finally:
                beside.cancel()
        finally:
            with suppress(NatsError, OSError, TimeoutError):
                # The client may not have sent the last acknowledgements yet.
                await connection.flush(timeout=5)
            await connection.close()

    async def keep_running(self) -> None:
        """Follow the stream until stopped; start again a few seconds after a failure."""
        while not self._stopped.is_set():
            try:
                await self.run()
            except (AcquisitionError, NatsError, OSError) as error:
                log.warning("the stream is not followed now: %s", error)
            except Exception:
                log.exception("the follower failed; it begins again")
            with suppress(TimeoutError):
                await asyncio.wait_for(self._stopped.wait(), BEGIN_AGAIN_S)

    async def _connected(self) -> Client | None:
        """Connection to NATS; None if the follower was stopped before NATS answered."""
        source = self._source

        async def note(error: Exception) -> None:
            log.warning("NATS: %s", error)

        connection, context = Client(), None
        try:
            if source.authority is not None or source.servers.startswith("tls://"):
                connection = _TlsClient()
                context = ssl.create_default_context(cafile=source.authority)
            connecting = asyncio.create_task(
                connection.connect(
                    source.servers,
                    name=f"acquire follow {source.consumer}",
                    user_credentials=source.credentials and str(source.credentials),
                    tls=context,
                    max_reconnect_attempts=-1,
                    reconnect_time_wait=PAUSE_S,
                    error_cb=note,
                    connect_timeout=5,
                )
            )
            stopping = asyncio.create_task(self._stopped.wait())
            await asyncio.wait({connecting, stopping}, return_when=asyncio.FIRST_COMPLETED)
            stopping.cancel()
            if connecting.done():
                connecting.result()
                return connection
            connecting.cancel()
            with suppress(asyncio.CancelledError):
                await connecting
            await connection.close()
            return None
        except (NatsError, OSError) as error:
            raise BadConfiguration(f"{source.shown}: NATS cannot be reached: {error}") from None

    async def _require_consumer(self, stream: JetStreamContext) -> None:
        """Create the durable consumer if the stream does not have it.

        Raises `BadConfiguration` if JetStream does not answer, if there is no such stream, and if
        the consumer would deliver the follower's own answers or refusals to it.
        """
        source = self._source
        try:
            kept = (await stream.stream_info(source.stream)).config.subjects or ()
            with suppress(NotFoundError):
                found = await stream.consumer_info(source.stream, source.consumer)
                self._refuse_own_output(kept, found.config)
                return
            config = ConsumerConfig(
                durable_name=source.consumer, ack_policy=AckPolicy.EXPLICIT, ack_wait=ACK_WAIT_S
            )
            self._refuse_own_output(kept, config)
            await stream.add_consumer(source.stream, config)
        except NotFoundError:
            raise BadConfiguration(f"{source.shown}: NATS has no stream {source.stream}") from None
        except NatsError as error:
            raise BadConfiguration(f"{source.shown}: JetStream cannot be used: {error}") from None

    def _refuse_own_output(self, kept: Iterable[str], consumer: ConsumerConfig) -> None:
        """Raise `BadConfiguration` if the consumer would deliver answers or refusals."""
        source, one = self._source, consumer.filter_subject
        delivered = [one] if one else consumer.filter_subjects or [">"]
        for subject in (source.refusals, source.answers):
            if subject and _covers(kept, subject) and _covers(delivered, subject):
                raise BadConfiguration(
                    f"{source.shown}: the stream {source.stream} keeps {subject}, "
                    "which the follower publishes to: it would follow its own messages"
                )

    async def _is_empty(self, stream: JetStreamContext) -> bool:
        """True if every message of the stream is settled; creates a deleted consumer again."""
        try:
            info = await stream.consumer_info(self._source.stream, self._source.consumer)
        except NotFoundError:
            log.warning("NATS has lost the consumer %s: it is made again", self._source.consumer)
            await self._require_consumer(stream)
            return False
        except NatsError as error:
            log.warning("NATS does not say what is left: %s", error)
            return False
        return not info.num_pending and not info.num_ack_pending

    async def _report(self, stream: JetStreamContext) -> None:
        while True:
            with suppress(NatsError, TimeoutError):
                info = await stream.consumer_info(self._source.stream, self._source.consumer)
                self._metrics.set_lag(info.num_pending or 0)
                self._forget_failures(info)
            self._progress(self._metrics)
            await asyncio.sleep(5.0)

    def _forget_failures(self, info: ConsumerInfo) -> None:
        """Drop failure counts of messages that another follower has settled."""
        floor = info.ack_floor.stream_seq if info.ack_floor else 0
        for place in [place for place in self._failures if place <= floor]:
            del self._failures[place]

    # ---- one message -------------------------------------------------------------------------

    async def _take(self, stream: JetStreamContext, message: Msg) -> None:
        if message.metadata.num_delivered > 1:
            self._metrics.count_redelivered()
        beat = asyncio.create_task(self._keep(message))
        try:
            await self._settle(stream, message)
        except NatsError as error:
            # NATS delivers the message again, which is then found to be recorded.
            log.warning("message %d is not settled: %s", message.metadata.sequence.stream, error)
        finally:
            beat.cancel()

    async def _keep(self, message: Msg) -> None:
        """Keep NATS from delivering a message again while the service processes it."""
        while True:
            await asyncio.sleep(BEAT_S)
            with suppress(NatsError):
                await message.in_progress()

    async def _settle(self, stream: JetStreamContext, message: Msg) -> None:
        place = message.metadata.sequence.stream
        while not self._stopped.is_set():
            try:
                answer = await self._submit(message.data)
            except NotNow as error:
                if not self._is_service_busy:
                    log.warning("the service does not take messages now: %s", error)
                self._is_service_busy = True
                await asyncio.sleep(PAUSE_S)
            except Refused as refused:
                self._is_service_busy = False
                if refused.has_failed:
                    self._failures[place] += 1
                    if self._failures[place] < TRIES:
                        await message.nak(PAUSE_S)
                        return
                problem = json.dumps(refused.problem).encode()
                await self._publish(stream, self._source.refusals, message, problem)
                await message.term()
                self._failures.pop(place, None)
                self._metrics.count("refused")
                return
            except Exception:
                # The problem is, for example, the token's, not the message's: others may try it.
                await message.nak()
                raise
            else:
                self._is_service_busy = False
                if self._source.answers is not None:
                    await self._publish(stream, self._source.answers, message, answer.body)
                await message.ack()
                self._failures.pop(place, None)
                self._metrics.count("repeated" if answer.is_repeated else "recorded")
                return
        await message.nak()

    async def _publish(
        self, stream: JetStreamContext, subject: str, message: Msg, body: bytes
    ) -> None:
        """Publish an answer or refusal; a stream that keeps the subject stores it once.

        A message that is too large for NATS is logged and not published.
        """
        place = message.metadata
        headers = {
            "Nats-Msg-Id": f"{place.stream}-{place.sequence.stream}-{subject}",
            SEQUENCE: str(place.sequence.stream),
            DELIVERED: str(place.num_delivered),
        }
        try:
            if _size_of(headers) + len(body) > self._connection.max_payload:
                # NATS would end the connection after a larger message.
                raise MaxPayloadError
            if time.monotonic() < self._unkept_until_s.get(subject, 0.0):
                await self._connection.publish(subject, body, headers=headers)
            else:
                await stream.publish(subject, body, headers=headers)
        except NoStreamResponseError:
            log.debug("no stream keeps %s, and nobody subscribes to it", subject)
        except NatsTimeout:
            # A subscriber has received the message, but only a stream acknowledges it.
            with suppress(NotFoundError):
                await stream.find_stream_name_by_subject(subject)
                raise
            self._unkept_until_s[subject] = time.monotonic() + UNKEPT_S
        except (MaxPayloadError, APIError) as error:
            if isinstance(error, APIError) and error.err_code != MESSAGE_TOO_LARGE:
                raise
            log.error(
                "what the service said of message %d is too large for %s: %d bytes",
                place.sequence.stream,
                subject,
                len(body),
            )


class _TlsClient(Client):
    """NATS connection that sends no credentials to a server without TLS, also on reconnection."""

    def _connect_command(self) -> bytes:
        if not self._server_info.get("tls_required"):
            raise NatsError("the server does not require TLS")
        return super()._connect_command()


def _size_of(headers: Mapping[str, str]) -> int:
    """Size of NATS headers in bytes, counted as NATS does."""
    lines = (f"{name}: {value}\r\n".encode() for name, value in headers.items())
    return len(b"NATS/1.0\r\n\r\n") + sum(len(line) for line in lines)


def _covers(patterns: Iterable[str], subject: str) -> bool:
    """True if a NATS subject matches one of the patterns: `*` is a token, `>` all further ones."""
    return any(_matches(pattern.split("."), subject.split(".")) for pattern in patterns)


def _matches(pattern: list[str], tokens: list[str]) -> bool:
    if pattern[-1] == ">" and len(tokens) >= len(pattern):
        pattern = pattern[:-1] + tokens[len(pattern) - 1 :]
    return len(pattern) == len(tokens) and all(
        wanted in ("*", token) for wanted, token in zip(pattern, tokens, strict=True)
    )


def gyro_block_in(message: bytes) -> tuple[str, bytes] | None:
    """Spacecraft and request body of a gyro block; None if the message is a batch."""
    if not is_gyro_line(message):
        return None
    block = json.loads(message)
    return str(block.pop("spacecraft", "")), json.dumps(block).encode()
