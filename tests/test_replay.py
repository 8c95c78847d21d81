"""Replay: both ways give equal results, in order, each line once, bad lines by their number."""

import io
import json
import re
import socket
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count

import pytest

from service.app.factory import open_app
from service.errors import BadFile, BadInput, Busy, Forbidden, NotFound, Unauthenticated
from service.observations.csv_rows import write_batches_csv
from service.observations.schema import BatchIn
from service.replay.in_process import replay_in_process
from service.replay.items import Pace, items_of, run_name
from service.replay.over_http import replay_in_bulk, replay_over_http
from service.replay.summary import ReplaySummary
from service.settings import Settings
from service.simulate.stretches import Pass, Trouble, Troubles
from service.simulate.telemetry import draw_pass, read_objects
from service.storage.queries.replay_rows import mark_interrupted
from service.web.app import create_app
from tests.fresh_databases import sqlite_at
from tests.web.serving import Server

SERIOUS = Troubles(Trouble(0.2), Trouble(0.2, 2), Trouble(0.2, 0.5), Trouble(0.2, 12.0))
_names = count(1)
ACCEPTED = {
    "id": "1",
    "run": "run",
    "name": "run",
    "state": "running",
    "errors": [],
    "packets": None,
    "lines": {"total": None, "done": 0, "refused": 0},
    "counts": dict.fromkeys(
        ("new", "repeated", "observed", "unique", "ambiguous", "unmatched", "attitudes"), 0
    ),
    "started": "2026-03-01T12:00:00.000Z",
    "finished": None,
}
"""What the service says of a replay that it just accepted."""


def opened(folder, name="acquire.db"):
    file = folder / name
    url = f"sqlite:///{file}" if file.exists() else sqlite_at(file)
    return open_app(Settings(database=url))


@pytest.fixture(scope="module")
def app(tmp_path_factory):
    app = opened(tmp_path_factory.mktemp("in-process"))
    yield app
    app.close()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """A real server with a database of its own."""
    with Server(create_app(opened(tmp_path_factory.mktemp("served")))) as url:
        yield url


@pytest.fixture(scope="module")
def batches(missions, sky):
    """Nine batches of each mission, all kinds of trouble among them, and of mixed forms."""
    wanted = Pass(9, 5, prior="mixed", angles_share=0.5, troubles=SERIOUS)
    names = ("XTE", "SOHO", "SWAS")
    passes = [[each.batch for each in draw_pass(missions[name], sky, wanted)] for name in names]
    return [batch for three in zip(*passes, strict=True) for batch in three]


@pytest.fixture
def run():
    return f"run-{next(_names)}"


def written(path, lines):
    texts = (line if isinstance(line, str) else json.dumps(line) for line in lines)
    path.write_text("".join(f"{text}\n" for text in texts), encoding="utf-8")
    return path


def replayed(files, run, results, *, app=None, url=None, **how):
    files = files if isinstance(files, list) else [files]
    with ReplaySummary(files, results, progress=False) as summary:
        if url is None:
            replay_in_process(app, items_of(files, run), summary.add, **how)
        else:
            replay_over_http(url, items_of(files, run), summary.add, **how)
    return summary, list(read_objects(results))


def without_circumstances(result):
    """A result without what depends on when and where it was made, not on what was asked."""
    if "problem" in result:
        return result
    result = {key: value for key, value in result.items() if key not in ("id", "timings_us")}
    for tracker in result["observations"]:
        del tracker["zone"]["cached"]
    return result


def bad_lines(batch):
    first = batch["observations"][0]["stars"][0]
    return [
        '{"spacecraft": "XTE", "batch": "cut sho',
        "",
        "[1, 2]",
        {**batch, "batch": "far", "spacecraft": "VOYAGER"},
        {**batch, "batch": "eyes", "observations": [{"tracker": "EYE", "stars": [first]}]},
        {**batch, "batch": "odd", "time": "1996-02-30T00:00:00Z", "aberration": "maybe"},
        re.sub('"magnitude": [0-9.]+', '"magnitude": 1e999', json.dumps({**batch, "batch": "inf"})),
        {**batch, "batch": "turned", "a_priori": {"roll_deg": 3.0}},
        {**batch, "time": "1999-03-01T12:00:00Z"},
        batch,
    ]


def test_both_ways_give_equal_results_star_by_star(app, address, batches, run, tmp_path):
    """Answers and refusals alike, serious errors and bad lines included."""
    middle = len(batches) // 2
    lines = [*batches[:middle], *bad_lines(batches[0]), *batches[middle:]]
    path = written(tmp_path / "pass.ndjson", lines)
    inside, here = replayed(path, run, tmp_path / "in.ndjson", app=app)
    outside, there = replayed(path, run, tmp_path / "out.ndjson", url=address)
    assert [without_circumstances(each) for each in here] == [
        without_circumstances(each) for each in there
    ]
    for summary in (inside, outside):
        assert (summary.new, summary.replayed, summary.refused) == (len(batches), 1, 8)
        assert summary.stars["observed"] == sum(
            len(tracker["stars"])
            for batch in [*batches, batches[0]]
            for tracker in batch["observations"]
        )


