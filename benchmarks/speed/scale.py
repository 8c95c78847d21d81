"""Bytes per batch in SQLite, PostgreSQL and the archive.

    python -m benchmarks scale --quick      twenty thousand batches
    python -m benchmarks.speed.scale --batches 1000000

Batches of a simulated pass, one a second and no two alike, are recorded in bulk, five stars
each, moved to an archive with every verification, listed and counted before and after, restored,
and compared with what was recorded byte for byte.  The files of an archive hold a day each: what
a batch takes where there is one in five minutes is measured apart.  PostgreSQL is
measured where TEST_POSTGRESQL_URL names a scratch database.
"""

import argparse
import hashlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from itertools import islice
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from sqlalchemy import create_engine, select, text
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, at_most, equal
from benchmarks.record import ROOT
from benchmarks.report import Report
from benchmarks.speed.posts import FIRST
from benchmarks.speed.stored import milliseconds
from service.app.factory import App, open_app
from service.features.archive.archiving import PartFilter, archive, restore, verify_archive
from service.missions.mission import load_missions
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.storage.sql.migrations import upgrade
from service.storage.sql.tables import batches, results
from service.storage.store import Store
from service.times import Utc, parse_utc

BATCHES, QUICK_BATCHES = 1_000_000, 20_000
CHUNK = 250
SPACECRAFT = "XTE"
FIRST_READ = "the first list of 100"
"""Name of the first read, which opens a file and decompresses a part of its batches."""
MOST_BYTES, MOST_NUMERIC_BYTES = 800.0, 280.0
LEAST_OF_BULK, MOST_OF_LIVE = 1.0, 3.0
SELDOM, OFTEN = "one in 5 minutes", "one a second"
PERIODS_S = {SELDOM: 300.0, OFTEN: 1.0}
SELDOM_DAYS = 30
ARCHIVED = "archive: bytes a batch, {}"
TARGET = ROOT / "docs" / "scale.md"
DATABASES = {"sqlite": "SQLite", "postgresql": "PostgreSQL"}


def run(quick: bool, seed: int) -> Report:
    """Benchmark of scale."""
    return measured(QUICK_BATCHES if quick else BATCHES, seed)


def measured(count: int, seed: int) -> Report:
    """Record, archive, read and restore a number of batches."""
    figures: dict[str, Any] = {"batches": count}
    bounds: list[Bound] = []
    with tempfile.TemporaryDirectory() as folder:
        url = f"sqlite:///{Path(folder) / 'scale.db'}"
        figures |= filled(url, count, seed)
        figures |= _seldom(Path(folder), seed)
        bounds.append(at_most(*_of(figures, SELDOM), MOST_BYTES, "bytes a batch"))
        done, found = _archived(url, Path(folder), count)
        figures |= done
        bounds += found
        bounds.append(
            at_least(
                "archiving over recording in bulk",
                figures["archive: batches a second, verified"]
                / figures["SQLite: batches a second in bulk"],
                LEAST_OF_BULK,
            )
        )
    if postgresql := os.environ.get("TEST_POSTGRESQL_URL"):
        emptied(postgresql)
        upgrade(postgresql)
        figures |= filled(postgresql, count, seed)
        emptied(postgresql)
    return Report("scale", figures, bounds)


def _opened(url: str, folder: Path | None = None) -> App:
    app = open_app(Settings(database=url, archive_folder=folder))
    app.service.ready()
    return app


def filled(url: str, count: int, seed: int, period_s: float = PERIODS_S[OFTEN]) -> dict[str, Any]:
    """Record batches in bulk; returns the rate, and the resulting size of the database."""
    name = DATABASES[url.split(":")[0].split("+")[0]]
    made = drawn(count + CHUNK, seed, period_s)
    app = _opened(url)
    spent_s = 0.0
    try:
        # Build zones and open connections before the clock runs.
        _record(app, list(islice(made, CHUNK)), "first")
        before = _size(url)
        for _ in tqdm(range(0, count, CHUNK), desc=name, unit_scale=CHUNK, unit=" batches"):
            bodies = list(islice(made, CHUNK))
            started = time.perf_counter()
            _record(app, bodies, "live")
            spent_s += time.perf_counter() - started
    finally:
        app.close()
    size = _size(url) - before
    return {
        f"{name}: batches a second in bulk": count / spent_s,
        f"{name}: bytes a batch": size / count,
    }


