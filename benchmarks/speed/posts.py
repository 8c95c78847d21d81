"""Posts one by one against a no-op, in bulk against parsing and inserting, and both together.

    python -m benchmarks posts

The service runs as it is served, a process of its own over a SQLite file with
synchronous=FULL; batches are live ones of a nominal pass, five stars, by votes.
The no-op is the same framework and server, and the same body: its route declares
the batch as its body, so that the framework checks it, and answers a small JSON
(`benchmarks.speed.no_op`); one that takes any JSON stands beside it.  Every answer is looked
at: each post is recorded, new, and its stars are named as the pass drew them.
"""

import itertools
import json
import sqlite3
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.bounds import Bound, at_least, at_most, equal
from benchmarks.report import Report
from benchmarks.speed.load import Driven, drive, get, request
from benchmarks.speed.serving import START_S, Served, no_op, service
from service.app.factory import open_app
from service.missions.mission import CAP_START, load_missions
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import DrawnBatch, draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel

API = "/api/v1"
FIRST = datetime.fromisoformat(CAP_START)
CONNECTIONS = 16
POSTS, QUICK_POSTS = 2_000, 800
"""Posts of one turn: few, so that a server and its no-op meet an equal load."""
ONE_BY_ONE = 200
"""Posts of one turn over one connection."""
BULK, QUICK_BULK = 30_000, 3_000
ROUNDS, QUICK_ROUNDS = 9, 3
PACED, QUICK_PACED = 1_000, 200
GAP_S = 0.02
"""Seconds between the posts of a connection when waiting times are measured."""
CHUNK = 250
LEAST_OF_NO_OP, LEAST_OF_CEILING, MOST_WAIT, MOST_READY_S = 0.25, 0.5, 3.0, 3.0
MOST_CPU_US = {8: 1_000.0, 1: 1_400.0}
"""Greatest processor time of a post in microseconds, by number of connections."""
MOST_OF_LIVEZ, MOST_BYTES = 4.0, 2_500.0
MOST_READY_MB, MOST_AFTER_MB, MOST_BULK_MB = 700.0, 800.0, 1600.0
"""Greatest memory in MB of all processes of the service together."""
MOST_FIRST = 1.5
"""Greatest delay of the first post over later ones, in durations of consecutive posts.

Durations after a pause are no unit: a processor that slept makes them 1.3 or 3 ms.
"""
STARTS, SEEN, LATER, PAUSE_S = 9, 40, 5, 0.05
RIGHT = 0.98
ALARM_LOAD, MOST_ALARM_S = 500, 0.5
"""Posts per second under load, and greatest delay of an alarm in seconds."""


@dataclass(frozen=True)
class Telemetry:
    """Batches of a pass, with the true star ids of each."""

    drawn: Sequence[DrawnBatch]
    _seconds: Iterator[int] = field(default_factory=itertools.count)

    def bodies(self, count: int, tag: str) -> list[bytes]:
        """Bodies of `count` posts, each with a name of its own."""
        return [self.body(k, f"{tag}-{k}") for k in range(count)]

    def body(self, k: int, name: str) -> bytes:
        """Body of one post with a name, dated one second after the previous one.

        A tracker's batches must be in order of time.  Stars move less than an arcsecond in a day.
        """
        time = (FIRST + timedelta(seconds=next(self._seconds))).strftime("%Y-%m-%dT%H:%M:%SZ")
        own = {"options": {"identifier": "starid"}, "batch": name, "time": time}
        return json.dumps(self._of(k).batch | own).encode()

    def _of(self, k: int) -> DrawnBatch:
        return self.drawn[k % len(self.drawn)]

    def right(self, k: int, answer: dict[str, Any]) -> tuple[int, int]:
        """Number of stars in an answer with the right name, and number of all."""
        named = [star["star"] and star["star"]["id"] for star in answer["observations"][0]["stars"]]
        true = self._of(k).truth["observations"][0]["stars"]
        return sum(one == other for one, other in zip(named, true, strict=True)), len(named)


