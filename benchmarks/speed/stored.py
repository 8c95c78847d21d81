"""Cost of a batch and of a trend as the database fills.

    python -m benchmarks stored           five million batches: minutes, and 5 GB meanwhile
    python -m benchmarks stored --quick   twenty thousand

The database is filled by `benchmarks.speed.fill_database`; then batches are recorded
in earnest and trends are read.  What a trend is held against is a count of the
same results one by one; the answers must be equal.
"""

import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from sqlalchemy import text

from benchmarks.bounds import Bound, at_most
from benchmarks.report import Report
from benchmarks.speed.fill_database import START, fill
from benchmarks.speed.posts import telemetry
from service.app.factory import App, open_app
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.times import parse_utc, shifted

BATCHES, QUICK_BATCHES = 5_000_000, 20_000
RECORDED = 2_000
CHUNK = 250
REPEATS = 5
MOST_GROWTH = 1.5
MOST_BYTES = 2000.0
MOST_MONTH_MS, MOST_YEAR_MS = 10.0, 30.0


def record_us(app: App, seed: int) -> float:
    """Microseconds per batch of a bulk file, from the median chunk."""
    bodies = telemetry(seed).bodies(RECORDED, f"stored-{seed}")
    made = [submission_from_json(body, run="stored") for body in bodies]
    app.submissions.submit_many(made[:CHUNK])
    spent = []
    for first in range(CHUNK, RECORDED, CHUNK):
        started = time.perf_counter()
        app.submissions.submit_many(made[first : first + CHUNK])
        spent.append((time.perf_counter() - started) / CHUNK * 1e6)
    return median(spent)


def milliseconds(call: Callable[[], object]) -> float:
    """Median milliseconds of several calls."""
    spent = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        call()
        spent.append((time.perf_counter() - started) * 1000)
    return median(spent)


def _scan(app: App, start_ns: int, end_ns: int) -> tuple[int, int]:
    """Observed and ambiguous stars of a period, counted from single results."""
    query = text(
        "SELECT sum(observed), sum(ambiguous) FROM results WHERE +current = 1 AND +run = 'live' "
        "AND +spacecraft = 'XTE' AND +time_ns >= :start AND +time_ns < :end"
    )
    with app.store.reading() as connection:
        found = connection.execute(query, {"start": start_ns, "end": end_ns}).one()
    return int(found[0] or 0), int(found[1] or 0)


def measured(total: int, seed: int) -> tuple[dict[str, Any], list[Bound]]:
    """Figures of one size of the database, and of an empty one."""
    bounds: list[Bound] = []
    with tempfile.TemporaryDirectory() as folder:
        empty = open_app(Settings(database=f"sqlite:///{Path(folder) / 'empty.db'}"))
        try:
            empty.service.ready()
            alone_us = record_us(empty, seed)
        finally:
            empty.close()
        file = Path(folder) / "filled.db"
        fill(file, total, seed, 0)
        app = open_app(Settings(database=f"sqlite:///{file}"))
        try:
            app.service.ready()
            beside_us = record_us(app, seed)
            start = parse_utc(START)
            spans = {"a month by hour": ("hour", 30), "a year by day": ("day", 365)}
            figures: dict[str, Any] = {
                "batches stored": total,
                "size, MB": file.stat().st_size / 1e6,
                "a batch in bulk, database empty, us": alone_us,
                "a batch in bulk, database filled, us": beside_us,
                "filled over empty": beside_us / alone_us,
            }
            for name, (bucket, days) in spans.items():
                end = shifted(start, days * 86_400.0)

                def read(bucket: Any = bucket, end: Any = end) -> Any:
                    return app.spacecraft.rates("XTE", start=start, end=end, bucket=bucket)

                rows = read()
                took = milliseconds(read)
                counted = _scan(app, start.tai_ns, end.tai_ns)
                scan_ms = milliseconds(partial(_scan, app, start.tai_ns, end.tai_ns))
                figures[f"{name}, buckets"] = len(rows)
                figures[f"{name}, ms"] = took
                figures[f"{name}: counted one by one, ms"] = scan_ms
                figures[f"{name}: over counting"] = took / scan_ms
                found = sum(r.observed for r in rows), sum(r.ambiguous for r in rows)
                bounds.append(
                    Bound(f"{name}: stars", f"{found}", f"{counted}, counted", found == counted)
                )
                most = MOST_MONTH_MS if bucket == "hour" else MOST_YEAR_MS
                bounds.append(at_most(name, took, most, "ms"))
        finally:
            app.close()
    bounds.append(at_most("a batch, filled over empty", beside_us / alone_us, MOST_GROWTH))
    bounds.append(
        at_most("database", figures["size, MB"] / total * 1e6, MOST_BYTES, "bytes a batch")
    )
    return figures, bounds


def run(quick: bool, seed: int) -> Report:
    """Benchmark that fills a database, then records batches and reads trends in it."""
    figures, bounds = measured(QUICK_BATCHES if quick else BATCHES, seed)
    return Report("stored", figures, bounds)
