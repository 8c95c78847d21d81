"""Live events over HTTP: nothing is lost, whoever wrote it and however long one was away."""

import asyncio
import json
import socket
import threading
import time
from contextlib import contextmanager

import httpx
import pytest
from sqlalchemy import make_url

from service.access import OPEN_CALLER
from service.app.factory import open_app
from service.storage.recording import events as records
from service.times import parse_utc
from service.web import event_stream as live
from service.web.app import create_app
from tests.waiting import wait_until
from tests.web.serving import Server, in_process_settings

ROUTE = "/api/v1/events"


class Listener:
    """Reads one stream in a thread and keeps what it was told."""

    def __init__(self, address, headers=None, **asked):
        self.events = []
        self.lines = []
        self.ended = threading.Event()
        self._opened = threading.Event()
        self._arguments = (address, headers, asked)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        assert self._opened.wait(20)

    def _listen(self):
        address, headers, asked = self._arguments
        try:
            with (
                httpx.Client(base_url=address, timeout=60, trust_env=False) as client,
                client.stream("GET", ROUTE, params=asked, headers=headers) as self.answer,
            ):
                fields = {}
                for line in self.answer.iter_lines():
                    self.lines.append(line)
                    name, _, value = line.partition(": ")
                    if line:
                        fields[name] = value
                    elif "event" in fields:
                        told = fields["event"], int(fields["id"]), json.loads(fields["data"])
                        self.events.append(told)
                        self._opened.set()
                        fields = {}
                    else:
                        fields = {}
        except httpx.TransportError:
            pass
        finally:
            self._opened.set()
            self.ended.set()

    def wait_for(self, count, seconds=60):
        wait_until(lambda: len(self.events) >= count, seconds, why=lambda: self.events)
        return self.events


@contextmanager
def service(database):
    with Server(create_app(open_app(in_process_settings(database)))) as address:
        yield address


@pytest.fixture
def database(chosen_database):
    return chosen_database()


def send(address, batches, **changed):
    """Send batches, each of which gets an event of its own: who reads alarms waits for it."""
    with httpx.Client(base_url=address, timeout=60, trust_env=False) as client:
        for each in batches:
            client.post("/api/v1/batches", json=each | changed).raise_for_status()
            client.get("/api/v1/alarms").raise_for_status()


def told_batches(found):
    return [data["latest"]["batch"] for kind, _, data in found if kind == "batches"]


def test_a_batch_is_told_of_when_it_is_recorded(database, drawn):
    with service(database) as address:
        listener = Listener(address)
        (batch,) = drawn("XTE", 1)
        send(address, [batch])
        (hello, told) = listener.wait_for(2)
        assert hello[0] == "hello"
        kind, number, data = told
        assert (kind, number) == ("batches", hello[2]["last"] + 1)
        assert (data["spacecraft"], data["run"], data["batches"]) == ("XTE", "live", 1)
        with httpx.Client(base_url=address, timeout=60, trust_env=False) as client:
            record = client.get(f"/api/v1/batches/{data['latest']['id']}").json()
        answer = record["answer"]
        assert answer["batch"] == batch["batch"]
        assert data["latest"] == {
            "status": answer["attitude"]["status"],
            **{name: answer[name] for name in ("id", "batch", "time", "reason", "counts")},
        }


def test_who_was_away_is_told_of_everything_in_between_and_of_nothing_twice(database, drawn):
    first, *others = drawn("XTE", 6)
    with service(database) as address:
        listener = Listener(address)
        send(address, [first])
        last = listener.wait_for(2)[-1][1]
        send(address, others[:3])
        again = Listener(address, headers={"Last-Event-ID": str(last)})
        again.wait_for(4)
        send(address, others[3:])
        found = again.wait_for(6)
        assert told_batches(found) == [each["batch"] for each in others]
        numbers = [number for kind, number, _ in found if kind != "hello"]
        assert numbers == list(range(last + 1, last + 6))
    # The number is the records', not the process's: it holds after a restart.
    with service(database) as address:
        returned = Listener(address, last_event_id=last)
        assert told_batches(returned.wait_for(6)) == [each["batch"] for each in others]


def test_a_new_listener_hears_of_what_is_recorded_after_the_head_of_its_answer(database):
    """The head is sent once the stream is there, and its lines are read after that."""

    async def first_events(app):
        stream = live.Live(app)
        await stream.start()
        lines = await stream.stream(live.Listener(OPEN_CALLER), None, None, None)
        entry = app.access.entry("me", "add_annotation", "/api/v1/annotations", None, 201)
        time = parse_utc("1996-01-10T12:00:00Z")
        app.annotations.add("slew", start=time, end=None, spacecraft=None, who="me", entry=entry)
        heard = [await asyncio.wait_for(anext(lines), 20) for _ in range(2)]
        await stream.close()
        return b"".join(heard).decode().split("\n\n")

    app = open_app(in_process_settings(database))
    try:
        _, hello, told, _ = asyncio.run(first_events(app))
    finally:
        app.close()
    assert hello == 'id: 0\nevent: hello\ndata: {"last":0}'
    assert told.startswith("id: 1\nevent: annotation\n")