def telemetry(seed: int) -> Telemetry:
    """Nominal pass of XTE, long enough for varied batches."""
    sky = SkyModel(load_embedded(), LruCache(64 << 20))
    wanted = Pass(batches=400, seed=seed, troubles=NO_TROUBLES, angles_share=0.0)
    return Telemetry(list(draw_pass(load_missions()["XTE"], sky, wanted)))


def _posted(served: Served, path: str, bodies: Sequence[bytes], gap_s: float = 0.0) -> Driven:
    connections = CONNECTIONS if gap_s == 0.0 else 4
    driven = drive(served.port, [request(path, each) for each in bodies], connections, gap_s)
    if set(driven.statuses) != {201}:
        raise RuntimeError(f"{path}: {driven.statuses}")
    return driven


def read_json(served: Served, path: str) -> Any:
    with urllib.request.urlopen(served.address(path), timeout=60) as answer:
        return json.load(answer)


def _start_replay(served: Served, lines: Sequence[bytes], run: str) -> str:
    head = {"Content-Type": "application/x-ndjson"}
    asked = urllib.request.Request(
        served.address(f"{API}/replays?run={run}"), b"\n".join(lines), head
    )
    with urllib.request.urlopen(asked, timeout=600) as answer:
        return str(answer.headers["Location"])


def _finished(served: Served, place: str) -> dict[str, Any]:
    while (state := read_json(served, place))["state"] == "running":
        time.sleep(0.05)
    return dict(state)


def singles(quick: bool, pass_: Telemetry, folder: Path) -> tuple[dict[str, Any], list[Bound]]:
    """Figures of single posts against the no-op, and of the start of the service."""
    count, rounds = (QUICK_POSTS, QUICK_ROUNDS) if quick else (POSTS, ROUNDS)
    starts = _starts(2 if quick else STARTS, pass_, folder / "start.db")
    ready_s, first, in_a_row, later = (median(each) for each in zip(*starts, strict=True))
    rates: dict[str, list[float]] = {"no-op": [], "any JSON": [], "service": []}
    cpu_us: dict[str, list[float]] = {name: [] for name in rates}
    of_livez: list[float] = []
    by_connections_us: dict[int, list[float]] = {each: [] for each in MOST_CPU_US}
    p50_ms: list[float] = []
    right = seen = 0
    with no_op() as bare, service(folder / "single.db") as served:
        at_ready_mb = served.resident_mb()
        routes = {
            "no-op": (bare, "/no-op"),
            "any JSON": (bare, "/any-json"),
            "service": (served, f"{API}/batches"),
        }
        for name, (server, path) in routes.items():
            _posted(server, path, pass_.bodies(400, f"warm-{name.replace(' ', '-')}"))
        for round_ in range(rounds):
            bodies = pass_.bodies(count, f"round-{round_}")
            for name, (server, path) in routes.items():
                cpu = server.cpu_s()
                driven = _posted(server, path, bodies)
                rates[name].append(driven.per_second)
                cpu_us[name].append((server.cpu_s() - cpu) / count * 1e6)
                if name == "service":
                    answer = json.loads(driven.last)
                    got, of = pass_.right(int(answer["batch"].rpartition("-")[2]), answer)
                    right, seen = right + got, seen + of
            for connections, took_us in by_connections_us.items():
                posted = pass_.bodies(ONE_BY_ONE * connections, f"by-{connections}-{round_}")
                row = [request(f"{API}/batches", each) for each in posted]
                cpu = served.cpu_s()
                waits = drive(served.port, row, connections)
                took_us.append((served.cpu_s() - cpu) / len(row) * 1e6)
            p50_ms.append(waits.percentile_ms(50))
            alive = drive(served.port, [get("/livez")] * ONE_BY_ONE, 1)
            of_livez.append(p50_ms[-1] / alive.percentile_ms(50))
        page = read_json(served, f"{API}/batches?limit=500")["items"]
        for item in page[:100]:
            answer = read_json(served, f"{API}/batches/{item['id']}")["answer"]
            got, of = pass_.right(int(answer["batch"].rpartition("-")[2]), answer)
            right, seen = right + got, seen + of
        after_mb = served.resident_mb()
    with closing(sqlite3.connect(folder / "single.db")) as database:
        ((recorded,),) = database.execute("SELECT count(*) FROM batches")
    middle = {name: median(each) for name, each in rates.items()}
    turns = [a / b for a, b in zip(rates["service"], rates["no-op"], strict=True)]
    beside_any = [a / b for a, b in zip(rates["service"], rates["any JSON"], strict=True)]
    ratio = median(turns)
    figures = {
        "start: seconds until ready": ready_s,
        "start: first request, ms": first,
        "start: hundredth in a row, ms": in_a_row,
        "start: later ones after the same pause, ms": later,
        "start: first less later ones, in posts in a row": (first - later) / in_a_row,
        "single: no-op posts a second": middle["no-op"],
        "single: service posts a second": middle["service"],
        "single: service over no-op": ratio,
        "single: service over no-op, lowest turn": min(turns),
        "single: service over no-op, highest turn": max(turns),
        "single: service over a route that takes any JSON": median(beside_any),
        "single: cpu of no-op over service": median(cpu_us["no-op"]) / median(cpu_us["service"]),
        "single: cpu of the service, us a post": median(cpu_us["service"]),
        "single: p50 over one connection, ms": median(p50_ms),
        "single: p50 over one connection, over /livez": median(of_livez),
        **{
            f"single: cpu of the service, us a post, connections: {connections}": median(took_us)
            for connections, took_us in by_connections_us.items()
        },
        "single: bytes a batch": (folder / "single.db").stat().st_size / recorded,
        "single: stars named rightly": right / seen,
        "memory: at ready, MB": at_ready_mb,
        f"memory: after {rounds * (count + ONE_BY_ONE) + 400:,} posts, MB": after_mb,
    }
    bounds = [
        at_least("single posts over the no-op", ratio, LEAST_OF_NO_OP),
        *(
            at_most(f"cpu of a post, connections: {n}", median(by_connections_us[n]), most, "us")
            for n, most in MOST_CPU_US.items()
        ),
        at_most("p50 over one connection, over /livez", median(of_livez), MOST_OF_LIVEZ),
        at_most("SQLite", figures["single: bytes a batch"], MOST_BYTES, "bytes a batch"),
        at_most("seconds until ready", ready_s, MOST_READY_S),
        at_most("first request less later ones", (first - later) / in_a_row, MOST_FIRST, "posts"),
        at_least("stars named rightly, share", right / seen, RIGHT),
        at_most("memory at ready", at_ready_mb, MOST_READY_MB, "MB"),
        at_most("memory after the posts", after_mb, MOST_AFTER_MB, "MB"),
    ]
    return figures, bounds


