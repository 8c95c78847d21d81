"""A stream of NATS to follow, and another one that keeps refusals and answers."""

import asyncio
import json
import subprocess
import sys
import uuid
from contextlib import ExitStack, asynccontextmanager, contextmanager, suppress
from itertools import islice

import nats
from nats.errors import Error as NatsError

from service.features.follow.follower import DELIVERED, SEQUENCE
from service.features.follow.source import Source, refusals_of

FOLLOW = [sys.executable, "-m", "service.cli", "follow"]


class Bus:
    """A stream of its own, and another one that keeps refusals and answers."""

    def __init__(self, servers, connection):
        self.servers = servers
        self.connection, self.stream = connection, connection.jetstream()
        self.name = f"T{uuid.uuid4().hex}"
        self.kept = f"{self.name}-kept"
        self.refusals, self.answers = refusals_of(self.name), f"{self.kept}.answers"

    def source(self, **wanted):
        settings = {"answers": self.answers} | wanted
        return Source(self.servers, self.name, "acquire", self.refusals, **settings)

    async def publish(self, *texts):
        futures = [
            await self.stream.publish_async(f"{self.name}.telemetry", text.encode())
            for text in texts
        ]
        await asyncio.gather(*futures)

    async def publish_many(self, texts):
        """Publish messages a few hundred at a time."""
        texts = iter(texts)
        while chunk := list(islice(texts, 500)):
            await self.publish(*chunk)

    async def publish_until_kept(self, texts):
        """Publish messages that may come twice, also where NATS is only just back."""
        async with asyncio.timeout(120.0):
            while True:
                # An answer that was lost with the connection never comes.
                with suppress(NatsError, TimeoutError):
                    return await asyncio.wait_for(self.publish_many(texts), 10.0)
                await asyncio.sleep(0.5)

    async def kept_of(self, subject):
        """The messages of a subject: their JSON, and the place and delivery they are about."""
        info = await self.stream.stream_info(self.kept)
        found = []
        for number in range(1, info.state.last_seq + 1):
            message = await self.stream.get_msg(self.kept, number)
            if message.subject == subject:
                told = json.loads(message.data)
                found.append((told, int(message.headers[SEQUENCE]), message.headers[DELIVERED]))
        return found

    async def pending(self):
        """The messages that are still to deliver, and to acknowledge; None if NATS does not say."""
        try:
            info = await self.stream.consumer_info(self.name, "acquire")
        except (NatsError, TimeoutError):
            return None
        return info.num_pending, info.num_ack_pending

    async def wait_until_empty(self, seconds=120.0, below=1):
        """Wait until fewer messages than `below` are still to deliver or to acknowledge."""
        async with asyncio.timeout(seconds):
            while (left := await self.pending()) is None or sum(left) >= below:
                await asyncio.sleep(0.1)


@asynccontextmanager
async def bus(servers, **options):
    connection = await nats.connect(servers, max_reconnect_attempts=-1, **options)
    made = Bus(servers, connection)
    try:
        await made.stream.add_stream(name=made.name, subjects=[f"{made.name}.>"])
        await made.stream.add_stream(name=made.kept, subjects=[f"{made.kept}.>", made.refusals])
        yield made
    finally:
        # A server that was killed may not be back.
        with suppress(NatsError, TimeoutError):
            for name in (made.name, made.kept):
                await made.stream.delete_stream(name)
        await connection.close()


class Process:
    """`acquire follow`."""

    def __init__(self, command):
        self._command = command
        self.start()

    def start(self):
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def kill(self):
        self._process.kill()
        self._process.wait()

    def kill_and_start(self):
        self.kill()
        self.start()


@contextmanager
def followers(made, url, count):
    """So many processes that share the messages of a stream."""
    command = [*FOLLOW, f"{made.servers}/{made.name}", "--consumer", "acquire"]
    command += ["--url", url, "--refusals", made.refusals]
    with ExitStack() as stack:
        running = [Process(command) for _ in range(count)]
        for process in running:
            stack.callback(process.kill)
        yield running
