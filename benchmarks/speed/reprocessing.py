"""Reprocessing into an archive against bulk loading, and two processes against one.

    python -m benchmarks reprocessing           40,000 batches, some minutes
    python -m benchmarks reprocessing --quick   4,000

The same drawn telemetry is loaded in bulk by two processes, archived, and run again by two
processes and by one.  Of each the rate is that of the time after its processes have begun.
Where TEST_POSTGRESQL_URL names a scratch database, single posts go to a service over it while
the command runs beside.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.bounds import Bound, at_least, at_most, equal
from benchmarks.report import Report
from benchmarks.speed.posts import (
    API,
    MOST_WAIT,
    read_json,
    telemetry,
    waits_beside,
    waits_idle,
    warm,
)
from benchmarks.speed.scale import emptied
from benchmarks.speed.serving import service
from service.app.factory import App, open_app
from service.features.archive import archiving
from service.features.archive.part import Reprocessings
from service.ingest.reprocess import ReprocessProgress
from service.missions.mission import load_missions
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.storage.sql.migrations import upgrade
from service.times import parse_utc, shifted

BATCHES, QUICK_BATCHES = 40_000, 4_000
BESIDE, QUICK_BESIDE = 20_000, 2_000
PARTITIONS = 40
"""Number of archive partitions, of one day each."""
END_S = (PARTITIONS + 1) * 86_400.0
PROCESSES = 2
LEAST_OF_BULK, LEAST_OF_ONE = 1.0, 1.6
START = "1999-03-01T00:00:00.000Z"
"""First time of the batches; the simultaneous posts are dated years earlier."""


class Pace:
    """Rate in batches per second from the first processed batches on."""

    def __init__(self) -> None:
        self._begun: tuple[float, int] | None = None
        self.rate = 0.0

    def note(self, done: int) -> None:
        """Record the number of batches processed so far."""
        now_s = time.perf_counter()
        if self._begun is None:
            if done:
                self._begun = now_s, done
        elif done > self._begun[1]:
            self.rate = (done - self._begun[1]) / (now_s - self._begun[0])


def _telemetry(count: int, seed: int) -> list[bytes]:
    mission, sky = load_missions()["XTE"], SkyModel(load_embedded(), LruCache(256 << 20))
    wanted = Pass(count, seed, START, PARTITIONS * 86_400.0 / count)
    return [json.dumps(each.batch).encode() for each in draw_pass(mission, sky, wanted)]


def _bulk(app: App, lines: list[bytes]) -> float:
    pace = Pace()
    id = app.replays.start(iter(lines), "source")
    while (state := app.replays.get(id)).state == "running":
        pace.note(state.lines.done)
        time.sleep(0.02)
    pace.note(state.lines.done)
    return pace.rate


def _again(app: App, folder: Path, processes: int) -> tuple[float, ReprocessProgress]:
    pace = Pace()

    def step(now: ReprocessProgress) -> None:
        pace.note(now.recorded)

    progress = app.part(Reprocessings).reprocess(
        f"by-{processes}", folder, source="source", processes=processes, step=step
    )
    return pace.rate, progress


def _bytes(folder: Path, processes: int) -> int:
    return sum(each.stat().st_size for each in folder.rglob(f"run-by-{processes}-*"))


def _archived(app: App, folder: Path) -> int:
    return archiving.archive(app.store, folder, shifted(parse_utc(START), END_S)).batches


def measured(count: int, seed: int) -> tuple[dict[str, Any], list[Bound]]:
    """Figures of reprocessing a number of batches."""
    lines = _telemetry(count, seed)
    bounds: list[Bound] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "archive"
        folder.mkdir()
        settings = Settings(
            database=f"sqlite:///{Path(temporary) / 'acquire.db'}",
            archive_folder=folder,
            replay_processes=PROCESSES,
        )
        app = open_app(settings)
        try:
            bulk = _bulk(app, lines)
            began_s = time.perf_counter()
            archive = _archived(app, folder) / (time.perf_counter() - began_s)
            two, progress = _again(app, folder, PROCESSES)
            bounds.append(equal("batches run again", progress.recorded, count))
            one, _ = _again(app, folder, 1)
            size = _bytes(folder, PROCESSES)
        finally:
            app.close()
    figures = {
        "batches": count,
        "partitions": progress.partitions,
        "bulk loading, two processes, batches/s": bulk,
        "archiving, batches/s": archive,
        "run again by two processes, batches/s": two,
        "run again by one, batches/s": one,
        "a batch of the run, bytes": size / count,
    }
    bounds.append(at_least("run again over bulk loading", two / bulk, LEAST_OF_BULK))
    bounds.append(at_least("two processes over one", two / one, LEAST_OF_ONE))
    return figures, bounds


def beside(url: str, quick: bool, seed: int) -> tuple[dict[str, Any], list[Bound]]:
    """Waiting times of single posts while the command reprocesses an archive of the database."""
    count = QUICK_BESIDE if quick else BESIDE
    emptied(url)
    upgrade(url)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        app = open_app(Settings(database=url, archive_folder=folder, replay_processes=PROCESSES))
        try:
            _bulk(app, _telemetry(count, seed))
            _archived(app, folder)
        finally:
            app.close()
        command = [sys.executable, "-m", "service.cli", "reprocess", "--database", url]
        command += ["--archive", str(folder), "--source", "source", "--run", "beside"]
        command += ["--processes", str(PROCESSES), "--no-comparison", "--quiet"]
        posts = telemetry(seed)
        with service(url) as served:
            warm(served, posts)
            idle = waits_idle(served, posts, quick)
            waited = waits_beside(
                served,
                posts,
                lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL),
            )
            days = read_json(served, f"{API}/spacecraft/XTE/rates?bucket=day&run=beside")["items"]
    emptied(url)
    wait = waited.percentile_ms(99) / idle.percentile_ms(99)
    figures = {
        "beside: p50 of single posts idle, ms": idle.percentile_ms(50),
        "beside: p99 of single posts idle, ms": idle.percentile_ms(99),
        "beside: posts meanwhile": len(waited.waits_ms),
        "beside: p50 of single posts, ms": waited.percentile_ms(50),
        "beside: p99 of single posts, ms": waited.percentile_ms(99),
    }
    return figures, [
        equal("beside: batches run again", sum(each["batches"] for each in days), count),
        at_most("beside: p99 of single posts over idle", wait, MOST_WAIT),
    ]


def run(quick: bool, seed: int) -> Report:
    """Benchmark of reprocessing."""
    figures, bounds = measured(QUICK_BATCHES if quick else BATCHES, seed)
    if postgresql := os.environ.get("TEST_POSTGRESQL_URL"):
        more, of_posts = beside(postgresql, quick, seed)
        figures |= more
        bounds += of_posts
    return Report("reprocessing", figures, bounds)