def _starts(
    count: int, pass_: Telemetry, database: Path
) -> list[tuple[float, float, float, float]]:
    """Seconds until ready, and milliseconds of first and later posts, of several starts.

    All measured posts are of the latest view before the start, which the service expects, and
    follow a pause, after which caches and the processor are slow.  Of the later ones the median
    counts, since the first one after much work is slow.  Earlier views are posted in between, one
    after another; the time of the last of them is also returned.
    """
    with service(database) as served:
        _posted(served, f"{API}/batches", pass_.bodies(SEEN, "before"))
    measured = []
    for start in range(count):
        others = [pass_.body(k % (SEEN - 1), f"start-{start}-{k}") for k in range(98)]
        with service(database) as served:
            first = _after_pause_ms(served, pass_.body(SEEN - 1, f"first-{start}"))
            row = drive(served.port, [request(f"{API}/batches", each) for each in others], 1)
            in_a_row = median(row.waits_ms[-20:])
            later = median(
                _after_pause_ms(served, pass_.body(SEEN - 1, f"later-{start}-{k}"))
                for k in range(LATER)
            )
            measured.append((served.ready_s, first, in_a_row, later))
    return measured


def _after_pause_ms(served: Served, body: bytes) -> float:
    time.sleep(PAUSE_S)
    return drive(served.port, [request(f"{API}/batches", body)], 1).waits_ms[0]