def test_files_sent_as_a_whole_come_to_the_same_and_bad_lines_keep_their_place(
    app, address, batches, run, tmp_path, capsys
):
    """NDJSON and CSV in one upload; what one by one is refused is refused, line by line."""
    first = written(tmp_path / "one.ndjson", [*batches[:5], *bad_lines(batches[0]), batches[5]])
    second = tmp_path / "two.csv"
    with second.open("w", newline="") as stream:
        write_batches_csv([BatchIn.model_validate(each) for each in batches[6:9]], stream)
    rows = second.read_text().splitlines()
    rows.insert(2, rows[1].replace("STARTRACKER_1", "STARTRACKER_1,5"))
    second.write_text("\n".join(rows))
    files = [first, second]
    inside, _ = replayed(files, run, tmp_path / "in.ndjson", app=app)
    told_one_by_one = capsys.readouterr().err
    with ReplaySummary(files, progress=False) as summary:
        replay_in_bulk(address, files, run, summary.add, summary.follow)
    told = capsys.readouterr().err
    assert sorted(told.splitlines()) == sorted(told_one_by_one.splitlines())
    assert f"{first}:9: spacecraft: there is no such" in told
    for name in ("new", "replayed", "refused", "attitudes", "stars"):
        assert getattr(summary, name) == getattr(inside, name), name


def test_a_replay_that_a_starting_process_calls_interrupted_is_followed_to_its_end(
    missions, sky, run, tmp_path
):
    many = [each.batch for each in draw_pass(missions["XTE"], sky, Pass(1_000, 5))]
    app, states = opened(tmp_path), []

    def call_interrupted(state):
        if state.state == "running":
            # What a process does with the replays that it finds at work when it opens the database.
            app.context.change(lambda connection: mark_interrupted(connection, state.started))
            states.append(app.replays.get(state.id).state)
        states.append(state.state)

    with Server(create_app(app)) as url:
        files = [written(tmp_path / "many.ndjson", many)]
        replay_in_bulk(url, files, run, print, call_interrupted)
        recorded = app.runs.all()
    assert states[-1] == "done"
    assert "interrupted" in states
    assert [each.batches for each in recorded if each.run == run] == [len(many)]


def test_a_service_that_is_not_there_is_named_before_anything_is_read(run, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(Busy, match=r"no service answers at .*acquire serve"):
        replay_in_bulk(f"http://127.0.0.1:{port}", [], run, print, print)


@pytest.mark.parametrize(
    ("status", "kind"), [(401, Unauthenticated), (403, Forbidden), (404, NotFound)]
)
def test_who_may_not_follow_a_replay_is_told_so_at_once(status, kind, run, tmp_path):
    """In the service's own words, not that it no longer answers."""

    class Refusing(BaseHTTPRequestHandler):
        def do_POST(self):
            while size := int(self.rfile.readline(), 16):
                self.rfile.read(size + 2)
            self.rfile.readline()
            self.answer(202, ACCEPTED)

        def do_GET(self):
            self.answer(status, {"detail": "in its own words"})

        def answer(self, status, told):
            body = json.dumps(told).encode()
            self.send_response(status)
            self.send_header("Location", "/api/v1/replays/1")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *given):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Refusing) as server:
        threading.Thread(target=server.serve_forever).start()
        url, files = f"http://127.0.0.1:{server.server_port}", [written(tmp_path / "a", [{}])]
        try:
            with pytest.raises(kind, match="in its own words"):
                replay_in_bulk(url, files, run, print, print)
        finally:
            server.shutdown()


def test_bad_lines_are_told_by_number_and_field_and_the_rest_goes_on(
    app, batches, run, tmp_path, capsys
):
    path = written(tmp_path / "pass.ndjson", [batches[0], *bad_lines(batches[0]), batches[1]])
    summary, results = replayed(path, run, tmp_path / "out.ndjson", app=app)
    problems = {each["line"]: each["problem"] for each in results if "problem" in each}
    assert list(problems) == [2, 4, 5, 6, 7, 8, 9, 10]
    assert problems[5]["detail"].startswith("spacecraft: there is no such spacecraft;")
    assert problems[5]["errors"][0]["value"] == "'VOYAGER'"
    assert problems[6]["errors"][0]["field"] == "observations.0.tracker"
    assert {each["field"] for each in problems[7]["errors"]} == {"time", "aberration"}
    assert "magnitude" in problems[8]["errors"][0]["field"]
    assert problems[9]["errors"][0]["field"] == "a_priori"
    assert results[-1]["batch"] == batches[1]["batch"]
    told = capsys.readouterr().err
    assert f"{path}:5: spacecraft: there is no such" in told
    assert summary.refused == 8


