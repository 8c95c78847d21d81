"""What a year of 1 to 10,000 spacecraft takes, and how busy one service is with it.

    python -m benchmarks.speed.fleet_year            print
    python -m benchmarks.speed.fleet_year --write    into docs/scale.md

Batches of five stars, one a minute and no two alike, are recorded in bulk and archived; their
bytes do not depend on the machine.  The bytes at other rates are computed with the same bytes a
batch.  PostgreSQL is measured where TEST_POSTGRESQL_URL names a
scratch database.  The rate of posts is that of docs/performance.md.
"""

import argparse
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from benchmarks.record import SERVICE, record_of
from benchmarks.sections import table
from benchmarks.speed.performance import RESULTS
from benchmarks.speed.scale import DATABASES, TARGET, bytes_in, emptied, filled, size_text, time_at
from service.features.archive.archiving import archive
from service.storage.sql.migrations import upgrade
from service.storage.store import Store

BATCHES, EVERY_S = 10_000, 60.0
FLEETS = (1, 100, 1_000, 10_000)
PERIODS_S = {"one in 5 minutes": 300.0, "one a minute": 60.0, "one a second": 1.0}
YEAR_S = 365 * 86_400
ARCHIVE = "the archive"


def bytes_a_batch(count: int, seed: int) -> dict[str, float]:
    """Bytes per batch with its answer, trends and all related rows."""
    found = {}
    with tempfile.TemporaryDirectory() as name:
        url, place = f"sqlite:///{Path(name) / 'year.db'}", Path(name) / "archive"
        urls = [url]
        if postgresql := os.environ.get("TEST_POSTGRESQL_URL"):
            emptied(postgresql)
            upgrade(postgresql)
            urls.append(postgresql)
        for kind, database in zip(DATABASES.values(), urls, strict=False):
            found[kind] = filled(database, count, seed, EVERY_S)[f"{kind}: bytes a batch"]
        place.mkdir()
        store = Store(url, create=False)
        try:
            moved = archive(store, place, time_at((count + 2_000) * EVERY_S))
        finally:
            store.close()
        found[ARCHIVE] = bytes_in(place) / moved.batches
        if postgresql:
            emptied(postgresql)
    return found


def year(sizes: Mapping[str, float], posts_a_second: float) -> str:
    """Markdown table of fleets."""
    rows = []
    for spacecraft in FLEETS:
        for label, period_s in PERIODS_S.items():
            rate = spacecraft / period_s
            batches = rate * YEAR_S
            share = f"{100 * rate / posts_a_second:.2g} %"
            if rate > posts_a_second:
                share = f"{rate / posts_a_second:.2g} services' posts"
            row = [f"{spacecraft:,}", label, number_text(batches), number_text(rate), share]
            rows.append((*row, *(size_text(size * batches) for size in sizes.values())))
    head = ("spacecraft", "batches of each", "batches a year", "a second", "of one service's posts")
    return table([*head, *(f"a year in {name}" for name in sizes)], rows)


def number_text(number: float) -> str:
    """Text of a number rounded to three digits, without an exponent: 105,000."""
    rounded = float(f"{number:.3g}")
    return f"{rounded:,.0f}" if rounded >= 1_000 else f"{rounded:g}"


def main() -> None:
    """Command that measures, prints, and writes the page on request."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--batches", type=int, default=BATCHES)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--write", action="store_true", help="the year of docs/scale.md")
    parsed = parser.parse_args()
    figures = json.loads(RESULTS.read_text("utf-8"))["benchmarks"]["posts"]["figures"]
    posts = figures["single: service posts a second"]
    sizes = bytes_a_batch(parsed.batches, parsed.seed)
    head = [("bytes a batch", *(f"{size:,.0f}" for size in sizes.values()))]
    text = f"{table(('', *sizes), head)}\n\n{year(sizes, posts)}"
    print(text)
    if parsed.write:
        start, end = "<!-- measured by benchmarks.speed.fleet_year -->", "<!-- end of year -->"
        before, _, rest = TARGET.read_text(encoding="utf-8").partition(start)
        again = (
            f"python -m benchmarks.speed.fleet_year --batches {parsed.batches} --seed {parsed.seed}"
        )
        said = (
            f"One service takes {posts:,.0f} posts a second over 16 connections ([performance.md]"
        )
        said += f"(performance.md)). {record_of(SERVICE).sentence} Again: `{again}`."
        part = f"{start}\n\n{text}\n\n{said}\n{end}"
        TARGET.write_text(before + part + rest.partition(end)[2], encoding="utf-8")


if __name__ == "__main__":
    main()
