"""What a receiver has taken is not sent to it again, and what was asked for is."""

import json
import socket
import threading
import time
from functools import partial

import pytest

from service.errors import Busy
from service.features.webhooks import posts
from service.features.webhooks import records as webhooks
from service.features.webhooks.part import Webhooks
from service.storage.recording import events
from tests.features.webhooks.conftest import HERE, LOOPBACK, receiving, serving
from tests.waiting import wait_until


def texts(receiver):
    return [json.loads(each.body)["data"]["text"] for each in receiver.requests]


@pytest.mark.slow
def test_events_that_are_recorded_while_others_are_queued_are_sent_once(
    service, receiver, monkeypatch
):
    """Between the look at the last number and the look at the events, another one is recorded."""
    sender = service.app.part(Webhooks).sender
    look, left = sender._last_and_waiting, list(range(12))

    def look_then_write():
        found = look()
        if left:
            service.note(f"n{left.pop(0)}")
        return found

    monkeypatch.setattr(sender, "_last_and_waiting", look_then_write)
    hook = service.hook(receiver.url)
    wait_until(lambda: not left and "n11" in texts(receiver))
    wait_until(lambda: service.read(hook)["waiting"] == 0)
    time.sleep(0.5)
    assert texts(receiver) == [f"n{n}" for n in range(12)]


@pytest.mark.slow
def test_what_was_taken_is_not_sent_again_while_it_cannot_be_noted(service, receiver, monkeypatch):
    """The writer's queue is full under a bulk load, for longer than one try."""
    writer = service.app.store.writer
    change, refused = writer.change, []

    def full_at_first(asked):
        if isinstance(asked, partial) and asked.func is webhooks.settle and len(refused) < 3:
            refused.append(asked)
            raise Busy("10000 records are waiting to be written")
        return change(asked)

    monkeypatch.setattr(writer, "change", full_at_first)
    hook = service.hook(receiver.url)
    service.note("once")
    wait_until(lambda: service.read(hook)["last_delivered"])
    assert len(refused) == 3
    assert service.read(hook)["waiting"] == 0
    assert texts(receiver) == ["once"]


def test_an_attempt_under_way_when_the_service_stops_is_awaited(chosen_database, receiver):
    database, begun = chosen_database(), threading.Event()

    def slowly(handler, request):
        begun.set()
        time.sleep(0.7)
        handler.say(204)

    receiver.answer = slowly
    with serving(database) as service:
        hook = service.hook(receiver.url)
        service.note("slow")
        assert begun.wait(20)
    with serving(database) as service:
        service.note("after")
        wait_until(lambda: "after" in texts(receiver))
        wait_until(lambda: service.read(hook)["waiting"] == 0)
    assert texts(receiver) == ["slow", "after"]


def test_a_failure_of_another_spacecraft_does_not_end_the_pause_that_was_asked_for(
    service, receiver
):
    """Two attempts at a time: one is answered 429, then the other 500."""
    first_is_noted = threading.Event()

    def answer(handler, request):
        if json.loads(request.body)["spacecraft"] == "XTE":
            handler.say(429, Retry_After="600")
            return
        first_is_noted.wait(20)
        handler.say(500)

    receiver.answer = answer
    hook = service.hook(receiver.url)

    def note_both(connection):
        for spacecraft in ("SWAS", "XTE"):
            about = {"text": spacecraft}
            events.add_event(connection, "annotation", about, spacecraft=spacecraft)

    service.app.context.change(note_both)
    wait_until(lambda: service.read(hook)["last_status"] == 429)
    first_is_noted.set()
    wait_until(lambda: service.read(hook)["last_status"] == 500)
    service.note("not now", "SOHO")
    time.sleep(1.5)
    assert len(receiver.requests) == 2


def test_a_period_is_sent_again_to_its_end_however_many_events_others_wanted(
    service, receiver, monkeypatch
):
    """The list of events holds a few more than those that are kept for certain."""
    monkeypatch.setattr(events, "KEPT", 10)
    hook = service.hook(receiver.url, spacecraft=["XTE"])
    for n in range(30):
        service.note(f"s{n}", "SWAS")
    service.note("wanted")
    receiver.next()
    wait_until(lambda: service.read(hook)["waiting"] == 0)
    assert service.ask(hook, "replay", since=hook["created"]).json() == {"queued": 1}
    receiver.next()
    assert texts(receiver) == ["wanted", "wanted"]


def test_an_address_that_does_not_answer_leaves_time_for_the_next(chosen_database, monkeypatch):
    """A name with two addresses, of which a firewall drops what goes to the first."""
    monkeypatch.setattr(posts, "TOTAL_S", 3.0)
    with socket.socket() as full, receiving("127.0.0.3") as receiver:
        full.bind(("127.0.0.2", receiver.port))
        full.listen(0)
        # With its queue full, the kernel drops further connections as a firewall does.
        waiting = [socket.socket() for _ in range(4)]
        for each in waiting:
            each.setblocking(False)
            each.connect_ex(full.getsockname())
        real = socket.getaddrinfo

        def getaddrinfo(host, port, *given, **named):
            if host != "two.example":
                return real(host, port, *given, **named)
            return [(socket.AF_INET, 1, 6, "", (f"127.0.0.{n}", port)) for n in (2, 3)]

        monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
        with serving(chosen_database(), allowed=LOOPBACK) as service:
            hook = service.hook(f"http://two.example:{receiver.port}/")
            told = service.client.post(f"{HERE}/{hook['id']}/test").json()
        for each in waiting:
            each.close()
    assert told["delivered"] is True, told


def test_a_late_answer_of_an_earlier_address_disables_nothing(service, receiver, soon):
    """410 Gone answers an attempt that began before the webhook was given another address."""
    begun, changed = threading.Event(), threading.Event()

    def answer(handler, request):
        if request.path == "/old":
            begun.set()
            changed.wait(20)
            handler.say(410)
        else:
            handler.say(204)

    receiver.answer = answer
    new = receiver.url.rsplit("/", 1)[0] + "/new"
    hook = service.hook(new.replace("/new", "/old"))
    service.note("once")
    assert begun.wait(20)
    assert service.client.put(f"{HERE}/{hook['id']}", json={"name": "test", "url": new}).is_success
    changed.set()
    wait_until(lambda: service.read(hook)["waiting"] == 0)
    shown = service.read(hook)
    assert (shown["state"], shown["failing_since"], shown["last_fault"]) == ("active", None, None)
    assert [each.path for each in receiver.requests] == ["/old", "/new"]
