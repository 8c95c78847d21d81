"""Messages of a NATS stream are recorded once, whoever is killed; refused ones say why."""

import asyncio
import json
import os
import ssl
import subprocess
import time

import nats.js.api
import pytest
from acquire_client import AsyncClient
from sqlalchemy import func, select

from service.errors import BadConfiguration
from service.features.follow.follower import ACK_WAIT_S, Follower, Metrics
from service.features.follow.over_http import OverHttp
from service.features.follow.source import Source
from service.storage.sql.tables import batches
from tests.features.follow.bus import FOLLOW, bus, followers
from tests.features.follow.nats_server import Account, certificate, nats_server, tls
from tests.fresh_databases import sqlite_at
from tests.gyro.blocks import body as gyro_block
from tests.scale import size
from tests.storage import samples
from tests.waiting import wait_until
from tests.web.serving import serving_in_process

MESSAGES, FOLLOWERS = 100_000, 4
KILL_EVERY_S = 3.0
KILLS_A_NATS = 20
"""The kills of followers for each kill of NATS."""


@pytest.fixture(scope="module")
def servers(tmp_path_factory):
    """The address of NATS: a server of these tests, or the one that TEST_NATS_URL names."""
    if named := os.environ.get("TEST_NATS_URL"):
        yield named
        return
    with nats_server(tmp_path_factory.mktemp("bus") / "nats") as server:
        yield server.url


@pytest.fixture
def service(tmp_path):
    with serving_in_process(sqlite_at(tmp_path / "acquire.db")) as service:
        yield service


async def followed(service, source, metrics=None):
    metrics = metrics or Metrics()
    async with AsyncClient(service.url) as client:
        await Follower(source, OverHttp(client), metrics).run(until_empty=True)
    return metrics


def figure(service, name):
    """A figure of `/metrics`."""
    lines = service.client.get("/metrics").text.splitlines()
    return next((float(line.split()[-1]) for line in lines if line.startswith(f"{name} ")), None)


@pytest.mark.parametrize("way", ["over_http", "within_the_service"])
def test_batches_and_gyro_blocks_are_recorded_and_refused_ones_say_why(
    way, servers, sky, missions, tmp_path
):
    good = samples.batch(sky, missions, "good")
    block = json.dumps(gyro_block() | {"spacecraft": "XTE"})
    other = samples.batch(sky, missions, "good", stars=4)
    sent = [good, good, block, other, "no JSON", json.dumps({"spacecraft": "NONE"})]
    counts = {"recorded": 2, "repeated": 1, "refused": 3, "redelivered": 0}

    async def run():
        async with bus(servers) as made:
            await made.publish(*sent)
            settings = {}
            if way == "within_the_service":
                # One after the other, as the answers below are expected.
                config = nats.js.api.ConsumerConfig(durable_name="acquire", max_ack_pending=1)
                await made.stream.add_consumer(made.name, config)
                settings = {
                    "follow": f"{servers}/{made.name}",
                    "follow_answers": made.answers,
                }
            with serving_in_process(sqlite_at(tmp_path / "acquire.db"), **settings) as service:
                if way == "within_the_service":
                    await made.wait_until_empty()
                    total = "starid_follow_messages_total"
                    counted = {
                        name: figure(service, f'{total}{{outcome="{name}"}}')
                        for name in counts
                        if name != "redelivered"
                    }
                    assert counts == counted | {"redelivered": 0}
                    wait_until(lambda: figure(service, "starid_follow_lag") == 0)
                    assert figure(service, "starid_batches_repeated_total") == 1
                else:
                    metrics = await followed(service, made.source(concurrency=1))
                    assert metrics.counts == counts
                    assert await made.pending() == (0, 0)
                    assert figure(service, "starid_follow_lag") is None
                # What is settled is not delivered again.
                again = await followed(service, made.source())
                assert sum(again.counts.values()) == 0
                batches = service.client.get("/api/v1/batches").json()["items"]
                blocks = service.client.get("/api/v1/spacecraft/XTE/gyro").json()["items"]
            refused = {place: told for told, place, _ in await made.kept_of(made.refusals)}
            answered = [told for told, *_ in await made.kept_of(made.answers)]
            return batches, blocks, refused, answered

    recorded, blocks, refused, answered = asyncio.run(run())
    assert {place: told["status"] for place, told in refused.items()} == {4: 409, 5: 400, 6: 422}
    assert {place: told["type"] for place, told in refused.items()} == {
        4: "/problems/conflict",
        5: "/problems/not-json",
        6: "/problems/bad-input",
    }
    assert "another body" in refused[4]["detail"]
    assert [bool(refused[place]["errors"]) for place in (4, 5, 6)] == [False, True, True]
    assert [each.get("batch") for each in answered] == ["good", "good", None]
    assert answered[0] == answered[1]
    assert answered[2]["id"] == blocks[0]["id"]
    assert [each["batch"] for each in recorded] == ["good"]
    assert len(blocks) == 1


