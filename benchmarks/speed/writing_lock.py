"""What the lock of the one service that writes to PostgreSQL costs a post.

    python -m benchmarks.speed.writing_lock

TEST_POSTGRESQL_URL names a scratch database, which is emptied.  Transactions that change one row
are written alternately with and without the lock, so that a busy machine slows both alike.
"""

import argparse
import os
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import Connection, update

from benchmarks.bounds import at_most
from benchmarks.report import Report
from benchmarks.speed.scale import emptied
from service.storage.recording.writer import Writer
from service.storage.sql.engines import TO_COMMIT, database_url, writing_engine
from service.storage.sql.migrations import upgrade
from service.storage.sql.tables import event_counter
from service.storage.sql.writing_lock import WritingLock

TRANSACTIONS, WARM_UP = 10_000, 200
MOST = 1.05
"""Times as long as without the lock."""
PLAIN, LOCKED = "without the lock, us", "with the lock, us"


def measured(transactions: int, url: str) -> Report:
    """The median duration of a transaction, with the lock and without it."""
    upgrade(url)
    found: dict[str, list[float]] = {PLAIN: [], LOCKED: []}
    with _writer(url, None) as plain, _writer(url, WritingLock()) as locked:
        for number in range(WARM_UP + transactions):
            for name, writer in ((PLAIN, plain), (LOCKED, locked)):
                duration_us = _microseconds(writer)
                if number >= WARM_UP:
                    found[name].append(duration_us)
    figures = {name: statistics.median(values) for name, values in found.items()}
    ratio = figures[LOCKED] / figures[PLAIN]
    return Report("writing lock", figures, [at_most("with over without the lock", ratio, MOST)])


@contextmanager
def _writer(url: str, lock: WritingLock | None) -> Iterator[Writer]:
    # Waiting for the disk would hide the difference.
    without_disk = {"options": "-csynchronous_commit=off"}
    engine = writing_engine(database_url(url).update_query_dict(without_disk), timeouts=TO_COMMIT)
    writer = Writer(engine, lock=lock)
    try:
        writer.take_lock()
        yield writer
    finally:
        writer.close()
        engine.dispose()


def _microseconds(writer: Writer) -> float:
    start = time.perf_counter()
    writer.change(_change_a_row).result()
    return 1e6 * (time.perf_counter() - start)


def _change_a_row(connection: Connection) -> None:
    connection.execute(update(event_counter).values(last=event_counter.c.last + 1))


def main() -> int:
    """Measure and print; 1 without a database, or where a figure is out of bounds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--transactions", type=int, default=TRANSACTIONS, help="of either kind")
    parsed = parser.parse_args()
    url = os.environ.get("TEST_POSTGRESQL_URL")
    if url is None:
        print("TEST_POSTGRESQL_URL must name a scratch database", file=sys.stderr)
        return 1
    emptied(url)
    report = measured(parsed.transactions, url)
    emptied(url)
    print(report.text())
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