def drawn(count: int, seed: int, period_s: float) -> Iterator[bytes]:
    """JSON bodies of the batches of a nominal pass of XTE."""
    sky = SkyModel(load_embedded(), LruCache(64 << 20))
    start = FIRST.strftime("%Y-%m-%dT%H:%M:%SZ")
    wanted = Pass(count, seed, start, cadence_s=period_s, troubles=NO_TROUBLES)
    for each in draw_pass(load_missions()[SPACECRAFT], sky, wanted):
        yield json.dumps(each.batch).encode()


def _seldom(folder: Path, seed: int) -> dict[str, float]:
    """Bytes per batch in an archive with few batches per day."""
    url, place = f"sqlite:///{folder / 'seldom.db'}", folder / "seldom"
    place.mkdir()
    app = _opened(url)
    try:
        count = round(SELDOM_DAYS * 86_400 / PERIODS_S[SELDOM])
        made = drawn(count, seed, PERIODS_S[SELDOM])
        while bodies := list(islice(made, CHUNK)):
            _record(app, bodies, "live")
    finally:
        app.close()
    store = Store(url, create=False)
    try:
        moved = archive(store, place, time_at(SELDOM_DAYS * 86_400.0))
    finally:
        store.close()
    return {ARCHIVED.format(SELDOM): bytes_in(place) / moved.batches}


def bytes_in(folder: Path) -> int:
    return sum(each.stat().st_size for each in folder.rglob("*") if each.is_file())


def _of(figures: dict[str, Any], period: str) -> tuple[str, float]:
    """Name and value of the archive's figure for a period."""
    name = ARCHIVED.format(period)
    return name, figures[name]


def _record(app: App, bodies: list[bytes], run: str) -> None:
    made = [submission_from_json(body, run=None if run == "live" else run) for body in bodies]
    app.submissions.submit_many(made)


def _archived(url: str, folder: Path, count: int) -> tuple[dict[str, Any], list[Bound]]:
    """Move all batches to an archive, and read them there."""
    place = folder / "archive"
    place.mkdir()
    live, recorded = _read_ms(url, None, count), _digest(url)
    end = time_at(count + 3_600)
    store = Store(url, create=False)
    started = time.perf_counter()
    try:
        moved = archive(store, place, end)
    finally:
        store.close()
    spent_s = time.perf_counter() - started
    archived = _read_ms(url, place, count)
    faults = list(verify_archive(place, {}, lambda _: None))
    store = Store(url, create=False)
    try:
        restored = restore(store, place, PartFilter())
    finally:
        store.close()
    figures: dict[str, Any] = {
        "archive: batches a second, verified": moved.batches / spent_s,
        ARCHIVED.format(OFTEN): bytes_in(place) / moved.batches,
        "archive: bytes a batch, numeric columns": _numeric_bytes(place) / moved.batches,
    }
    bounds = [
        equal("faults that verifying finds", len(faults), 0),
        equal("batches restored", restored.restored, moved.batches),
        same("inputs and answers, restored", _digest(url), recorded),
        at_most(*_of(figures, OFTEN), MOST_BYTES, "bytes a batch"),
        at_most(
            "archive, numeric columns",
            figures["archive: bytes a batch, numeric columns"],
            MOST_NUMERIC_BYTES,
            "bytes a batch",
        ),
    ]
    for what, took in archived.items():
        figures[f"{what}, live, ms"], figures[f"{what}, archived, ms"] = live[what], took
        if what != FIRST_READ:
            bounds.append(at_most(f"{what}, archived over live", took / live[what], MOST_OF_LIVE))
    return figures, bounds


