"""The client against the real service: batches, lists, errors, retries, tables, replays."""

import asyncio
import doctest
import inspect
import json
import socket
import threading
import time
from contextlib import aclosing, contextmanager
from datetime import UTC, datetime, timedelta, timezone
from email.utils import format_datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pkgutil import iter_modules
from unittest.mock import create_autospec

import httpx
import numpy as np
import pytest
from acquire_client import (
    AsyncClient,
    BadInput,
    Busy,
    Client,
    ClientError,
    Conflict,
    EventsLost,
    InvalidArgument,
    NoAnswer,
    NotFound,
    Problem,
    ReplayEnded,
    Unauthenticated,
    UnexpectedAnswer,
    errors,
    methods,
    operations,
)
from acquire_client._sync import client as whole
from acquire_client._sync import connection
from acquire_client.encoding import json_of
from acquire_client.errors import problem_of
from sqlalchemy import update

from service import access
from service.app.factory import open_app
from service.missions.mission import load_missions
from service.storage.recording import events as records
from service.storage.recording.ids import Ulids
from service.storage.sql import tables
from service.times import shifted, utc_now
from service.web import event_stream as live
from service.web.app import create_app
from tests.client.cutting_proxy import CuttingProxy
from tests.features.tracks.drawn import conjunctions, draw
from tests.web.serving import Server, in_process_settings

GYRO = {
    "block": "g1",
    "start": "1996-01-10T12:00:00Z",
    "step_s": 0.5,
    "rates_rad_per_s": [[1e-3, 0.0, 0.0], [1.1e-3, 0.0, 1e-5]],
}


def test_the_examples_of_the_methods_give_what_they_show(client, example, tmp_path, monkeypatch):
    """Of the synchronous client; the asynchronous one's are the same with `await`."""
    client.submit(example)
    (tmp_path / "pass.ndjson").write_text(json.dumps(example) + '\n{"cut": \n', "utf-8")
    monkeypatch.chdir(tmp_path)
    tried = 0
    of_routes = [getattr(methods, each.name) for each in iter_modules(methods.__path__)]
    for module in (whole, operations, *of_routes):
        found = doctest.testmod(
            module, extraglobs={"client": client, "batch": example, "block": GYRO}
        )
        assert found.failed == 0
        tried += found.attempted
    assert tried > 20


def test_a_batch_is_recorded_once_however_often_it_is_sent(client, drawn):
    (batch,) = drawn(1)
    first, second = client.submit_json(batch), client.submit_json(json.dumps(batch).encode())
    assert (first.replayed, second.replayed) == (False, True)
    assert first.body == second.body
    with pytest.raises(Conflict, match="another body"):
        client.submit(batch | {"time": "1999-03-02T12:00:00Z"})


def test_a_batch_may_hold_numpys_arrays(client, example):
    stars = example["observations"][0]["stars"]
    vectors = np.array([each["vector"] for each in stars])
    held = [star | {"vector": row} for star, row in zip(stars, vectors, strict=True)]
    batch = example | {"batch": "arrays"}
    batch["observations"] = [example["observations"][0] | {"stars": held}]
    assert client.submit(batch).counts.unique == 4


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "much"])
def test_a_faulty_field_is_named_with_its_value(client, example, value):
    batch = json.loads(json.dumps(example))
    batch["observations"][0]["stars"][2]["magnitude"] = value
    with pytest.raises(BadInput) as refusal:
        client.submit(batch)
    (fault,) = refusal.value.errors
    assert fault.field == "observations.0.stars.2.magnitude"
    assert refusal.value.status == 422
    assert "observations.0.stars.2.magnitude" in str(refusal.value)


def test_many_batches_come_back_in_order_with_the_refused_ones_among_them(client, drawn):
    sent = drawn(40)
    sent[7] = sent[7] | {"aberration": "perhaps"}
    outcomes = list(client.submit_many(iter(sent), at_once=6))
    assert [each.batch for each in outcomes] == sent
    assert [n for n, each in enumerate(outcomes) if each.problem is not None] == [7]
    answers = [each.answer for each in outcomes if each.problem is None]
    assert [each.batch for each in answers] == [b["batch"] for n, b in enumerate(sent) if n != 7]
    with pytest.raises(BadInput, match="aberration"):
        _ = outcomes[7].answer


