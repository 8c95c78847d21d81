"""What it takes to take old batches out of PostgreSQL, row by row and as partitions.

    python -m benchmarks.speed.pruning --recorded 10000 --days 20

TEST_POSTGRESQL_URL names a scratch database, which is emptied.  Batches of a pass are recorded
in bulk and copied to further days.  The older half of the days is pruned; a list and trends are
read before, after, and after VACUUM; as many batches are put in their place; then these
are archived.  Beside that, the same rows of the four largest tables are dropped as partitions.
"""

import argparse
import os
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

from sqlalchemy import Engine, create_engine, inspect
from tqdm import tqdm

from benchmarks.bounds import at_most, equal
from benchmarks.report import Report
from benchmarks.speed.scale import SPACECRAFT, emptied, filled, time_at
from benchmarks.speed.stored import milliseconds
from service.app.factory import open_app
from service.features.archive.archiving import archive
from service.settings import Settings
from service.storage.sql.migrations import upgrade
from service.storage.store import Store
from service.storage.upkeep.prune import prune
from service.times import Utc

RECORDED, DAYS = 10_000, 20
MOST_AGAIN = 1.25
"""Greatest growth after refilling, as a ratio: space freed by VACUUM is used again."""
BULK = "PostgreSQL: batches a second in bulk"
DAY_S = 86_400
LARGEST = ("batches", "results", "star_results", "solutions")
TRENDS = (
    "rollups_hourly",
    "rollups_daily",
    "tracker_rollups_hourly",
    "tracker_rollups_daily",
)
COPIED = (*LARGEST, "tracker_values", *TRENDS)
# First letter of a copy's ids, by day; recorded ids begin with 0 in this millennium.
_LETTERS = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
_KEYS = ("id", "batch_id", "result_id")
# Sessions that still see rows as they were before a transaction.
_OTHERS = """SELECT count(*) FROM pg_stat_activity
    WHERE datname = current_database() AND pid <> pg_backend_pid()
    AND greatest(age(backend_xid), age(backend_xmin)) > age(CAST(%s AS xid))"""
_OTHERS_TRIES, _OTHERS_PAUSE_S = 600, 0.1
_LATER = """to_char(
    CAST(time AS timestamptz) AT TIME ZONE 'UTC' + make_interval(days => {shift}),
    'YYYY-MM-DD"T"HH24:MI:SS.MS"Z"')"""


def measured(recorded: int, days: int, seed: int, url: str) -> Report:
    """Fill an empty database, and prune its batches."""
    upgrade(url)
    count, half = recorded * days, days // 2
    figures: dict[str, float] = {"batches": count, "of these pruned": recorded * half}
    figures[BULK] = filled(url, recorded, seed)[BULK]
    engine = create_engine(url)
    try:
        _forget_first(url)
        for day in tqdm(range(1, days), desc="copying", unit=" days"):
            _copy(engine, 0, day)
        _vacuum(engine, "FULL, ANALYZE")
        for table, size in _sizes(engine).items():
            figures[f"{table}: bytes a batch"] = size / count
        figures["bytes: filled"] = _size(engine)
        figures |= _dropped(engine, half)
        figures |= _pruned(url, engine, half)
        for day in tqdm(range(half), desc="copying", unit=" days"):
            _copy(engine, days - 1, day)
        figures["bytes: filled again"] = _size(engine)
        figures |= _archived(url, half)
    finally:
        engine.dispose()
    bounds = [
        equal("batches pruned", int(figures.pop("pruned: batches")), recorded * half),
        equal("batches archived", int(figures.pop("archived: batches")), recorded * half),
        at_most(
            "bytes: filled again over filled",
            figures["bytes: filled again"] / figures["bytes: filled"],
            MOST_AGAIN,
        ),
    ]
    return Report("pruning", figures, bounds)


def _forget_first(url: str) -> None:
    """Delete the first run, which was recorded before the timed one."""
    store = Store(url, create=False)
    prune(store, time_at(DAY_S), "first")
    store.close()


def _copy(engine: Engine, source: int, day: int) -> None:
    """Copy the batches of one day to another, with results and trends."""
    shift = day - source
    with engine.begin() as connection:
        for table in COPIED:
            columns = [each["name"] for each in inspect(engine).get_columns(table)]
            new = dict.fromkeys(_KEYS, "'{}' || substr({}, 2)")
            new = {name: form.format(_LETTERS[day], name) for name, form in new.items()}
            new |= {"time_ns": f"time_ns + {shift * DAY_S * 10**9}", "batch": f"batch || '-{day}'"}
            new["time"] = _LATER.format(shift=shift)
            keys = [f"{each} LIKE '{_LETTERS[source]}%%'" for each in _KEYS if each in columns]
            chosen = keys[0] if keys else ""
            if table in TRENDS:
                width = 1 if table.endswith("daily") else 24
                new["bucket"] = f"bucket + {shift * width}"
                first = time_at(source * DAY_S).bucket(DAY_S) * width
                chosen = f"bucket BETWEEN {first} AND {first + width - 1}"
            names = ", ".join(f'"{each}"' for each in columns)
            values = ", ".join(new.get(each, f'"{each}"') for each in columns)
            sql = f"INSERT INTO {table} ({names}) SELECT {values} FROM {table} WHERE {chosen}"
            connection.exec_driver_sql(sql)