@pytest.mark.parametrize("concurrency", [1, 16])
def test_results_stand_in_input_order_exactly_as_answered(
    address, batches, run, tmp_path, concurrency
):
    path = written(tmp_path / "pass.ndjson", batches)
    _, results = replayed(path, run, tmp_path / "a", url=address, concurrency=concurrency)
    assert [each["batch"] for each in results] == [each["batch"] for each in batches]
    assert {each["run"] for each in results} == {run}
    for result, batch in zip(results, batches, strict=True):
        assert [len(each["stars"]) for each in result["observations"]] == [
            len(each["stars"]) for each in batch["observations"]
        ]


@pytest.mark.parametrize("way", ["in process", "http"])
def test_a_second_time_nothing_is_new_and_every_answer_is_the_same(
    app, address, batches, run, tmp_path, way
):
    path = written(tmp_path / "pass.ndjson", batches)
    where = {"url": address} if way == "http" else {"app": app}
    replayed(path, run, tmp_path / "first", **where)
    summary, _ = replayed(path, run, tmp_path / "second", **where)
    assert (summary.new, summary.replayed, summary.refused) == (0, len(batches), 0)
    assert (tmp_path / "first").read_bytes() == (tmp_path / "second").read_bytes()
    assert "already recorded  27" in summary.table()


def test_rows_and_json_are_one_run(app, batches, run, tmp_path):
    """A CSV file of batches that were replayed as NDJSON brings nothing new."""
    json_file = written(tmp_path / "pass.ndjson", batches)
    csv_file = tmp_path / "pass.csv"
    with csv_file.open("w", newline="", encoding="utf-8") as file:
        write_batches_csv((BatchIn.model_validate_json(json.dumps(each)) for each in batches), file)
    replayed(json_file, run, tmp_path / "a", app=app)
    summary, _ = replayed(csv_file, run, tmp_path / "b", app=app)
    assert (summary.new, summary.replayed) == (0, len(batches))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_bad_row_of_a_csv_file_is_told_by_line_and_column(app, batches, run, tmp_path):
    path = tmp_path / "pass.csv"
    text = io.StringIO(newline="")
    write_batches_csv((BatchIn.model_validate_json(json.dumps(each)) for each in batches[:3]), text)
    rows = text.getvalue().splitlines()
    at = next(
        k for k, row in enumerate(rows) if batches[1]["batch"] in row and ",SOHO" in f",{row}"
    )
    cells = rows[at].split(",")
    cells[rows[0].split(",").index("magnitude")] = "dim"
    rows[at] = ",".join(cells)
    path.write_text("\n".join(rows), encoding="utf-8")
    summary, results = replayed(path, run, tmp_path / "out", app=app)
    assert (summary.new, summary.refused) == (2, 1)
    assert results[1] == {
        "line": at + 1,
        "problem": {
            "detail": f"line {at + 1}, column magnitude: must be a number (got 'dim')",
            "errors": [
                {
                    "field": f"line {at + 1}, column magnitude",
                    "message": "must be a number",
                    "value": "'dim'",
                }
            ],
        },
    }


def test_several_files_are_one_run_and_a_refusal_names_its_file(
    app, batches, run, tmp_path, capsys
):
    files = [
        written(tmp_path / "one.ndjson", batches[:2]),
        written(tmp_path / "two.ndjson", ["{", batches[2]]),
    ]
    summary, results = replayed(files, run, tmp_path / "out", app=app)
    assert (summary.new, summary.refused) == (3, 1)
    assert set(results[2]) == {"line", "problem"}
    assert results[2]["line"] == 1
    assert f"{files[1]}:1: " in capsys.readouterr().err


