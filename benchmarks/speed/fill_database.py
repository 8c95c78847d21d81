"""Test database with millions of batches.

    python -m benchmarks.speed.fill_database OUT.db

All tables from which lists, trends and alarms are read have the rows that the writer would
write: batches, results, solutions, hourly and daily trends.  Answers and inputs are empty, and
stars are left out, except for the newest batches of each spacecraft: these are simulated, submitted
and answered like any other.
"""

import argparse
import json
import sqlite3
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from sqlalchemy import create_engine
from tqdm import tqdm

from service.app.factory import open_app
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.storage.recording.ids import Ulids
from service.storage.sql.tables import (
    COUNTS,
    MAXIMA,
    MEASURED,
    MINIMA,
    SHARES,
    SUMS,
    VALUES,
    batches,
    results,
    rollups_daily,
    rollups_hourly,
    runs,
    solutions,
)
from service.times import DAY_S, HOUR_S, UNIX_DAY, parse_utc

DEFAULT_BATCHES = 5_000_000
CHUNK = 100_000
CADENCE_S = 30
NEWEST = 100
"""Number of completely processed batches per spacecraft, after all filled-in ones."""
START = "1999-03-01T00:00:00.000Z"
"""First time; no leap second follows for almost seven years, so all steps are equal."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """Batches of one spacecraft in one run."""

    spacecraft: str
    run: str
    batches: int


def parts_of(total: int) -> list[Part]:
    """Parts of the database: three spacecraft in the live run, and one further run."""
    shares = {("XTE", "live"): 0.5, ("SWAS", "live"): 0.25, ("SOHO", "live"): 0.15}
    found = [Part(*key, round(total * share)) for key, share in shares.items()]
    return [*found, Part("XTE", "reprocessed", total - sum(each.batches for each in found))]


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed.fill_database", description=__doc__.splitlines()[0]
    )
    parser.add_argument("output", type=Path, metavar="OUT.db", help="a new SQLite file")
    parser.add_argument("--batches", type=int, default=DEFAULT_BATCHES, metavar="N")
    parser.add_argument("--seed", type=int, default=1, metavar="S")
    parser.add_argument("--newest", type=int, default=NEWEST, metavar="N", help="real ones, each")
    parsed = parser.parse_args()
    if parsed.output.exists():
        sys.exit(f"{parsed.output} is there already")
    fill(parsed.output, parsed.batches, parsed.seed, parsed.newest)
    print(f"{parsed.output}: {parsed.output.stat().st_size / 1e9:.2f} GB")


def fill(output: Path, total: int, seed: int, newest: int) -> None:
    """Write the database."""
    app = open_app(Settings(database=f"sqlite:///{output}"))
    digests = {each.name: each.digest for each in app.missions.values()}
    catalog = app.sky.catalog.digest
    app.close()
    connection = sqlite3.connect(output, isolation_level=None)
    # A fill that fails is begun anew: nothing here needs to be safe.
    for pragma in ("journal_mode = OFF", "synchronous = OFF", "cache_size = -400000"):
        connection.execute(f"PRAGMA {pragma}")
    indexes = [index for table in (batches, results) for index in table.indexes]
    for index in indexes:
        connection.execute(f"DROP INDEX {index.name}")
    rng, ids = np.random.default_rng(seed), Ulids()
    with tqdm(total=total, unit="batch", disable=None) as bar:
        for part in parts_of(total):
            connection.execute("BEGIN")
            _put(
                connection,
                runs.name,
                [{"name": part.run, "created": START, "alarms": 0}],
                or_ignore=True,
            )
            _fill_part(connection, part, (digests[part.spacecraft], catalog), rng, ids, bar)
            connection.execute("COMMIT")
    connection.close()
    engine = create_engine(f"sqlite:///{output}")
    for index in tqdm(indexes, unit="index", disable=None):
        index.create(engine)
    engine.dispose()
    _newest(output, total, seed, newest)


def _fill_part(
    connection: sqlite3.Connection,
    part: Part,
    digests: tuple[str, str],
    rng: np.random.Generator,
    ids: Ulids,
    bar: Any,
) -> None:
    start = parse_utc(START)
    start_s = int(np.datetime64(START[:-1], "s").astype(int))
    begun: dict[str, list[dict[str, Any]]] = {"hour": [], "day": []}
    for first in range(0, part.batches, CHUNK):
        place = np.arange(first, min(first + CHUNK, part.batches))
        unix_s = start_s + place * CADENCE_S
        drawn = _drawn(rng, place)
        _rows(connection, part, digests, ids, place, unix_s, start.tai_ns, drawn)
        for name, width_s in (("hour", HOUR_S), ("day", DAY_S)):
            begun[name] += _rollups(drawn, (unix_s + UNIX_DAY * DAY_S) // width_s)
        bar.update(len(place))
    for name, table in (("hour", rollups_hourly), ("day", rollups_daily)):
        key = {"spacecraft": part.spacecraft, "run": part.run}
        _put(connection, table.name, [key | row for row in _merged(begun[name])])


def _drawn(rng: np.random.Generator, place: npt.NDArray[np.int64]) -> dict[str, Floats]:
    """Columns of results: mostly nominal, with a bad hour every few days and missing attitudes."""
    n = len(place)
    bad = rng.random(n) < np.where((place * CADENCE_S // HOUR_S) % 97 == 13, 0.5, 0.01)
    ambiguous = np.where(bad, rng.integers(0, 4, n), 0)
    unmatched = np.where(bad, rng.integers(0, 2, n), 0)
    solved = ~(bad & (rng.random(n) < 0.2))
    predicted = rng.uniform(1.8, 2.4, n)
    rms = predicted * np.sqrt(rng.chisquare(7, n) / 7)
    columns = {
        "observed": np.full(n, 5.0),
        "ambiguous": ambiguous.astype(float),
        "unmatched": unmatched.astype(float),
        "unique": 5.0 - ambiguous - unmatched,
        "solved": solved.astype(float),
        "suspect": (solved & (rms > 1.7 * predicted)).astype(float),
        "residual_rms_arcsec": np.where(solved, rms, np.nan),
        "predicted_rms_arcsec": np.where(solved, predicted, np.nan),
        "magnitude_offset_mag": rng.normal(0.0, 0.05, n),
        "a_priori_angle_deg": np.where(solved, rng.uniform(0.2, 4.8, n), np.nan),
        "scale_offset_ppm": np.where(solved, rng.normal(0.0, 60.0, n), np.nan),
        "alignment_offset_arcsec": np.where(solved, rng.normal(0.0, 1.5, n), np.nan),
    }
    for name in MEASURED:
        columns.setdefault(name, np.full(n, np.nan))
    columns["residual_ratio"] = columns["residual_rms_arcsec"] / columns["predicted_rms_arcsec"]
    for name in SHARES:
        columns[name] = columns[name.removesuffix("_share")] / 5.0
    return columns


def _rows(
    connection: sqlite3.Connection,
    part: Part,
    digests: tuple[str, str],
    ids: Ulids,
    place: npt.NDArray[np.int64],
    unix_s: npt.NDArray[np.int64],
    start_ns: int,
    drawn: dict[str, Floats],
) -> None:
    texts = [f"{each}Z" for each in np.datetime_as_string(unix_s.astype("datetime64[s]"), "ms")]
    time_ns = (start_ns + place * CADENCE_S * 10**9).tolist()
    listed = {name: _listed(values) for name, values in drawn.items()}
    named = [ids.new() for _ in texts]
    columns = {
        "id": named,
        "batch_id": named,
        "time_ns": time_ns,
        "created": texts,
        **{n: listed[n] for n in ("observed", "unique", "ambiguous", "unmatched")},
        **{n: listed[n] for n in MEASURED},
        "status": [
            ("suspect" if suspect else "good") if solved else None
            for solved, suspect in zip(listed["solved"], listed["suspect"], strict=True)
        ],
        "reason": [
            None if solved else "fewer_than_two_unique_stars" for solved in listed["solved"]
        ],
    }
    fixed = {
        "parent_id": None,
        "current": 1,
        "spacecraft": part.spacecraft,
        "run": part.run,
        "identifier": "verified",
        "options": "{}",
        "mission_digest": digests[0],
        "catalog_digest": digests[1],
        "answer": "{}",
        # A service gives digests to those that have none, beside what is measured.
        "digest": 0,
    }
    sent = {
        "id": named,
        "batch": [f"fill-{each}" for each in place.tolist()],
        "time": texts,
        "time_ns": time_ns,
        "received": texts,
    }
    same = {"spacecraft": part.spacecraft, "run": part.run, "fingerprint": "0", "input": "{}"}
    _put_columns(connection, batches.name, sent, same)
    _put_columns(connection, results.name, columns, fixed)
    solved_at = np.flatnonzero(drawn["solved"]).tolist()
    attitudes = {
        "result_id": [named[k] for k in solved_at],
        **{
            n: [listed[n][k] for k in solved_at]
            for n in ("residual_rms_arcsec", "predicted_rms_arcsec")
        },
        "status": [columns["status"][k] for k in solved_at],
    }
    unit = {"q1": 0.0, "q2": 0.0, "q3": 0.0, "qc": 1.0, "frame": "EME2000", "taste": 7.0}
    covariance = {"p11": 100.0, "p12": 0.0, "p13": 0.0, "p22": 100.0, "p23": 0.0, "p33": 400.0}
    _put_columns(connection, solutions.name, attitudes, unit | covariance | {"method": "quest"})


def _rollups(drawn: dict[str, Floats], bucket: npt.NDArray[np.int64]) -> Iterator[dict[str, Any]]:
    """Rollup of every bucket in a chunk (see `rolled_up` of the result metrics)."""
    numbers, first = np.unique(bucket, return_index=True)
    columns: dict[str, Any] = {"bucket": numbers.tolist()}
    columns["batches"] = np.diff([*first.tolist(), len(bucket)]).tolist()
    for name in COUNTS[1:]:
        columns[name] = np.add.reduceat(drawn[name], first).astype(int).tolist()
    for name in VALUES:
        there = ~np.isnan(drawn[name])
        columns[f"{name}_n"] = np.add.reduceat(there.astype(int), first).tolist()
        columns[f"{name}_sum"] = np.add.reduceat(np.nan_to_num(drawn[name]), first).tolist()
    for names, ufunc in ((MINIMA, np.fmin), (MAXIMA, np.fmax)):
        for name in names:
            columns[name] = _listed(ufunc.reduceat(drawn[name[:-4]], first))
    for row in zip(*columns.values(), strict=True):
        yield dict(zip(columns, row, strict=True))


def _merged(rows: Sequence[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Rollups in order; those of a bucket that is split between two chunks are combined."""
    last: dict[str, Any] | None = None
    for row in rows:
        if last is None or row["bucket"] != last["bucket"]:
            if last is not None:
                yield last
            last = dict(row)
            continue
        for name in (*COUNTS, *SUMS):
            last[name] += row[name]
        for names, pick in ((MINIMA, min), (MAXIMA, max)):
            for name in names:
                both = [each for each in (last[name], row[name]) if each is not None]
                last[name] = pick(both) if both else None
    if last is not None:
        yield last


