"""Messages of a NATS stream are recorded once, whoever is killed; refused ones say why."""

import asyncio
import json
import os
import subprocess
import sys
import time
import uuid
from contextlib import asynccontextmanager

import nats
import nats.js.api
import pytest
from acquire_client import AsyncClient
from nats.errors import NoServersError
from sqlalchemy import func, select

from service.errors import BadConfiguration
from service.follow import ACK_WAIT_S, DELIVERED, SEQUENCE, Follower, Metrics, Source
from service.storage.sql.tables import batches
from tests.fresh_databases import sqlite_at
from tests.gyro.blocks import body as gyro_block
from tests.scale import size
from tests.storage import samples
from tests.waiting import wait_until
from tests.web.serving import serving_in_process

SERVERS = os.environ.get("TEST_NATS_URL", "nats://127.0.0.1:4222")
MESSAGES, FOLLOWERS = 100_000, 4
KILL_EVERY_S = 3.0


class Bus:
    """A stream of its own, and another one that keeps refusals and answers."""

    def __init__(self, connection):
        self.connection, self.stream = connection, connection.jetstream()
        self.name = f"T{uuid.uuid4().hex}"
        self.kept = f"{self.name}-kept"
        self.refusals, self.answers = f"{self.kept}.refused", f"{self.kept}.answers"

    def source(self, **wanted):
        settings = {"answers": self.answers} | wanted
        return Source(SERVERS, self.name, "acquire", self.refusals, **settings)

    async def publish(self, *texts):
        futures = [
            await self.stream.publish_async(f"{self.name}.telemetry", text.encode())
            for text in texts
        ]
        await asyncio.gather(*futures)

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
        info = await self.stream.consumer_info(self.name, "acquire")
        return info.num_pending, info.num_ack_pending


@asynccontextmanager
async def bus():
    try:
        connection = await nats.connect(SERVERS, max_reconnect_attempts=-1, connect_timeout=2)
    except (NoServersError, OSError, TimeoutError):
        pytest.skip(f"no NATS server answers at {SERVERS} (TEST_NATS_URL)")
    made = Bus(connection)
    try:
        await made.stream.add_stream(name=made.name, subjects=[f"{made.name}.>"])
        await made.stream.add_stream(name=made.kept, subjects=[f"{made.kept}.>"])
        yield made
    finally:
        for name in (made.name, made.kept):
            await made.stream.delete_stream(name)
        await connection.close()


@pytest.fixture
def service(tmp_path):
    with serving_in_process(sqlite_at(tmp_path / "acquire.db")) as service:
        yield service


async def followed(service, source, metrics=None):
    metrics = metrics or Metrics()
    async with AsyncClient(service.url) as client:
        await Follower(source, client, metrics).run(until_empty=True)
    return metrics


def test_batches_and_gyro_blocks_are_recorded_and_refused_ones_say_why(service, sky, missions):
    good = samples.batch(sky, missions, "good")
    block = json.dumps(gyro_block() | {"spacecraft": "XTE"})
    other = samples.batch(sky, missions, "good", stars=4)
    sent = [good, good, block, other, "no JSON", json.dumps({"spacecraft": "NONE"})]

    async def run():
        async with bus() as made:
            await made.publish(*sent)
            metrics = await followed(service, made.source(concurrency=1))
            assert metrics.counts == {
                "recorded": 2,
                "repeated": 1,
                "refused": 3,
                "redelivered": 0,
            }
            assert await made.pending() == (0, 0)
            refused = {place: told for told, place, _ in await made.kept_of(made.refusals)}
            answered = [told for told, *_ in await made.kept_of(made.answers)]
            # What is settled is not delivered again.
            again = await followed(service, made.source())
            assert sum(again.counts.values()) == 0
            return refused, answered

    refused, answered = asyncio.run(run())
    assert {place: told["status"] for place, told in refused.items()} == {4: 409, 5: 400, 6: 422}
    assert "another body" in refused[4]["detail"]
    assert refused[6]["errors"]
    assert [each.get("batch") for each in answered] == ["good", "good", None]
    assert answered[0] == answered[1]
    recorded = service.client.get("/api/v1/batches").json()["items"]
    assert [each["batch"] for each in recorded] == ["good"]
    assert len(service.client.get("/api/v1/spacecraft/XTE/gyro").json()["items"]) == 1