def test_the_asynchronous_client_gives_the_same(address, client, drawn):
    sent = drawn(6)
    run = sent[0]["run"]

    async def ask():
        async with AsyncClient(address) as asking:
            outcomes = [each async for each in asking.submit_many(sent, at_once=3)]
            listed = await asking.batches("XTE", run=run).all()
            table = await asking.attitudes("XTE", run=run).to_arrow()
            note = {"text": "async", "start": "1999-03-01T12:00:00Z", "who": "a test"}
            await asking.request("POST", "/api/v1/annotations", body=note)
            heard = []
            async with aclosing(aiter(asking.events(after=0))) as events:
                async for event in events:
                    heard.append(event.id)
                    if event.kind == "annotation" and event.data.text == "async":
                        break
            states = [
                each.state
                async for each in asking.follow_replay(
                    (await asking.start_replay(json.dumps(sent[0]).encode(), "async")).id
                )
            ]
            return outcomes, listed, table, heard, states

    outcomes, listed, table, heard, states = asyncio.run(ask())
    assert [each.answer for each in outcomes] == [client.submit(each) for each in sent]
    assert listed == list(client.batches("XTE", run=run))
    assert table == client.attitudes("XTE", run=run).to_arrow()
    assert len(heard) > 1
    assert heard == list(range(1, len(heard) + 1))
    assert states[-1] == "done"


@pytest.mark.parametrize("name", ["submit", "what_if", "latest"])
def test_methods_of_the_asynchronous_client_are_coroutine_functions(name):
    assert inspect.iscoroutinefunction(getattr(AsyncClient, name))
    assert not inspect.iscoroutinefunction(getattr(Client, name))


def test_a_double_of_a_client_is_called_as_the_client_is():
    double = create_autospec(AsyncClient, instance=True)
    double.submit.return_value = "answered"
    assert asyncio.run(double.submit({})) == "answered"
    assert create_autospec(Client, instance=True).submit({}) is not None
    assert not asyncio.iscoroutine(double.batches("XTE"))
    for each in (double, create_autospec(Client, instance=True)):
        with pytest.raises(TypeError, match="batch"):
            each.submit()


def test_an_argument_that_is_none_is_refused_when_the_call_is_awaited():
    call = AsyncClient("http://127.0.0.1:9").submit({"magnitude": object()})
    with pytest.raises(InvalidArgument):
        asyncio.run(call)


def test_a_class_below_a_client_keeps_its_own_methods():
    class Own(Client):
        def latest(self, spacecraft):
            return "own"

    class Below(Own):
        pass

    assert Below("http://127.0.0.1:9").latest("XTE") == "own"


def test_batches_without_an_attitude_are_asked_for_by_the_word_of_the_api(client, drawn):
    whole, cut = drawn(2)
    cut["observations"] = [cut["observations"][0] | {"stars": cut["observations"][0]["stars"][:1]}]
    for each in (whole, cut):
        client.submit(each)
    (found,) = client.batches("XTE", run=whole["run"], status="none")
    assert found.batch == cut["batch"]


def test_pages_are_read_as_they_are_needed(client, drawn, monkeypatch):
    monkeypatch.setattr(connection, "ITEMS_A_PAGE", 7)
    sent = drawn(30, "paged")
    for each in client.submit_many(sent):
        assert each.problem is None
    asked = []
    monkeypatch.setattr(
        client, "request", lambda *a, **k: asked.append(a) or Client.request(client, *a, **k)
    )
    found = client.batches(run="paged")
    assert next(iter(found)).batch == sent[-1]["batch"]
    assert len(asked) == 1
    assert [each.batch for each in found] == [each["batch"] for each in reversed(sent)]
    assert len(asked) == 1 + 5


def test_a_time_may_be_a_datetime_with_a_zone(client, drawn):
    first, second, third = drawn(3, "times")
    for each in (first, second, third):
        client.submit(each)
    start = datetime.fromisoformat(second["time"]).astimezone(timezone(timedelta(hours=5)))
    found = [each.batch for each in client.attitudes("XTE", run="times", start=start)]
    assert found == [second["batch"], third["batch"]]
    with pytest.raises(ValueError, match="start must have a time zone"):
        list(client.batches(start=datetime(1999, 3, 1)))


