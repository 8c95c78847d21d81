"""What the pages' data costs on a database of millions: `python -m benchmarks.speed.pages OUT.db`.

The database is made by `python -m benchmarks.speed.fill_database`.  Each page's data
is asked of the operations and put into JSON, as a handler does; its answer is
held against a count by other means.  Shown are milliseconds of several calls:
the median and the fastest by the clock, and the least of the processor's own
time, which other work on the machine does not count in.  The exit code is 1
where an answer is wrong or that time is above its bound.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
from tqdm import tqdm

from benchmarks.speed.fill_database import CADENCE_S
from service.app.factory import App, open_app
from service.features.alarms.part import Alarms
from service.observations.schema import OptionsIn
from service.settings import Settings
from service.times import DAY_S, HOUR_S, Utc, parse_utc, shifted

PAGE_MS, MONTH_MS = 50.0, 10.0
REPEATS = 15
SPACECRAFT = "XTE"
MONTH_S = 30 * DAY_S


@dataclass(frozen=True)
class Asked:
    """Data behind one part of a page, with a time limit and a check of the answer."""

    page: str
    what: str
    bound_ms: float
    ask: Callable[[], Any]
    check: Callable[[Any], bool]


def asked_of(app: App) -> list[Asked]:
    """Data of all pages."""
    overview = app.spacecraft.overview()
    latest = parse_utc(overview.as_of)
    first = shifted(latest, -MONTH_S)
    spans = {"hour": HOUR_S, "day": DAY_S, "month": MONTH_S, "year": 365 * DAY_S}
    newest = app.results.page(limit=1).items[0].id

    def drawn(span_s: float) -> Any:
        return app.spacecraft.history(
            SPACECRAFT, start=shifted(latest, -span_s), end=latest, size=800
        )

    def whole(span_s: float) -> Callable[[Any], bool]:
        # A batch every cadence, the first of the stretch included and its end excluded.
        return lambda found: abs(sum(found.batches) - span_s // CADENCE_S) <= 1

    trends = [
        Asked(
            "Spacecraft",
            f"every trend of a {name}",
            MONTH_MS if name == "month" else PAGE_MS,
            partial(drawn, span_s),
            whole(span_s),
        )
        for name, span_s in spans.items()
    ]
    return [
        Asked(
            "Overview",
            "every spacecraft of live",
            PAGE_MS,
            app.spacecraft.overview,
            lambda found: all(
                each.last_hour.batches == HOUR_S // CADENCE_S
                for each in found.items
                if each.latest_batch and each.latest_batch.time == found.as_of
            ),
        ),
        *trends,
        Asked(
            "Spacecraft",
            "worst batches of a month",
            PAGE_MS,
            lambda: (
                app.spacecraft.ranking(
                    SPACECRAFT, by="ambiguous_share", start=first, end=latest
                ).items
            ),
            lambda found: found[0].value == _worst(app, first, latest) and len(found) == 20,
        ),
        Asked(
            "Spacecraft",
            "state, settings and their history",
            PAGE_MS,
            lambda: app.spacecraft.state(SPACECRAFT),
            lambda found: found.state != "no_batches",
        ),
        Asked(
            "Batches",
            "the newest hundred across runs",
            PAGE_MS,
            lambda: app.results.page(run="*").items,
            lambda found: (
                len(found) == 100
                and [each.time for each in found]
                == sorted((each.time for each in found), reverse=True)
            ),
        ),
        Asked(
            "Batch",
            "one with its stars",
            PAGE_MS,
            lambda: app.results.get(newest),
            lambda found: found.answer.counts.observed > 0,
        ),
        Asked(
            "Batch",
            "what if",
            PAGE_MS,
            lambda: app.results.what_if(newest, OptionsIn(solver="triad")).body.decode(),
            lambda found: '"recorded":false' in found,
        ),
        Asked("Alarms", "active ones", PAGE_MS, lambda: app.part(Alarms).page().items, _is_list),
        Asked("Alarms", "limits", PAGE_MS, lambda: app.part(Alarms).limits.all(SPACECRAFT), bool),
        Asked(
            "Runs",
            "every run",
            PAGE_MS,
            app.runs.all,
            lambda found: sum(each.batches for each in found) == _count(app),
        ),
        Asked("Zones", "the cache", PAGE_MS, app.zones.state, lambda found: found.max_bytes > 0),
        Asked("About", "what answers", PAGE_MS, app.service.about, bool),
    ]


@dataclass(frozen=True)
class Measured:
    """Measured milliseconds, and whether the answer is right."""

    asked: Asked
    median_ms: float
    fastest_ms: float
    processor_ms: float
    right: bool

    @property
    def passed(self) -> bool:
        """True if the answer is right, and within its time limit."""
        return self.right and self.processor_ms <= self.asked.bound_ms

    def line(self) -> str:
        """Line of the printed table."""
        told = "right" if self.right else "WRONG"
        slow = "" if self.processor_ms <= self.asked.bound_ms else ", TOO SLOW"
        times = f"{self.median_ms:>10.2f}{self.fastest_ms:>9.2f}{self.processor_ms:>11.2f}"
        return (
            f"{self.asked.page:<12}{self.asked.what:<36}{times}"
            f"{self.asked.bound_ms:>7.0f}  {told}{slow}"
        )


def measure(asked: Asked) -> Measured:
    """Ask several times; the first answer is checked and not timed."""
    right = asked.check(asked.ask())
    clock, processor = [], []
    for _ in range(REPEATS):
        began, began_processor = time.perf_counter(), time.thread_time()
        msgspec.json.encode(asked.ask())
        processor.append(1e3 * (time.thread_time() - began_processor))
        clock.append(1e3 * (time.perf_counter() - began))
    return Measured(asked, statistics.median(clock), min(clock), min(processor), right)


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed.pages", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("database", type=Path, metavar="OUT.db")
    file = parser.parse_args().database
    if not file.is_file():
        sys.exit(
            f"{file} is not there: make it with `python -m benchmarks.speed.fill_database {file}`"
        )
    app = open_app(Settings(database=f"sqlite:///{file}"))
    try:
        app.service.ready()
        print(f"{_count(app):,} batches, {file.stat().st_size / 1e9:.2f} GB")
        every = asked_of(app)
        found = [measure(each) for each in tqdm(every, unit="page", disable=None)]
    finally:
        app.close()
    head = f"{'median ms':>10}{'fastest':>9}{'processor':>11}{'bound':>7}  answer"
    print(f"{'page':<12}{'data':<36}{head}")
    for each in found:
        print(each.line())
    return 0 if all(each.passed for each in found) else 1


def _is_list(found: Any) -> bool:
    return isinstance(found, list)


def _worst(app: App, start: Utc, end: Utc) -> float:
    """Greatest share of ambiguous stars, found by reading all batches."""
    with app.store.reading() as connection:
        found = connection.exec_driver_sql(
            "SELECT MAX(1.0 * ambiguous / observed) FROM results WHERE current = 1 AND "
            f"spacecraft = '{SPACECRAFT}' AND run = 'live' AND "
            f"time_ns >= {start.tai_ns} AND time_ns < {end.tai_ns}"
        ).scalar()
        return float(found or 0.0)


def _count(app: App) -> int:
    with app.store.reading() as connection:
        return int(connection.exec_driver_sql("SELECT COUNT(*) FROM batches").scalar() or 0)


if __name__ == "__main__":
    sys.exit(main())