def alarms(quick: bool, pass_: Telemetry, folder: Path) -> tuple[dict[str, Any], list[Bound]]:
    """Seconds from a post to the resulting alarm in the event stream, idle and under load."""
    figures, bounds = {}, []
    with (
        service(folder / "alarms.db") as served,
        urllib.request.urlopen(served.address(f"{API}/events"), timeout=60) as stream,
    ):
        warm(served, pass_)
        alarm_times = _alarm_times(stream)
        limit = {"warning": {"high": 0.01}, "minimum_count": 1, "duration_s": 0, "hysteresis": 0}
        asked = urllib.request.Request(
            served.address(f"{API}/spacecraft/XTE/limits/unmatched_share"),
            json.dumps({"settings": limit, "who": "benchmark"}).encode(),
            {"Content-Type": "application/json"},
            method="PUT",
        )
        urllib.request.urlopen(asked, timeout=60).close()
        for per_second in (1, ALARM_LOAD):
            others = pass_.bodies(per_second * (4 if quick else 20), f"load-{per_second}")
            load = [request(f"{API}/batches", _in_run(each, "load")) for each in others]
            loading = threading.Thread(
                target=lambda load=load, rate=per_second: drive(
                    served.port, load, min(CONNECTIONS, rate), per_second=rate
                )
            )
            loading.start()
            delays_s: list[float] = []
            while loading.is_alive():
                # One batch leaves the limits, the next one is back in them.
                for is_out in (True, False):
                    body = pass_.body(len(delays_s), f"alarm-{per_second}-{len(delays_s)}-{is_out}")
                    _posted(served, f"{API}/batches", [_with_a_false_star(body, is_out)])
                    posted_s = time.perf_counter()
                    delays_s.append(next(alarm_times) - posted_s)
            loading.join()
            name = f"alarm: seconds after its post, at {per_second} posts a second"
            figures[f"{name}, median"] = median(delays_s)
            figures[f"{name}, longest"] = max(delays_s)
            bounds.append(at_most(f"{name}, longest", max(delays_s), MOST_ALARM_S, "s"))
    return figures, bounds


def _in_run(body: bytes, run: str) -> bytes:
    return json.dumps(json.loads(body) | {"run": run}).encode()


def _with_a_false_star(body: bytes, is_out: bool) -> bytes:
    """Batch with or without a star that is not in the catalog."""
    batch = json.loads(body)
    stars = batch["observations"][0]["stars"]
    if is_out:
        stars.append({"vector": [0.02, 0.01, 0.9997499687421851], "magnitude": 1.0})
    return json.dumps(batch).encode()


def _alarm_times(stream: Iterable[bytes]) -> Iterator[float]:
    """Times of arrival of alarms in the event stream."""
    for line in stream:
        if line.startswith(b"event: alarm"):
            yield time.perf_counter()


def bulk(quick: bool, pass_: Telemetry, folder: Path) -> tuple[dict[str, Any], list[Bound]]:
    """Figures of bulk loading against its limit, and waiting times of single posts meanwhile."""
    count = QUICK_BULK if quick else BULK
    bounds: list[Bound] = []
    lines = pass_.bodies(count, "bulk")
    alone = pass_.bodies(min(count, 4_000), "ceiling")
    ceilings = [_parse_and_insert(alone, folder / "before.db")]
    with service(folder / "bulk.db") as served:
        warm(served, pass_)
        _warm_bulk(served, pass_.bodies(400, "warm-bulk"))
        started = time.perf_counter()
        state = _finished(served, _start_replay(served, lines, "bulk"))
        rate = count / (time.perf_counter() - started)
        done = state["counts"]["new"] if state["state"] == "done" else 0
        bounds.append(equal("batches that the bulk recorded", done, count))
        idle = waits_idle(served, pass_, quick)
        place = _start_replay(served, lines, "beside")
        beside = waits_beside(served, pass_, lambda: _finished(served, place))
        memory_mb = served.resident_mb()
    # Measure before and after, since the machine's speed varies.
    ceilings.append(_parse_and_insert(alone, folder / "after.db"))
    ceiling = median(ceilings)
    figures = {
        "bulk: batches a second": rate,
        "bulk: parsing and inserting alone, batches a second": ceiling,
        "bulk: bulk over parsing and inserting alone": rate / ceiling,
        "beside bulk: p50 of single posts idle, ms": idle.percentile_ms(50),
        "beside bulk: p99 of single posts idle, ms": idle.percentile_ms(99),
        "beside bulk: posts while bulk ran": len(beside.waits_ms),
        f"memory: after {2 * count:,} batches in bulk, MB": memory_mb,
    }
    bounds += [
        at_least("bulk over parsing and inserting alone", rate / ceiling, LEAST_OF_CEILING),
        at_most("memory after bulk", memory_mb, MOST_BULK_MB, "MB"),
    ]
    if beside.waits_ms:
        wait = beside.percentile_ms(99) / idle.percentile_ms(99)
        figures["beside bulk: p50 of single posts, ms"] = beside.percentile_ms(50)
        figures["beside bulk: p99 of single posts, ms"] = beside.percentile_ms(99)
        figures["beside bulk: p99 over idle"] = wait
        bounds.append(at_most("p99 of single posts beside bulk over idle", wait, MOST_WAIT))
    # A p99 needs a hundred posts.
    bounds.append(at_least("single posts while bulk ran", len(beside.waits_ms), 100))
    return figures, bounds