def test_tables_have_a_row_for_each_item_and_the_same_values(client, drawn):
    pandas = pytest.importorskip("pandas")
    for each in drawn(12, "tables"):
        client.submit(each | {"options": {"identifier": "starid"}})
    rows = client.attitudes("XTE", run="tables").all()
    table = client.attitudes("XTE", run="tables").to_arrow()
    assert table["quaternion"].to_pylist() == [list(each.quaternion) for each in rows]
    listed = client.batches(run="tables")
    frame = listed.to_pandas()
    assert isinstance(frame, pandas.DataFrame)
    assert list(frame["counts.unique"]) == [each.counts.unique for each in listed]
    assert json.loads(frame["options"][0]) == {"identifier": "starid"}
    assert dict(frame["measures"][0]) == pytest.approx(next(iter(listed)).measures, nan_ok=True)
    empty = client.attitudes("SWAS", run="tables").to_arrow()
    assert (empty.num_rows, empty.schema) == (0, table.schema)
    for strategy, column in (("minmax", "residual_rms_arcsec.mean"), ("latest", "batch")):
        history = client.history("XTE", run="tables", strategy=strategy)
        assert history.to_arrow().num_rows == len(history.unix_s)
        assert column in history.to_pandas().columns


def test_tracks_are_those_of_the_service(client, sky):
    """An object among the stars, two planets and three hot pixels."""
    rng = np.random.default_rng(7)
    stretch = conjunctions(rng, 1)[0]
    for each in draw(load_missions()["XTE"], sky, stretch, rng).with_points:
        client.submit(each | {"run": "tracks"})
    found = client.tracks("XTE", run="tracks")
    kinds = sorted(each.kind for each in found.items)
    assert kinds == ["fixed_on_detector"] * 3 + ["moving"] + ["planet"] * 2
    (moving,) = [each for each in found.items if each.kind == "moving"]
    assert client.batch(moving.points[0].id).answer.run == "tracks"
    tdm = client.tracks_tdm("XTE", run="tracks")
    assert tdm.startswith("CCSDS_TDM_VERS")
    assert tdm.count("META_START") == 1
    with pytest.raises(NotFound):
        client.tracks_tdm("XTE", run="tracks", end=found.items[0].first)


def test_a_replay_is_followed_to_its_end_and_its_refused_lines_are_told(client, drawn, tmp_path):
    file, states = tmp_path / "pass.ndjson", []
    lines = [json.dumps(each) for each in drawn(20)]
    lines.insert(3, '{"spacecraft": "XTE"')
    file.write_text("\n".join(lines), encoding="utf-8")
    done = client.replay(file, "replayed", progress=states.append)
    assert (done.state, done.counts.new, done.lines.refused) == ("done", 20, 1)
    assert [each.line for each in done.errors] == [4]
    assert states[-1] == done
    again = client.replay((line.encode() + b"\n" for line in lines), "replayed")
    assert (again.counts.new, again.counts.repeated) == (0, 20)
    with pytest.raises(BadInput, match="run"):
        client.replay(file, "no spaces")
    with pytest.raises(ReplayEnded, match="ended as failed"):
        client.replay(b"\n" * 1_000_010, "blank")


def test_the_first_answer_of_a_what_if_stays_and_the_adopted_one_stands(client, example):
    first = client.submit(example | {"batch": "adopted"})
    adopted = client.adopt(first.id, {"identifier": "starid"})
    assert adopted.parent == first.id
    result = client.batch(first.id)
    assert not result.current
    assert [each.current for each in result.what_ifs] == [True]
    assert client.submit(example | {"batch": "adopted"}) == first


def test_a_missing_thing_is_named(client):
    with pytest.raises(NotFound, match="VOYAGER"):
        client.spacecraft("VOYAGER")
    with pytest.raises(NotFound):
        client.alarm("../batches")
    with pytest.raises(BadInput, match="limit"):
        client.worst("XTE", "residual_rms_arcsec", limit=0)


def test_a_token_is_needed_and_sent(chosen_database):
    app = open_app(in_process_settings(chosen_database()))
    secret, now = access.new_secret(), utc_now()
    reading = {"name": "reader", "scopes": ["read"], "spacecraft": None, "rate_per_s": None}
    app.store.writer.change(
        lambda connection: access.add_token(
            connection,
            id=Ulids().new(),
            secret=secret,
            created=now.text,
            expires=shifted(now, 3600).text,
            **reading,
        )
    )
    with Server(create_app(app)) as url:
        with Client(url) as stranger, pytest.raises(Unauthenticated):
            stranger.session()
        with Client(url, secret) as reader:
            assert (reader.session().name, reader.session().scopes) == ("reader", ["read"])
            with pytest.raises(errors.Forbidden, match="submit"):
                reader.submit({})