def _pruned(url: str, engine: Engine, days: int) -> dict[str, float]:
    """Delete the batches of the first days, an hour at a time, then VACUUM."""
    figures = _reads(url, "filled", _noon(days))
    ends = []
    store = Store(url, create=False)
    start = time.perf_counter()
    done = prune(store, _noon(days), step=lambda _: ends.append(time.perf_counter()))
    store.close()
    spent_s = ends[-1] - start
    figures["pruned: batches"] = done.batches
    figures["pruned: batches a second"] = done.batches / spent_s
    figures["pruned: longest transaction, s"] = max(b - a for a, b in pairwise(ends))
    figures["bytes: pruned"] = _size(engine)
    figures |= _reads(url, "pruned", _noon(days))
    figures["VACUUM, s"] = _vacuum(engine, "ANALYZE")
    figures["bytes: pruned, after VACUUM"] = _size(engine)
    return figures | _reads(url, "after VACUUM", _noon(days))


def _archived(url: str, days: int) -> dict[str, float]:
    """Archive the batches of the first days."""
    store = Store(url, create=False)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        done = archive(store, Path(folder), _noon(days))
        spent_s = time.perf_counter() - start
    store.close()
    rate = done.batches / spent_s
    return {"archived: batches": done.batches, "archived and verified: batches a second": rate}


def _dropped(engine: Engine, days: int) -> dict[str, float]:
    """Copy the rows of several days in the largest tables to partitions, and drop these."""
    letters = ", ".join(f"'{each}'" for each in _LETTERS[:days])
    with engine.begin() as connection:
        for table in LARGEST:
            key = "result_id" if table in ("star_results", "solutions") else "id"
            chosen = f"left({key}, 1) IN ({letters})"
            for sql in (
                f"CREATE TABLE split_{table} (LIKE {table}) PARTITION BY RANGE ({key})",
                f"CREATE TABLE month_{table} (LIKE {table} INCLUDING ALL)",
                f"INSERT INTO month_{table} SELECT * FROM {table} WHERE {chosen}",
                f"ALTER TABLE split_{table} ATTACH PARTITION month_{table} DEFAULT",
            ):
                connection.exec_driver_sql(sql)
    start = time.perf_counter()
    with engine.begin() as connection:
        for table in LARGEST:
            connection.exec_driver_sql(f"DROP TABLE month_{table}")
    spent_s = time.perf_counter() - start
    with engine.begin() as connection:
        for table in LARGEST:
            connection.exec_driver_sql(f"DROP TABLE split_{table}")
    return {"dropped as partitions, s": spent_s}


def _noon(day: int) -> Utc:
    """Time one hour before the first batch of a day."""
    return time_at(day * DAY_S - 3_600)


def _reads(url: str, when: str, cut: Utc) -> dict[str, float]:
    """Milliseconds of a list, empty after pruning, and of a history summed over batches."""
    app = open_app(Settings(database=url))
    try:
        reads = {
            "a list before the cut": lambda: app.results.page(end=cut, limit=100),
            "a whole history": lambda: app.spacecraft.history(SPACECRAFT, size=100),
        }
        return {f"{what}, {when}, ms": milliseconds(read) for what, read in reads.items()}
    finally:
        app.close()


def _sizes(engine: Engine) -> dict[str, int]:
    """Bytes of the large tables with their auxiliary storage, and of their indexes."""
    found = {}
    with engine.connect() as connection:
        for table in LARGEST:
            for part, function in (("rows", "pg_table_size"), ("indexes", "pg_indexes_size")):
                query = f"SELECT {function}('{table}')"
                found[f"{table}, {part}"] = int(connection.exec_driver_sql(query).scalar_one())
    return found


def _size(engine: Engine) -> int:
    with engine.connect() as connection:
        sizes = [f"pg_total_relation_size('{each}')" for each in COPIED]
        query = f"SELECT {' + '.join(sizes)}"
        return int(connection.exec_driver_sql(query).scalar_one())


def _vacuum(engine: Engine, how: str) -> float:
    """Seconds of a VACUUM of the tables, after no session can see the deleted rows any longer.

    VACUUM keeps a deleted row while any session of the database has a snapshot from before the
    deletion.  If such a session stays open too long, the figures include its rows.
    """
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        deleted = connection.exec_driver_sql("SELECT pg_current_xact_id()::xid").scalar_one()
        for _ in range(_OTHERS_TRIES):
            if not connection.exec_driver_sql(_OTHERS, (deleted,)).scalar_one():
                break
            time.sleep(_OTHERS_PAUSE_S)
        start = time.perf_counter()
        connection.exec_driver_sql(f"VACUUM ({how}) {', '.join(COPIED)}")
    return time.perf_counter() - start


def main() -> int:
    """Command that measures and prints; returns 1 without a database, or out of bounds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--recorded", type=int, default=RECORDED, help="batches of a day, 40000 at most"
    )
    parser.add_argument("--days", type=int, default=DAYS)
    parser.add_argument("--seed", type=int, default=3)
    parsed = parser.parse_args()
    url = os.environ.get("TEST_POSTGRESQL_URL")
    if url is None:
        print("TEST_POSTGRESQL_URL must name a scratch database", file=sys.stderr)
        return 1
    emptied(url)
    report = measured(parsed.recorded, parsed.days, parsed.seed, url)
    emptied(url)
    print(report.text())
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
