"""Cost of the record's hash chain: processor time of a post, and bytes of a batch.

    python -m benchmarks chain

Posts come at 16 connections to the service as it is served; then the same results are hashed,
their leaves inserted in groups of 16 and bound into heads, each by itself on the processor's clock.
"""

import shutil
import sqlite3
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from statistics import median

from sqlalchemy import create_engine, insert, select

from benchmarks.bounds import at_most, equal
from benchmarks.report import Report
from benchmarks.speed.load import drive, request
from benchmarks.speed.posts import API, CONNECTIONS, telemetry
from benchmarks.speed.serving import service
from service.storage.projections import heads
from service.storage.projections.rollups import lock_position
from service.storage.recording import chain
from service.storage.sql.chain_tables import record_facts, record_heads, record_leaves
from service.storage.sql.statements import rows_of
from service.storage.sql.tables import results

POSTS, QUICK_POSTS = 6_000, 800
REPEATS = 5
MOST_SHARE, MOST_BYTES = 0.05, 60.0
CHAIN = ("record_leaves", "record_facts", "record_heads")


def _seconds(call: Callable[[], object]) -> float:
    spent = []
    for _ in range(REPEATS):
        began = time.thread_time()
        call()
        spent.append(time.thread_time() - began)
    return median(spent)


def _bytes(file: Path) -> int:
    """Bytes that the tables of the hash chain add to a database file without free pages."""
    sizes = []
    for without in (False, True):
        copy = file.with_name(f"without-{without}.db")
        shutil.copy(file, copy)
        with closing(sqlite3.connect(copy, isolation_level=None)) as database:
            for table in CHAIN if without else ():
                database.execute(f"DROP TABLE {table}")
            database.execute("VACUUM")
        sizes.append(copy.stat().st_size)
    return sizes[0] - sizes[1]


def run(quick: bool, seed: int) -> Report:
    """Benchmark of the hash chain."""
    count = QUICK_POSTS if quick else POSTS
    made = telemetry(seed)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "chain.db"
        with service(file) as served:
            warm = [request(f"{API}/batches", each) for each in made.bodies(400, "warm")]
            drive(served.port, warm, CONNECTIONS)
            bodies = [request(f"{API}/batches", each) for each in made.bodies(count, "post")]
            before_s = served.cpu_s()
            drive(served.port, bodies, CONNECTIONS)
            post_us = (served.cpu_s() - before_s) / count * 1e6
        engine = create_engine(f"sqlite:///{file}")
        with engine.begin() as connection:
            rows = rows_of(connection, select(results))
            contents = list(heads.contents(connection, rows))
            size = len(rows)
            bound = len(connection.execute(select(record_leaves)).all())

            def hash_all() -> list[bytes]:
                return [
                    chain.leaf_of(row["id"], row["answer"], content, bool(row["current"]))
                    for row, content in contents
                ]

            hash_us = _seconds(hash_all) / size * 1e6
            leaves = [
                {"seq": row["seq"], "leaf": leaf}
                for (row, _), leaf in zip(contents, hash_all(), strict=True)
            ]

            def insert_all() -> None:
                connection.execute(record_leaves.delete())
                for first in range(0, size, CONNECTIONS):
                    connection.execute(insert(record_leaves), leaves[first : first + CONNECTIONS])

            insert_us = _seconds(insert_all) / size * 1e6

            def bind() -> None:
                for table in (record_heads, record_facts):
                    connection.execute(table.delete())
                maker = heads.HeadMaker()
                while maker.make(connection, lock_position(connection)):
                    pass

            bind_us = _seconds(bind) / size * 1e6
        engine.dispose()
        added = _bytes(file) / size
    share = (hash_us + insert_us + bind_us) / post_us
    figures = {
        "processor time of a post at 16 connections, us": post_us,
        "hashing a result, us": hash_us,
        "inserting its leaf, us": insert_us,
        "binding it into a head, us": bind_us,
        "share of a post": share,
        "bytes a batch": added,
    }
    bounds = [
        equal("results with a leaf", bound, size),
        at_most("share of a post", share, MOST_SHARE),
        at_most("bytes a batch", added, MOST_BYTES, "bytes"),
    ]
    return Report("chain", figures, bounds)