def test_a_service_follows_as_soon_as_nats_is_there_and_stops_without_it(tmp_path, sky, missions):
    async def run():
        with nats_server(tmp_path / "nats") as server:
            async with bus(server.url) as made:
                await made.publish(samples.batch(sky, missions, "good"))
                server.kill()
                settings = {"follow": f"{server.url}/{made.name}", "follow_consumer": "acquire"}
                with serving_in_process(sqlite_at(tmp_path / "acquire.db"), **settings) as service:
                    body = samples.batch(sky, missions, "posted")
                    json_type = {"content-type": "application/json"}
                    sent = service.client.post("/api/v1/batches", content=body, headers=json_type)
                    assert sent.status_code == 201
                    server.start()
                    await made.wait_until_empty()
                    assert figure(service, 'starid_follow_messages_total{outcome="recorded"}') == 1
                    server.kill()
                    begun_s = time.monotonic()
                # It was not waited for.
                assert time.monotonic() - begun_s < 60.0
                server.start()

    asyncio.run(run())


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"follow": "nats://user:word@bus"}, "ACQUIRE_FOLLOW: must be nats://HOST/STREAM or"),
        (
            {"follow": "nats://bus/S", "follow_credentials": "none.creds"},
            "ACQUIRE_FOLLOW_CREDENTIALS: none.creds is not there",
        ),
        (
            {"follow": "nats://bus/S", "follow_authority": "none.pem"},
            "ACQUIRE_FOLLOW_AUTHORITY: none.pem is not there",
        ),
    ],
)
def test_a_service_names_what_it_cannot_follow(acquire, monkeypatch, settings, said):
    for name, value in settings.items():
        monkeypatch.setenv(f"ACQUIRE_{name.upper()}", value)
    code, _, complaint = acquire("serve", "--port", 0)
    assert code == 2
    assert said in complaint
    assert "word" not in complaint


@pytest.mark.parametrize("scheme", ["nats", "tls"])
def test_a_follower_speaks_tls_and_shows_its_credentials(
    service, sky, missions, tmp_path, scheme, caplog
):
    folder = tmp_path / "keys"
    folder.mkdir()
    pem, key = certificate(folder)
    account = Account()
    credentials = account.credentials(folder / "user.creds")
    configuration = tls(pem, key) + account.configuration()

    async def turned_away(source, reason):
        """A follower that NATS does not accept says why, tries again, and can be stopped."""
        caplog.clear()
        async with AsyncClient(service.url) as client:
            follower = Follower(source, OverHttp(client), Metrics())
            running = asyncio.create_task(follower.run())
            async with asyncio.timeout(30):
                while not running.done() and reason not in caplog.text:
                    await asyncio.sleep(0.05)
                follower.stop()
                await running
        assert reason in caplog.text

    async def run():
        context = ssl.create_default_context(cafile=pem)
        options = {"user_credentials": str(credentials), "tls": context}
        async with bus(server.url, **options) as made:
            await made.publish(samples.batch(sky, missions, "good"))
            await turned_away(Source(server.url, made.name, "x", "y", authority=pem), "Authoriz")
            source = Source(server.url, made.name, "x", "y", credentials=credentials)
            await turned_away(source, "certificate")
            command = [*FOLLOW, f"{server.url}/{made.name}", "--consumer", "acquire"]
            command += ["--url", service.url, "--until-empty", "--json"]
            command += ["--credentials", credentials, "--authority", pem]
            ran = await asyncio.to_thread(subprocess.run, command, capture_output=True, check=False)
            assert ran.returncode == 0, ran.stderr
            return json.loads(ran.stdout)

    with nats_server(tmp_path / "nats", scheme, configuration) as server:
        counts = asyncio.run(run())
    assert counts == {"recorded": 1, "repeated": 0, "refused": 0, "redelivered": 0}