def _newest(output: Path, total: int, seed: int, newest: int) -> None:
    """Append completely processed batches with stars, answers and related rows."""
    if not newest:
        return
    app = open_app(Settings(database=f"sqlite:///{output}"))
    try:
        for part in tqdm(parts_of(total)[:3], unit="spacecraft", disable=None):
            after_s = part.batches * CADENCE_S
            moment = np.datetime64(START[:-1], "s") + np.timedelta64(after_s, "s")
            wanted = Pass(newest, seed, start=f"{moment}.000Z", cadence_s=CADENCE_S)
            mission = app.missions[part.spacecraft]
            lines = [json.dumps(each.batch) for each in draw_pass(mission, app.sky, wanted)]
            app.submissions.submit_many([submission_from_json(line.encode()) for line in lines])
    finally:
        app.close()


def _listed(values: Floats) -> list[Any]:
    listed = values.astype(object)
    listed[np.isnan(values)] = None
    return list(listed.tolist())


def _put_columns(
    connection: sqlite3.Connection, table: str, columns: dict[str, Any], fixed: dict[str, Any]
) -> None:
    names = [*columns, *fixed]
    marks = ["?"] * len(columns) + [f":{name}" for name in fixed]
    values = [repr(value) if isinstance(value, str) else value for value in fixed.values()]
    marks[len(columns) :] = ["NULL" if value is None else str(value) for value in values]
    quoted = ", ".join(f'"{name}"' for name in names)
    sql = f"INSERT INTO {table} ({quoted}) VALUES ({', '.join(marks)})"
    connection.executemany(sql, zip(*columns.values(), strict=True))


def _put(connection: sqlite3.Connection, table: str, rows: Any, or_ignore: bool = False) -> None:
    rows = list(rows)
    if rows:
        quoted = ", ".join(f'"{name}"' for name in rows[0])
        marks = ", ".join(f":{name}" for name in rows[0])
        how = "INSERT OR IGNORE" if or_ignore else "INSERT"
        connection.executemany(f"{how} INTO {table} ({quoted}) VALUES ({marks})", rows)


if __name__ == "__main__":
    main()