def test_what_another_process_writes_is_told_of_too(postgresql_schemas, drawn):
    """Over PostgreSQL: one process alone writes to a SQLite file."""
    with postgresql_schemas.fresh() as database, service(database) as address:
        listener = Listener(address)
        other = open_app(in_process_settings(database))
        try:
            lines = [json.dumps(each).encode() for each in drawn("SWAS", 3)]
            other.replays.start(lines, "elsewhere")
            seen = []
            for count in range(2, 6):
                seen = listener.wait_for(count)
                kinds = [kind for kind, _, _ in seen]
                # The projector tells of the batches, a fraction of a second after the replay.
                if "batches" in kinds and any(d.get("state") == "done" for _, _, d in seen):
                    break
        finally:
            other.close()
        assert "batches" in kinds
        assert kinds.count("replay") >= 2
        assert sum(d["batches"] for kind, _, d in seen if kind == "batches") == 3


def test_a_database_that_is_away_is_asked_for_events_once_a_second(caplog):
    caplog.set_level("INFO", records.__name__)
    with socket.socket() as nobody:
        # The socket never listens: connections are refused, and no other process takes its port.
        nobody.bind(("127.0.0.1", 0))
        url = make_url(f"postgresql+psycopg://nobody@127.0.0.1:{nobody.getsockname()[1]}/none")
        began = time.monotonic()
        heard = records.HeardEvents(url, lambda: None)
        try:
            wait_until(lambda: len(caplog.records) >= 3, 60)
            assert time.monotonic() - began > 1.9
        finally:
            heard.close()


def test_a_listener_hears_of_its_run_and_spacecraft_alone(database, drawn):
    xte, soho = drawn("XTE", 1)[0], drawn("SOHO", 1)[0]
    with service(database) as address:
        listener = Listener(address, run="mine", spacecraft="XTE")
        send(address, [xte])
        send(address, [soho], run="mine")
        send(address, [xte], run="mine")
        found = listener.wait_for(2)
        assert [(d["run"], d["spacecraft"]) for kind, _, d in found[1:]] == [("mine", "XTE")]


def test_of_replays_nobody_hears_who_asks_for_one_spacecraft(database, drawn):
    """The lines may be about any, and a replay's id lets one ask what was wrong with them."""
    with service(database) as address:
        everything, xte = Listener(address), Listener(address, spacecraft="XTE")
        with httpx.Client(base_url=address, timeout=60, trust_env=False) as client:
            client.post(
                "/api/v1/replays?run=mine",
                content=json.dumps(drawn("SOHO", 1)[0]),
                headers={"Content-Type": "application/x-ndjson"},
            ).raise_for_status()
        for count in range(2, 6):
            if any(d.get("state") == "done" for _, _, d in everything.wait_for(count)):
                break
        send(address, drawn("XTE", 1))
        assert [kind for kind, _, _ in xte.wait_for(2)] == ["hello", "batches"]


def test_a_gap_longer_than_what_is_kept_says_reset(database, drawn, monkeypatch):
    monkeypatch.setattr(records, "KEPT", 3)
    monkeypatch.setattr(records, "PRUNED_EVERY", 1)
    monkeypatch.setattr(live, "HELD", 2)
    with service(database) as address:
        send(address, drawn("XTE", 8))
        hello, reset = Listener(address, last_event_id=1).wait_for(2)
        assert hello[0] == "hello"
        assert reset[0] == "reset"
        assert reset[2]["last"] == 8
        # So does a number that these records never gave out.
        assert Listener(address, last_event_id=1000).wait_for(2)[1][0] == "reset"
        kept = Listener(address, last_event_id=6).wait_for(3)
        assert [number for kind, number, _ in kept if kind == "batches"] == [7, 8]


def test_silence_is_broken_by_a_heartbeat_that_carries_the_place(database, monkeypatch):
    monkeypatch.setattr(live, "HEARTBEAT_S", 0.2)
    with service(database) as address:
        listener = Listener(address)
        wait_until(lambda: any(line.startswith(":") for line in listener.lines))
        assert len(listener.events) == 1


def test_stopping_the_service_ends_the_streams_at_once(database):
    with service(database) as address:
        listener = Listener(address)
    assert listener.ended.is_set() or listener.ended.wait(60)


def test_listeners_are_bounded_and_leave_room_when_they_go(database, monkeypatch):
    monkeypatch.setattr(live, "MAX_LISTENERS", 2)
    with service(database) as address, httpx.Client(base_url=address, trust_env=False) as client:
        with client.stream("GET", ROUTE) as one:
            assert one.status_code == 200
            held = Listener(address)
            refused = client.get(ROUTE)
            assert refused.status_code == 503
            assert int(refused.headers["Retry-After"]) > 0
        wait_until(lambda: Listener(address).answer.status_code == 200, every_s=0.1)
        assert held.answer.headers["content-type"].startswith("text/event-stream")


@pytest.mark.parametrize("sent", ["x", "-1", "9" * 30])
def test_a_number_that_is_none_is_refused(client, sent):
    answer = client.get(ROUTE, headers={"Last-Event-ID": sent})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "Last-Event-ID"