def test_a_stream_that_is_not_there_is_named(servers, service):
    async def run():
        async with bus(servers) as made:
            source = Source(servers, f"{made.name}-none", "acquire", made.refusals)
            with pytest.raises(BadConfiguration, match=f"no stream {made.name}-none"):
                await followed(service, source)

    asyncio.run(run())


def test_a_follower_that_is_stopped_leaves_its_messages_to_another(servers, service, sky, missions):
    async def run():
        async with bus(servers) as made:
            await made.publish(*(samples.batch(sky, missions, f"b{k}") for k in range(20)))
            async with AsyncClient("http://127.0.0.1:9", give_up_after_s=0.1) as nowhere:
                follower = Follower(made.source(), OverHttp(nowhere), Metrics())
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
    service, sky, missions, rng, figures, tmp_path
):
    """NATS is killed too; and how fast one follower is, and four are, that nobody kills."""
    number = size(MESSAGES, 400)
    template = samples.batch(sky, missions, "NAME")
    repeats, refusals = number // 100, number // 100
    texts = [template.replace("NAME", f"b{k}") for k in range(number - repeats - refusals)]
    expected = len(texts)
    for _ in range(repeats):
        texts.append(texts[rng.integers(expected)])
    texts += [json.dumps({"spacecraft": "XTE", "batch": f"bad-{k}"}) for k in range(refusals)]
    order = rng.permutation(len(texts))
    timed = max(100, number // 20)

    async def run():
        with nats_server(tmp_path / "nats") as server:
            rates = []
            for count in (1, FOLLOWERS):
                named = (f"timed-{count}-{k}" for k in range(timed))
                async with bus(server.url) as made:
                    await made.publish_many(template.replace("NAME", name) for name in named)
                    with followers(made, service.url, count):
                        # Their start is not counted.
                        await made.wait_until_empty(below=timed)
                        begun_s, left = time.monotonic(), sum(await made.pending())
                        await made.wait_until_empty(seconds=3600.0)
                        rates.append(round(left / (time.monotonic() - begun_s), 1))
            async with bus(server.url) as made:
                await made.publish_many(texts[k] for k in order)
                config = nats.js.api.ConsumerConfig(
                    durable_name="acquire", ack_policy="explicit", ack_wait=5.0
                )
                await made.stream.add_consumer(made.name, config)
                kills = {"followers": 0, "nats": 0}
                begun_s = time.monotonic()
                with followers(made, service.url, FOLLOWERS) as running:
                    while await made.pending() != (0, 0):
                        await asyncio.sleep(KILL_EVERY_S)
                        if kills["followers"] % KILLS_A_NATS == KILLS_A_NATS // 2:
                            server.kill()
                            await asyncio.sleep(float(rng.uniform(0, 1)))
                            server.start()
                            kills["nats"] += 1
                        running[rng.integers(FOLLOWERS)].kill_and_start()
                        kills["followers"] += 1
                took_s = time.monotonic() - begun_s
                return kills, took_s, await made.kept_of(made.refusals), rates

    kills, took_s, refused, (one_a_second, four_a_second) = asyncio.run(run())
    figures(
        messages=number,
        kills=kills,
        a_second=round(number / took_s, 1),
        one_follower_a_second=one_a_second,
        four_followers_a_second=four_a_second,
        refused=len(refused),
    )
    places = [place for _, place, _ in refused]
    wanted = [1 + k for k, of in enumerate(order) if of >= number - refusals]
    assert sorted(set(places)) == wanted
    # One that is there twice is marked as delivered again.
    seen = set()
    for _, place, delivered in sorted(refused, key=lambda each: int(each[2])):
        assert place not in seen or int(delivered) > 1
        seen.add(place)
    assert all(told["status"] == 422 for told, *_ in refused)
    with service.app.store.reading() as connection:
        counted = connection.scalar(select(func.count()).select_from(batches))
    assert counted == expected + 2 * timed
    wait_until(lambda: service.app.store.progress.lag().results == 0)
    assert sum(each.batches for each in service.app.spacecraft.rates("XTE")) == counted
