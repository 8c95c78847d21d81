"""Hour at 70 % of the service's full rate: the end must perform as the beginning.

    python -m benchmarks soak           an hour; not among those that are run by default
    python -m benchmarks soak --quick   two minutes

The service runs as it is served, over SQLite with synchronous=FULL.  The full rate is measured
first, at 16 connections.  Then batches arrive at 70 % of it, evenly spaced, while a page is read
every second.  Each batch is dated a second after the previous one, so that the history grows by
weeks.  Waiting times, the memory of all processes and an answer are checked every minute, the size
of the write-ahead log every second.  At the end the recorded batches are counted.
"""

import json
import tempfile
import threading
import urllib.request
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.bounds import Bound, at_least, at_most, equal
from benchmarks.report import Report
from benchmarks.speed.load import drive, request
from benchmarks.speed.posts import API, CONNECTIONS, FIRST, RIGHT, Telemetry, telemetry
from benchmarks.speed.serving import Served, service

SHARE = 0.7
SLICES, SLICE_S = 60, 60.0
QUICK_SLICES, QUICK_SLICE_S = 12, 10.0
PROBES, PROBED = 3, 3_000
SETTLED = 1 / 6
"""Part of the time after which memory must stay constant."""
MOST_DRIFT, MOST_LOG_MB, MOST_SLOWER = 0.05, 64.0, 2.0
_NAME, _TIME = b"soak-NAME", b"soak-TIME"


@dataclass
class _Watched:
    """Values watched every second."""

    log_mb: list[float] = field(default_factory=list)
    reads: int = 0


def _bodies(pass_: Telemetry, first: int, count: int) -> Iterator[bytes]:
    """Requests of batches with separate names, made on demand."""
    # Weeks later the same stars stand within an arcsecond of each other where they stood.
    own = {"options": {"identifier": "starid"}, "batch": _NAME.decode(), "time": _TIME.decode()}
    templates = [json.dumps(drawn.batch | own).encode() for drawn in pass_.drawn]
    for number in range(first, first + count):
        time = (FIRST + timedelta(seconds=number)).strftime("%Y-%m-%dT%H:%M:%SZ").encode()
        body = templates[number % len(templates)].replace(_NAME, b"soak-%d" % number)
        yield request(f"{API}/batches", body.replace(_TIME, time))


def _watch(served: Served, log: Path, watched: _Watched, over: threading.Event) -> None:
    while not over.wait(1.0):
        watched.log_mb.append(log.stat().st_size / 1e6)
        with urllib.request.urlopen(served.address(f"{API}/overview"), timeout=60) as answer:
            json.load(answer)
        watched.reads += 1


def _recorded(served: Served) -> int:
    address = served.address(f"{API}/spacecraft/XTE/rates?bucket=day")
    with urllib.request.urlopen(address, timeout=60) as answer:
        return sum(int(each["batches"]) for each in json.load(answer)["items"])


def run(quick: bool, seed: int) -> Report:
    """Post for an hour, and compare the end with the beginning."""
    pass_ = telemetry(seed)
    slices, slice_s = (QUICK_SLICES, QUICK_SLICE_S) if quick else (SLICES, SLICE_S)
    bounds: list[Bound] = []
    refused: Counter[int] = Counter()
    sent = right = seen = 0
    watched, over = _Watched(), threading.Event()
    rates: list[float] = []
    p50_ms: list[float] = []
    p99_ms: list[float] = []
    memory_mb: list[float] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        service(Path(folder) / "soak.db") as served,
    ):
        probes = []
        for _ in range(PROBES):
            driven = drive(served.port, list(_bodies(pass_, sent, PROBED)), CONNECTIONS)
            sent += PROBED
            probes.append(driven.per_second)
        capacity = median(probes)
        log = Path(folder) / "soak.db-wal"
        watcher = threading.Thread(target=_watch, args=(served, log, watched, over))
        watcher.start()
        try:
            for _ in range(slices):
                count = round(SHARE * capacity * slice_s)
                bodies = _bodies(pass_, sent, count)
                driven = drive(served.port, bodies, CONNECTIONS, per_second=SHARE * capacity)
                sent += count
                if set(driven.statuses) == {201}:
                    answer = json.loads(driven.last)
                    got, of = pass_.right(int(answer["batch"].rpartition("-")[2]), answer)
                    right, seen = right + got, seen + of
                else:
                    refused.update(driven.statuses)
                rates.append(driven.per_second)
                p50_ms.append(driven.percentile_ms(50.0))
                p99_ms.append(driven.percentile_ms(99.0))
                memory_mb.append(served.resident_mb())
        finally:
            over.set()
            watcher.join()
        recorded = _recorded(served)
        size_mb = (Path(folder) / "soak.db").stat().st_size / 1e6
    settled = max(1, round(SETTLED * slices))
    before = median(memory_mb[settled : 2 * settled])
    drift = median(memory_mb[-settled:]) / before - 1.0
    half = len(watched.log_mb) // 2
    figures: dict[str, Any] = {
        "minutes": slices * slice_s / 60.0,
        "can do, posts a second": capacity,
        "posts a second": median(rates),
        "posts in all": sent,
        "recorded": recorded,
        "stars named rightly, of those looked at": right / max(seen, 1),
        "overviews read meanwhile": watched.reads,
        "p50 of the first sixth, ms": median(p50_ms[:settled]),
        "p50 of the last sixth, ms": median(p50_ms[-settled:]),
        "p99 of the first sixth, ms": median(p99_ms[:settled]),
        "p99 of the last sixth, ms": median(p99_ms[-settled:]),
        "memory in the second sixth, MB": before,
        "memory in the last sixth, MB": median(memory_mb[-settled:]),
        "memory: drift": drift,
        "log: largest in the first half, MB": max(watched.log_mb[:half]),
        "log: largest in the second half, MB": max(watched.log_mb[half:]),
        "database, MB": size_mb,
    }
    answers = str(dict(refused)) if refused else "201 alone"
    bounds += [
        Bound("statuses of the posts", answers, "201 alone", not refused),
        equal("batches recorded", recorded, sent),
        at_least("posts a second over those asked for", median(rates) / (SHARE * capacity), 0.9),
        at_least("stars named rightly, share", right / max(seen, 1), RIGHT),
        at_most("memory: drift", drift, MOST_DRIFT),
        at_most("log: largest", max(watched.log_mb), MOST_LOG_MB, "MB"),
        at_most(
            "p99 of the last sixth over the first",
            median(p99_ms[-settled:]) / median(p99_ms[:settled]),
            MOST_SLOWER,
        ),
    ]
    curves = {"memory, MB": memory_mb, "p99, ms": p99_ms, "posts a second": rates}
    return Report("soak", figures, bounds, curves)