class Unreliable:
    """The real app on a bad day: every third post is turned away, every fourth answer is lost."""

    def __init__(self, web_app):
        self.app, self.posts, self.lock = web_app, 0, threading.Lock()

    async def __call__(self, scope, receive, send):
        if scope["type"] != "http" or scope["method"] != "POST":
            await self.app(scope, receive, send)
            return
        with self.lock:
            self.posts += 1
            number = self.posts
        if number % 3 == 0:
            headers = [(b"retry-after", b"0")]
            await send({"type": "http.response.start", "status": 503, "headers": headers})
            await send({"type": "http.response.body", "body": b""})
        elif number % 4 == 0:

            async def lose(message):
                body = message.get("body", b"")
                if message["type"] == "http.response.body":
                    message = {**message, "body": body[: len(body) // 2]}
                await send(message)

            # What was done stays done; the client sees the connection close.
            await self.app(scope, receive, lose)
        else:
            await self.app(scope, receive, send)


def test_busy_answers_and_lost_ones_are_asked_again_and_nothing_is_doubled(batches, run, tmp_path):
    path = written(tmp_path / "pass.ndjson", batches)
    app = opened(tmp_path)
    unreliable = Unreliable(create_app(app))
    with Server(unreliable) as url:
        summary, results = replayed(path, run, tmp_path / "out", url=url)
        stored = app.results.page(
            spacecraft=None,
            run=run,
            start=None,
            end=None,
            outcome=None,
            status=None,
            limit=100,
            cursor=None,
        )
    assert unreliable.posts > len(batches)
    assert summary.refused == 0
    assert summary.new + summary.replayed == len(batches) == len(stored.items)
    assert summary.replayed > 0
    assert [each["batch"] for each in results] == [each["batch"] for each in batches]


def test_a_replay_that_was_cut_off_goes_on_where_it_stopped(batches, run, tmp_path):
    path = written(tmp_path / "pass.ndjson", batches)
    server = Server(create_app(opened(tmp_path)))

    def stopping_after(number, items):
        for index, item in enumerate(items):
            if index == number:
                server.__exit__()
            yield item

    with ReplaySummary([path], None, progress=False) as summary:
        url = server.__enter__()
        with pytest.raises(Busy, match="run the same command again to go on"):
            replay_over_http(
                url,
                stopping_after(10, items_of([path], run)),
                summary.add,
                concurrency=1,
                give_up_after_s=0.2,
            )
    done = summary.new
    assert 9 <= done <= 10
    with Server(create_app(opened(tmp_path))) as url:
        summary, _ = replayed(path, run, tmp_path / "out", url=url)
    # The answer of one more may have been on its way.
    assert done <= summary.replayed <= done + 1
    assert summary.replayed + summary.new == len(batches)


def test_batches_are_sent_at_their_own_times_sped_up(app, address, missions, sky, tmp_path):
    """Five batches a second apart, at twenty times the speed, are sent within a fifth of one."""
    drawn = list(draw_pass(missions["XTE"], sky, Pass(5, 9, cadence_s=1.0)))
    path = written(tmp_path / "pass.ndjson", [each.batch for each in drawn])
    pace = Pace(20.0)
    due_s = [pace.wait_s(item, 100.0) for item in items_of([path], "run")]
    assert due_s == pytest.approx([0.0, 0.05, 0.1, 0.15, 0.2], abs=1e-6)
    assert pace.wait_s(next(items_of([path], "run")), 101.0) == 0.0
    for run, where in (("paced-1", {"app": app}), ("paced-2", {"url": address})):
        start = time.monotonic()
        replayed(path, run, tmp_path / "out", pace=Pace(20.0), **where)
        # Never earlier; how much later depends on the machine.
        assert time.monotonic() - start >= 0.2


def test_where_no_service_answers_it_is_said_at_once(tmp_path, batches):
    path = written(tmp_path / "pass.ndjson", batches)
    (tmp_path / "out").write_text("of an earlier run")
    with socket.socket() as silent:
        # Nobody listens, and nobody else can take the port meanwhile.
        silent.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(Busy, match=f"no service answers at {url}") as refusal:
            replayed(path, "run", tmp_path / "out", url=url)
    assert "acquire serve" in str(refusal.value)
    assert (tmp_path / "out").read_text() == "of an earlier run"


@pytest.mark.parametrize("url", ["", "127.0.0.1:8000", "ftp://127.0.0.1", "http://"])
def test_an_address_that_is_none_is_refused(url, tmp_path):
    with pytest.raises(BadInput, match="--url: must be the address of a service"):
        replay_over_http(url, [], lambda outcome: None)


def test_the_run_is_named_or_takes_the_first_files_stem(tmp_path):
    files = [tmp_path / "night-7.ndjson", tmp_path / "other.csv"]
    assert run_name(files, None) == "night-7"
    assert run_name(files, "mine") == "mine"
    with pytest.raises(BadInput, match="--run: a run has 1 to 64 of"):
        run_name(files, "no spaces")
    with pytest.raises(BadInput, match=r"my pass\.ndjson, whose stem would name the run"):
        run_name([tmp_path / "my pass.ndjson"], None)


def test_a_file_without_a_batch_leaves_results_without_a_line(app, run, tmp_path):
    (tmp_path / "out").write_text("of an earlier run")
    replayed(written(tmp_path / "pass", []), run, tmp_path / "out", app=app)
    assert (tmp_path / "out").read_bytes() == b""


@pytest.mark.parametrize("place", ["", "none/out"])
def test_a_place_for_results_that_cannot_be_is_refused_beforehand(tmp_path, place):
    with pytest.raises(BadFile, match="cannot be written"):
        ReplaySummary([], tmp_path / place)