def test_a_stream_that_is_not_there_is_named(service):
    async def run():
        async with bus() as made:
            source = Source(SERVERS, f"{made.name}-none", "acquire", made.refusals)
            with pytest.raises(BadConfiguration, match=f"no stream {made.name}-none"):
                await followed(service, source)

    asyncio.run(run())


def test_a_follower_that_is_stopped_leaves_its_messages_to_another(service, sky, missions):
    async def run():
        async with bus() as made:
            await made.publish(*(samples.batch(sky, missions, f"b{k}") for k in range(20)))
            async with (
                AsyncClient("http://127.0.0.1:9", give_up_after_s=0.1) as nowhere,
                AsyncClient(service.url) as there,
            ):
                # A service that answers once, and then does no longer.
                nowhere.session = there.session
                follower = Follower(made.source(), nowhere, Metrics())
                running = asyncio.create_task(follower.run())
                while (await made.stream.stream_info(made.name)).state.consumer_count < 1:
                    await asyncio.sleep(0.05)
                await asyncio.sleep(0.5)
                follower.stop()
                await running
            begun_s = time.monotonic()
            metrics = await followed(service, made.source())
            assert time.monotonic() - begun_s < ACK_WAIT_S
            assert metrics.counts["recorded"] == 20
            assert metrics.counts["redelivered"] > 0

    asyncio.run(run())


@pytest.mark.torture
def test_messages_are_recorded_once_whichever_followers_are_killed(
    service, sky, missions, rng, figures
):
    number = size(MESSAGES, 400)
    template = samples.batch(sky, missions, "NAME")
    repeats, refusals = number // 100, number // 100
    texts = [template.replace("NAME", f"b{k}") for k in range(number - repeats - refusals)]
    expected = len(texts)
    for _ in range(repeats):
        texts.append(texts[rng.integers(expected)])
    texts += [json.dumps({"spacecraft": "XTE", "batch": f"bad-{k}"}) for k in range(refusals)]
    order = rng.permutation(len(texts))
    command = [sys.executable, "-m", "service.cli", "follow"]

    async def run():
        async with bus() as made:
            config = nats.js.api.ConsumerConfig(
                durable_name="acquire", ack_policy="explicit", ack_wait=5.0
            )
            await made.stream.add_consumer(made.name, config)
            for first in range(0, len(order), 500):
                await made.publish(*(texts[k] for k in order[first : first + 500]))
            arguments = [f"{SERVERS}/{made.name}", "--consumer", "acquire", "--url", service.url]
            arguments += ["--refusals", made.refusals]

            def start():
                return subprocess.Popen(
                    [*command, *arguments],
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )

            followers = [start() for _ in range(FOLLOWERS)]
            kills, begun_s = 0, time.monotonic()
            try:
                while await made.pending() != (0, 0):
                    await asyncio.sleep(KILL_EVERY_S)
                    place = int(rng.integers(FOLLOWERS))
                    followers[place].kill()
                    followers[place].wait()
                    followers[place] = start()
                    kills += 1
            finally:
                for each in followers:
                    each.kill()
                    each.wait()
            took_s = time.monotonic() - begun_s
            refused = await made.kept_of(made.refusals)
            return kills, took_s, refused

    kills, took_s, refused = asyncio.run(run())
    figures(messages=number, kills=kills, a_second=round(number / took_s, 1), refused=len(refused))
    places = [place for _, place, _ in refused]
    wanted = [1 + k for k, of in enumerate(order) if of >= number - refusals]
    assert sorted(set(places)) == wanted
    # Published before a kill and again after it, a refusal is kept once.
    assert len(places) == len(set(places))
    assert all(told["status"] == 422 for told, *_ in refused)
    with service.app.store.reading() as connection:
        assert connection.scalar(select(func.count()).select_from(batches)) == expected
    wait_until(lambda: service.app.projector.lag().results == 0)
    assert sum(each.batches for each in service.app.spacecraft.rates("XTE")) == expected