def test_an_address_that_is_none_is_refused():
    for url in ("", "127.0.0.1:8000", "ftp://127.0.0.1", "http://"):
        with pytest.raises(ValueError, match="must be the address of a service"):
            Client(url)


@pytest.mark.parametrize("token", ["acq_secret\nX: y", "acq_secr\u00e9t", "acq_sec ret", " \n"])
def test_a_token_that_no_header_can_carry_is_refused_and_not_shown(token):
    with pytest.raises(InvalidArgument) as refusal:
        Client("http://127.0.0.1:1", token)
    assert isinstance(refusal.value, ClientError)
    assert "sec" not in str(refusal.value)


def test_a_token_from_a_file_may_end_in_a_newline():
    with Client("http://127.0.0.1:1", "acq_secret\n") as client:
        assert client._http.headers["Authorization"] == "Bearer acq_secret"


def test_what_json_has_no_form_for_is_an_error_of_the_client(client, example):
    moment = datetime(1996, 1, 10, 12, tzinfo=UTC)
    answer = client.submit(example | {"batch": "a datetime", "time": moment})
    assert answer.time == "1996-01-10T12:00:00.000Z"
    for value in (moment.replace(tzinfo=None), object(), {1, 2}):
        with pytest.raises(InvalidArgument):
            client.submit(example | {"time": value})


def test_a_redirect_says_where_it_leads():
    request = httpx.Request("GET", "http://service.example/api/v1/runs")
    moved = httpx.Response(302, headers={"Location": "https://new.example/"}, request=request)
    assert "leads to https://new.example/" in str(problem_of(moved))


def test_a_replay_that_waits_for_a_restart_is_followed_to_its_end(app, client, drawn):
    """It reads `waiting` until the service resumes it, however long that takes."""
    begun = client.start_replay(b"\n".join(map(json_of, drawn(2))), "waits")
    states = list(client.follow_replay(begun.id))
    assert states[-1].state == "done"

    def set_state(**values):
        change = update(tables.replays).where(tables.replays.c.id == begun.id).values(**values)
        app.context.change(lambda connection: connection.execute(change))

    set_state(state="waiting", finished=None)
    seen = []
    for state in client.follow_replay(begun.id, every_s=0.01):
        seen.append(state.state)
        if len(seen) == 3:
            set_state(state="done")
    assert seen == ["waiting", "waiting", "waiting", "done"]


def test_where_no_service_answers_it_is_said_after_the_patience_is_over():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with Client(f"http://127.0.0.1:{port}", give_up_after_s=0.5) as client:
        begun = time.monotonic()
        with pytest.raises(NoAnswer, match="gives no answer"):
            client.fleet()
        with pytest.raises(NoAnswer, match="gives no answer"):
            list(client.events())
        assert time.monotonic() - begun < 30, "a patience of its own was not used"
        with pytest.raises(NoAnswer):
            client.ping()


def test_a_batch_whose_answer_was_cut_off_is_sent_again(address, client, drawn):
    """Through a proxy that cuts all connections while forty batches are on their way."""
    sent = drawn(40, "cut")
    with CuttingProxy(int(address.rpartition(":")[2])) as proxy, Client(proxy.url) as cut_off:
        outcomes = []
        for outcome in cut_off.submit_many(sent, at_once=4):
            outcomes.append(outcome)
            if len(outcomes) % 8 == 0:
                proxy.cut()
        assert proxy.cuts > 0
    assert [each.problem for each in outcomes] == [None] * 40
    assert len(client.batches(run="cut").all()) == 40


@contextmanager
def answering(status, headers, body=b""):
    """A service whose first answer is this one, and every later one an empty list."""
    times = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            times.append(time.monotonic())
            first = len(times) == 1
            sent = body if first else b'{"items": []}'
            self.send_response(status if first else 200)
            for name, value in headers.items() if first else ():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(sent)))
            self.end_headers()
            self.wfile.write(sent)

        def do_POST(self):
            self.rfile.read(int(self.headers["Content-Length"]))
            self.do_GET()

        def log_message(self, *given):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            with Client(f"http://127.0.0.1:{server.server_port}") as client:
                yield client, times
        finally:
            server.shutdown()


