"""Messages are neither lost nor delivered for ever where NATS or the service is at fault.

A function replaces the service.
"""

import asyncio
import json
import logging
import os
import shutil
import socket
import threading

import pytest

from service.errors import BadConfiguration
from service.features.follow import follower as followers
from service.features.follow.follower import TRIES, Answer, Follower, Metrics, NotNow, Refused
from service.features.follow.source import Source
from tests.features.follow.bus import bus
from tests.features.follow.nats_server import certificate, nats_server

SECONDS = 60.0
FAILED = {"type": "about:blank", "status": 500, "detail": "it failed", "errors": []}
INVALID = FAILED | {"type": "/problems/bad-input", "status": 422}


@pytest.fixture(scope="module")
def servers(tmp_path_factory):
    if named := os.environ.get("TEST_NATS_URL"):
        yield named
        return
    with nats_server(tmp_path_factory.mktemp("bus") / "nats") as server:
        yield server.url


async def recorded(message):
    return Answer(b"{}", is_repeated=False)


def refusing(problem, has_failed):
    async def submit(message):
        raise Refused(problem, has_failed)

    return submit


async def followed(source, submit=recorded):
    """The counts once every message is settled."""
    metrics = Metrics()
    async with asyncio.timeout(SECONDS):
        await Follower(source, submit, metrics).run(until_empty=True)
    return metrics.counts


async def until(holds):
    async with asyncio.timeout(SECONDS):
        while not holds():
            await asyncio.sleep(0.05)


# ---- failures and outages of the service -------------------------------------------------------


def test_only_failures_of_the_service_count_as_attempts(servers):
    attempts = []

    async def failing_at_first(message):
        attempts.append(message)
        if len(attempts) < TRIES:
            raise Refused(FAILED, has_failed=True)
        return Answer(b"{}", is_repeated=False)

    async def failing(message):
        attempts.append(message)
        raise Refused(FAILED, has_failed=True)

    async def run():
        async with bus(servers) as made:
            await made.publish("{}")
            config = followers.ConsumerConfig(durable_name="acquire", ack_policy="explicit")
            await made.stream.add_consumer(made.name, config)
            beside = await made.stream.pull_subscribe_bind(consumer="acquire", stream=made.name)
            # Deliveries to followers that end: the service has had no part in them.
            for _ in range(TRIES):
                (message,) = await beside.fetch(1)
                await message.nak()
            assert (await followed(made.source(), failing_at_first))["recorded"] == 1
            attempts.clear()
            await made.publish("{}")
            assert (await followed(made.source(), failing))["refused"] == 1
            assert len(attempts) == TRIES

    asyncio.run(run())


def test_an_outage_of_the_service_is_logged_once(servers, caplog, monkeypatch):
    monkeypatch.setattr(followers, "PAUSE_S", 0.05)
    asked = 0

    async def busy(message):
        nonlocal asked
        asked += 1
        if asked <= 50 or 60 < asked <= 100:
            raise NotNow("busy")
        return Answer(b"{}", is_repeated=False)

    async def run():
        async with bus(servers) as made:
            await made.publish(*["{}"] * 16)
            assert (await followed(made.source(answers=None), busy))["recorded"] == 16

    with caplog.at_level(logging.WARNING):
        asyncio.run(run())
    assert asked == 50 + 10 + 40 + 6
    assert caplog.text.count("does not take messages now") == 2


# ---- subjects of answers and refusals ----------------------------------------------------------


def test_a_subscriber_without_a_stream_gets_answers_and_refusals(servers):
    async def run():
        async with bus(servers) as made:
            subject = f"plain.{made.name}"
            heard = await made.connection.subscribe(f"{subject}.*")
            source = Source(
                servers, made.name, "acquire", f"{subject}.refused", f"{subject}.answers"
            )
            await made.publish(*["{}"] * 3)
            assert (await followed(source))["recorded"] == 3
            assert [(await heard.next_msg()).subject for _ in range(3)] == [source.answers] * 3
            # A later one does not wait for an acknowledgement that never comes.
            await made.publish("[]")
            assert (await followed(source, refusing(INVALID, False)))["refused"] == 1
            assert (await heard.next_msg()).subject == source.refusals
            with pytest.raises(TimeoutError):
                await heard.next_msg(timeout=0.1)

    asyncio.run(run())


@pytest.mark.parametrize("bytes_below", [-1, 40])
def test_an_answer_that_is_too_large_is_logged_and_the_message_is_done(
    servers, caplog, bytes_below
):
    """Also where only the headers make it too large: NATS would end the connection."""

    async def run():
        async with bus(servers) as made:
            size = made.connection.max_payload - bytes_below

            async def large(message):
                return Answer(b" " * size, is_repeated=False)

            await made.publish("{}")
            assert (await followed(made.source(), large))["recorded"] == 1
            await made.publish("{}")
            problem = INVALID | {"detail": " " * size}
            assert (await followed(made.source(), refusing(problem, False)))["refused"] == 1

    asyncio.run(run())
    assert caplog.text.count("is too large for") == 2


def test_an_answer_above_the_limit_of_its_stream_is_logged_and_the_message_is_done(servers, caplog):
    async def run():
        async with bus(servers) as made:
            name, subject = f"{made.name}-small", f"small.{made.name}"
            await made.stream.add_stream(name=name, subjects=[subject], max_msg_size=1_000)

            async def large(message):
                return Answer(b" " * 2_000, is_repeated=False)

            await made.publish("{}")
            assert (await followed(made.source(answers=subject), large))["recorded"] == 1
            await made.stream.delete_stream(name)

    asyncio.run(run())
    assert caplog.text.count("is too large for") == 1