def warm(served: Served, pass_: Telemetry) -> None:
    """Warm up the service with posts that are not measured."""
    _posted(served, f"{API}/batches", pass_.bodies(400, "warm"))


def waits_idle(served: Served, pass_: Telemetry, quick: bool) -> Driven:
    """Paced single posts to an otherwise idle service."""
    bodies = pass_.bodies(QUICK_PACED if quick else PACED, "idle")
    return _posted(served, f"{API}/batches", bodies, GAP_S)


def waits_beside(served: Served, pass_: Telemetry, work: Callable[[], object]) -> Driven:
    """Paced single posts, as in `waits_idle`, for the duration of `work`."""
    beside = Driven()
    over = threading.Event()

    def post() -> None:
        # Only posts during the work count.
        part = 0
        while not over.is_set():
            part += 1
            driven = _posted(served, f"{API}/batches", pass_.bodies(100, f"b{part}"), GAP_S)
            if not over.is_set():
                beside.waits_ms += driven.waits_ms

    posting = threading.Thread(target=post)
    posting.start()
    try:
        work()
    finally:
        over.set()
        posting.join()
    return beside


def _warm_bulk(served: Served, lines: Sequence[bytes]) -> None:
    """Replay files until all processes of the service have started."""
    _finished(served, _start_replay(served, lines, "warm-1"))
    wanted, give_up = Settings.from_environment().replay_processes, time.monotonic() + START_S
    while _replay_processes(served) < wanted:
        if time.monotonic() > give_up:
            raise RuntimeError("the processes that compute replays are not ready")
        time.sleep(0.1)
    _finished(served, _start_replay(served, lines, "warm-2"))


def _replay_processes(served: Served) -> float:
    with urllib.request.urlopen(served.address("/metrics"), timeout=60) as answer:
        text = answer.read().decode()
    return float(text.partition("\nstarid_replay_processes ")[2].split()[0])


def _parse_and_insert(lines: Sequence[bytes], database: Path) -> float:
    """Batches per second of the service's parser and row insertion, without computation."""
    app = open_app(Settings(database=f"sqlite:///{database}"))
    try:
        made = [submission_from_json(line, run="bulk") for line in lines]
        unsaved_results = [app.submissions.solver.solve(each) for each in made]
        app.store.writer.change(lambda connection: None)
        spent = 0.0
        for first in range(0, len(lines), CHUNK):
            started = time.perf_counter()
            for line in lines[first : first + CHUNK]:
                submission_from_json(line, run="bulk")
            part = unsaved_results[first : first + CHUNK]
            app.store.writer.record(part)
            spent += time.perf_counter() - started
    finally:
        app.close()
    return len(lines) / spent


def run(quick: bool, seed: int) -> Report:
    """Benchmark of posts."""
    pass_ = telemetry(seed)
    with tempfile.TemporaryDirectory() as folder:
        figures, bounds = singles(quick, pass_, Path(folder))
        alarmed, of_alarms = alarms(quick, pass_, Path(folder))
        more, of_bulk = bulk(quick, pass_, Path(folder))
    return Report("posts", figures | alarmed | more, bounds + of_alarms + of_bulk)


if __name__ == "__main__":
    print(run(True, 1).text())