def in_seconds(count):
    return format_datetime(datetime.now(UTC) + timedelta(seconds=count), usegmt=True)


@pytest.mark.parametrize("asked", ["seconds", "date"])
@pytest.mark.parametrize("status", [429, 503])
@pytest.mark.slow("503")
def test_the_client_waits_as_long_as_it_is_asked_to(status, asked):
    # A date has whole seconds: two from now are more than one.
    value = "1" if asked == "seconds" else in_seconds(2)
    with answering(status, {"Retry-After": value}) as (client, times):
        assert client.runs() == []
        first, second = times
        assert 1.0 <= second - first < 4.0


def test_a_wait_that_is_no_time_is_none():
    asked = {"Retry-After": "Wed, 01 Jan 99999999999999999999 00:00:00 GMT"}
    with answering(503, asked) as (client, times):
        assert client.runs() == []
        assert len(times) == 2


def test_a_wait_beyond_the_patience_is_not_begun():
    with answering(503, {"Retry-After": "3600"}) as (client, times):
        with pytest.raises(Busy) as refusal:
            client.runs()
        assert refusal.value.retry_after_s == 3600.0
        assert len(times) == 1


def test_what_may_have_been_done_is_not_asked_for_twice():
    with answering(503, {}) as (client, times):
        with pytest.raises(Busy):
            client.acknowledge("an alarm")
        assert len(times) == 1


def test_an_answer_of_something_else_is_told_with_its_beginning():
    with answering(418, {}, b"a teapot") as (client, _):
        with pytest.raises(Problem, match="HTTP 418: a teapot"):
            client.runs()
        with pytest.raises(UnexpectedAnswer, match="/api/v1/session"):
            client.session()


def test_events_that_the_service_no_longer_keeps_are_an_error_with_the_place_to_go_on(
    chosen_database, drawn, monkeypatch
):
    monkeypatch.setattr(records, "KEPT", 3)
    monkeypatch.setattr(records, "PRUNED_EVERY", 1)
    monkeypatch.setattr(live, "HELD", 2)
    settings = in_process_settings(chosen_database())
    sent = drawn(9)
    with Server(create_app(open_app(settings))) as url, Client(url) as client:
        for each in sent[:8]:
            client.submit(each)
            # Who reads alarms waits for the event of the batch: each has one of its own.
            httpx.get(f"{url}/api/v1/alarms").raise_for_status()
    # A service that started since holds no events in memory.
    with Server(create_app(open_app(settings))) as url, Client(url) as client:
        events = client.events(after=1)
        with pytest.raises(EventsLost, match="no longer keeps all events after 1") as lost:
            next(iter(events))
        assert (lost.value.after, lost.value.resumes_after) == (1, 8)
        client.submit(sent[8])
        assert next(iter(events)).data.latest.batch == sent[8]["batch"]
        # So does a number that these records never gave out.
        with pytest.raises(EventsLost):
            next(iter(client.events(after=1000)))


def test_an_event_with_other_separators_in_its_text_stays_one(client):
    text = "one\u2028two\u0085three"
    last = max((event.id for event in _so_far(client)), default=0)
    note = {"text": text, "start": "1999-03-01T12:00:00Z", "who": "a test"}
    client.request("POST", "/api/v1/annotations", body=note)
    event = next(event for event in client.events(after=last) if event.kind == "annotation")
    assert event.data.text == text


def _so_far(client):
    """The events until now: those before an annotation that is written last."""
    note = {"text": "until here", "start": "1999-03-01T12:00:00Z", "who": "a test"}
    client.request("POST", "/api/v1/annotations", body=note)
    for event in client.events(after=0):
        yield event
        if event.kind == "annotation" and event.data.text == "until here":
            return


def test_tokens_are_made_listed_and_revoked(chosen_database):
    """The first token ends open access."""
    app = open_app(in_process_settings(chosen_database()))
    with Server(create_app(app)) as address:
        tokens_through(address)


def tokens_through(address):
    with Client(address) as open_client:
        made = open_client.create_token("ops", ["read", "operate"])
    with Client(address, token=made.token) as client:
        bound = client.create_token("pipeline", ["submit"], spacecraft=["XTE"], rate_per_s=5.0)
        assert (bound.spacecraft, bound.state) == (["XTE"], "good")
        assert client.revoke_token("pipeline").state == "revoked"
        assert [each.name for each in client.tokens()] == ["ops", "pipeline"]