def time_at(seconds: float) -> Utc:
    return parse_utc((FIRST + timedelta(seconds=seconds)).strftime("%Y-%m-%dT%H:%M:%SZ"))


def _read_ms(url: str, folder: Path | None, count: int) -> dict[str, float]:
    """Milliseconds of a page of a list and of trends, for batches due for archiving."""
    start, end = time_at(0), time_at(count / 2)
    app = _opened(url, folder)
    try:
        reads: dict[str, Callable[[], object]] = {
            "a list of 100": lambda: app.results.page(spacecraft=SPACECRAFT, end=end, limit=100),
            "trends by hour": lambda: app.spacecraft.rates(
                SPACECRAFT, start=start, end=end, bucket="hour"
            ),
        }
        started = time.perf_counter()
        reads["a list of 100"]()
        first = {FIRST_READ: (time.perf_counter() - started) * 1000.0}
        return first | {what: milliseconds(read) for what, read in reads.items()}
    finally:
        app.close()


def same(figure: str, measured: str, recorded: str) -> Bound:
    return Bound(f"{figure}: SHA-256", measured, recorded, measured == recorded)


def _digest(url: str) -> str:
    """Digest of all batches as received and answered, ordered by id."""
    state = hashlib.sha256()
    engine = create_engine(url)
    chosen = select(batches.c.id, batches.c.input, results.c.answer).where(
        results.c.batch_id == batches.c.id
    )
    with engine.connect() as connection:
        for row in connection.execute(chosen.order_by(batches.c.id)):
            state.update("\n".join(str(each) for each in row).encode())
    engine.dispose()
    return state.hexdigest()[:16]


def _numeric_bytes(folder: Path) -> int:
    """Compressed bytes of all numeric columns."""
    total = 0
    for path in folder.rglob("*.parquet"):
        file = pq.ParquetFile(path)
        kinds = _leaves(file.schema_arrow)
        for group in range(file.metadata.num_row_groups):
            for column, kind in enumerate(kinds):
                chunk = file.metadata.row_group(group).column(column)
                total += chunk.total_compressed_size if kind else 0
    return total


def _leaves(schema: pa.Schema) -> list[bool]:
    """Flags of the file's columns in their order, true for numeric ones."""

    def walk(kind: pa.DataType) -> list[bool]:
        if pa.types.is_struct(kind):
            return [each for field in kind for each in walk(field.type)]
        if pa.types.is_list(kind) or pa.types.is_large_list(kind):
            return walk(kind.value_type)
        number = (
            pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)
        )
        return [number]

    return [each for field in schema for each in walk(field.type)]


def _size(url: str) -> int:
    """Bytes of a closed or idle database."""
    if url.startswith("sqlite"):
        path = Path(url.removeprefix("sqlite:///"))
        return sum(
            Path(f"{path}{end}").stat().st_size
            for end in ("", "-wal")
            if Path(f"{path}{end}").exists()
        )
    engine = create_engine(url)
    with engine.connect() as connection:
        found = connection.execute(text("SELECT pg_database_size(current_database())")).scalar_one()
    engine.dispose()
    return int(found)


def emptied(url: str) -> None:
    """Delete all content of a scratch PostgreSQL database."""
    engine = create_engine(url)
    with engine.begin() as connection:
        connection.execute(text("DROP SCHEMA public CASCADE"))
        connection.execute(text("CREATE SCHEMA public"))
    engine.dispose()


def size_text(size: float) -> str:
    for unit, name in ((1e9, "GB"), (1e12, "TB")):
        # From 999.5 on, three digits would be written as 1e+03.
        if size < 999.5 * unit:
            return f"{size / unit:.3g} {name}"
    return f"{size / 1e15:.3g} PB"


def main() -> int:
    """Command that measures and prints; returns 1 if a figure is out of bounds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--batches", type=int, default=BATCHES)
    parser.add_argument("--seed", type=int, default=3)
    parsed = parser.parse_args()
    report = measured(parsed.batches, parsed.seed)
    print(report.text())
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