@pytest.mark.parametrize("name", ["answers", "refusals"])
def test_a_follower_does_not_follow_its_own_messages(servers, name):
    async def run():
        async with bus(servers) as made:
            subjects = {"answers": None, "refusals": made.refusals}
            subjects[name] = f"{made.name}.output.own"
            source = Source(servers, made.name, "acquire", **subjects)
            with pytest.raises(BadConfiguration, match=r"output\.own, which the follower"):
                await followed(source)
            # A consumer of some of the stream's subjects may leave them out.
            config = followers.ConsumerConfig(
                durable_name="acquire",
                ack_policy="explicit",
                filter_subject=f"{made.name}.telemetry",
            )
            await made.stream.add_consumer(made.name, config)
            await made.publish("{}")
            assert (await followed(source))["recorded"] == 1

    asyncio.run(run())


@pytest.mark.parametrize(
    ("pattern", "subject", "covers"),
    [
        (">", "a", True),
        ("a.>", "a.b.c", True),
        ("a.>", "a", False),
        ("a.*", "a.b", True),
        ("a.*", "a.b.c", False),
        ("*.b.>", "a.b.c.d", True),
        ("a.b", "a.b", True),
        ("a.b", "a.c", False),
        ("a.b", "a", False),
    ],
)
def test_a_pattern_of_nats_covers_subjects(pattern, subject, covers):
    assert followers._covers([pattern], subject) == covers


# ---- NATS ---------------------------------------------------------------------------------------


def test_a_consumer_that_is_deleted_is_made_again(servers, caplog):
    async def run():
        async with bus(servers) as made:
            follower = Follower(made.source(), recorded, metrics := Metrics())
            counts = metrics.counts
            running = asyncio.create_task(follower.run())
            await made.publish("{}")
            await until(lambda: counts["recorded"] == 1)
            await made.stream.delete_consumer(made.name, "acquire")
            await made.publish("[]")
            # A new consumer delivers everything once more.
            await until(lambda: counts["recorded"] == 3)
            follower.stop()
            await running

    asyncio.run(run())
    assert "has lost the consumer acquire" in caplog.text


def test_a_stream_that_is_lost_and_made_again_is_followed(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(followers, "BEGIN_AGAIN_S", 0.2)

    async def run():
        with nats_server(tmp_path / "nats") as server:
            async with bus(server.url) as made:
                follower = Follower(made.source(), recorded, metrics := Metrics())
                counts = metrics.counts
                running = asyncio.create_task(follower.keep_running())
                await made.publish("{}")
                await until(lambda: counts["recorded"] == 1)
                server.kill()
                shutil.rmtree(tmp_path / "nats" / "streams")
                server.start()
                await until(lambda: f"no stream {made.name}" in caplog.text)
                await made.stream.add_stream(name=made.name, subjects=[f"{made.name}.>"])
                await made.stream.add_stream(
                    name=made.kept, subjects=[f"{made.kept}.>", made.refusals]
                )
                await made.publish("{}")
                await until(lambda: counts["recorded"] == 2)
                follower.stop()
                await running

    asyncio.run(run())


def plain_nats(accepted, *lines):
    """A server that says these lines, and notes what comes."""
    listening = socket.create_server(("127.0.0.1", 0))

    def serve():
        while True:
            try:
                connection, _ = listening.accept()
            except OSError:
                return
            with connection:
                connection.settimeout(1.0)
                for line in lines:
                    connection.sendall(line.encode() + b"\r\n")
                    try:
                        accepted.append(connection.recv(4096))
                    except OSError:
                        accepted.append(b"")

    threading.Thread(target=serve, daemon=True).start()
    return listening


@pytest.mark.parametrize("with_authority", [False, True])
def test_a_server_without_tls_gets_no_password(caplog, tmp_path, with_authority):
    accepted = []
    info = {"server_id": "x", "version": "2.9.10", "max_payload": 1_000, "auth_required": True}
    authority = certificate(tmp_path)[0] if with_authority else None
    scheme = "nats" if with_authority else "tls"

    async def run(port):
        url = f"{scheme}://user:secret@127.0.0.1:{port}"
        source = Source(url, "S", "acquire", "refused", authority=authority)
        follower = Follower(source, recorded, Metrics())
        running = asyncio.create_task(follower.run())
        await until(lambda: len(accepted) >= 2)
        follower.stop()
        await running

    with plain_nats(accepted, f"INFO {json.dumps(info)}", "PONG") as listening:
        asyncio.run(run(listening.getsockname()[1]))
    assert not any(b"secret" in received for received in accepted), accepted
    assert "does not require TLS" in caplog.text
    assert "secret" not in caplog.text


def test_a_nats_without_jetstream_is_named(tmp_path):
    with nats_server(tmp_path / "nats") as server:
        text = server._file.read_text()
        server.kill()
        server._file.write_text(text.replace("jetstream", "# jetstream"))
        server.start()
        source = Source(server.url, "S", "acquire", "refused")
        with pytest.raises(BadConfiguration, match="JetStream cannot be used"):
            asyncio.run(followed(source))


def test_a_nats_that_does_not_say_what_is_left_is_asked_again(servers, monkeypatch):
    """NATS answers no request about the consumer in time, but one of the later ones."""
    asked = 0
    answering = followers.JetStreamContext.consumer_info

    async def slow(*arguments):
        nonlocal asked
        asked += 1
        if 1 < asked < 5:
            raise followers.NatsTimeout
        return await answering(*arguments)

    async def run():
        async with bus(servers) as made:
            await made.publish("{}")
            monkeypatch.setattr(followers.JetStreamContext, "consumer_info", slow)
            assert (await followed(made.source()))["recorded"] == 1

    asyncio.run(run())
    assert asked >= 5
