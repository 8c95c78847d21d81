"""Sums and extremes over a stretch of time, read as coarsely as asked and yet exact at both ends.

A cell is a day, an hour or a single batch, with the columns of a rollup.  Whole
days and hours come from the rollups; what a stretch cuts off at its ends is
made up of smaller cells, down to the batches themselves.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from sqlalchemy import Connection, Select, Table, bindparam, select

from service.records.draft import Row
from service.records.tables import (
    COUNTS,
    MAXIMA,
    MEASURED,
    MINIMA,
    SHARES,
    SUMS,
    VALUES,
    results,
    rollups_daily,
    rollups_hourly,
)
from service.times import DAY_S, HOUR_S, UNIX_DAY, Utc, bucket_start, unix_seconds
from service.vectors import Vector

Level = Literal["batch", "hour", "day"]
Columns = dict[str, Vector]
"""`unix_s`, the cell's beginning, `width_s`, zero of a batch, and the columns of a rollup."""

_COARSE: dict[Level, tuple[Table, int, Level]] = {
    "hour": (rollups_hourly, HOUR_S, "batch"),
    "day": (rollups_daily, DAY_S, "hour"),
}
_NAMES = (*COUNTS, *SUMS, *MINIMA, *MAXIMA)


@dataclass(frozen=True)
class Span:
    """A spacecraft's current results in a run, from `start` to before `end`."""

    spacecraft: str
    run: str
    start: Utc
    end: Utc


def read_cells(connection: Connection, span: Span, level: Level) -> Columns:
    """The cells of a span, in order of time; those without a batch are left out."""
    if span.start.tai_ns >= span.end.tai_ns:
        return _of_batches([])
    if level == "batch":
        return _of_batches(_batches(connection, span))
    table, width_s, finer = _COARSE[level]
    first, last = (_at_or_after(span.start, width_s), span.end.bucket(width_s))
    if first >= last:
        return read_cells(connection, span, finer)
    begin, end = bucket_start(first, width_s), bucket_start(last, width_s)
    parts = [
        read_cells(connection, replace(span, end=begin), finer),
        _whole(connection, span, table, width_s, first, last),
        read_cells(connection, replace(span, start=end), finer),
    ]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def totals(cells: Columns) -> Row:
    """The counts of all cells together."""
    return {name: int(cells[name].sum()) for name in COUNTS}


def _at_or_after(moment: Utc, width_s: int) -> int:
    number = moment.bucket(width_s)
    return number + (bucket_start(number, width_s).tai_ns < moment.tai_ns)


def _stretch_of(table: Table) -> Select[Any]:
    """The rows of a rollup in a stretch; made once, for to make it takes longer than to run it."""
    columns = table.c
    return (
        select(columns.bucket, *(columns[name] for name in _NAMES))
        .where(
            columns.spacecraft == bindparam("spacecraft"),
            columns.run == bindparam("run"),
            columns.bucket >= bindparam("first"),
            columns.bucket < bindparam("last"),
            columns.batches > 0,
        )
        .order_by(columns.bucket)
    )


_STRETCHES = {table: _stretch_of(table) for table in (rollups_hourly, rollups_daily)}


def _whole(
    connection: Connection, span: Span, table: Table, width_s: int, first: int, last: int
) -> Columns:
    asked = {"spacecraft": span.spacecraft, "run": span.run, "first": first, "last": last}
    # As tuples: numpy would ask each of SQLAlchemy's rows for more than its values.
    rows = [tuple(row) for row in connection.execute(_STRETCHES[table], asked).all()]
    read = np.array(rows, dtype=float).reshape(-1, 1 + len(_NAMES)).T
    unix_s = read[0] * width_s - UNIX_DAY * DAY_S
    return {
        "unix_s": unix_s,
        "width_s": np.full(len(unix_s), float(width_s)),
        **dict(zip(_NAMES, read[1:], strict=True)),
    }


_BATCHES = (
    select(
        *(results.c[name] for name in ("time_ns", "status", "unique", "ambiguous", "unmatched")),
        *(results.c[name] for name in MEASURED),
    )
    .where(
        results.c.current,
        results.c.spacecraft == bindparam("spacecraft"),
        results.c.run == bindparam("run"),
        results.c.time_ns >= bindparam("start_ns"),
        results.c.time_ns < bindparam("end_ns"),
    )
    .order_by(results.c.time_ns)
)


def _batches(connection: Connection, span: Span) -> list[Any]:
    asked = {
        "spacecraft": span.spacecraft,
        "run": span.run,
        "start_ns": span.start.tai_ns,
        "end_ns": span.end.tai_ns,
    }
    return list(connection.execute(_BATCHES, asked).all())


def _of_batches(rows: list[Any]) -> Columns:
    """Cells of one batch each; NaN stands for what a batch has not."""
    columns = list(zip(*rows, strict=True)) if rows else [()] * (5 + len(MEASURED))
    time_ns, status, *numbers = columns
    unique, ambiguous, unmatched, *measured = (np.array(each, dtype=float) for each in numbers)
    observed = unique + ambiguous + unmatched
    values = dict(zip(MEASURED, measured, strict=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        values["residual_ratio"] = np.where(
            values["predicted_rms_arcsec"] > 0,
            values["residual_rms_arcsec"] / values["predicted_rms_arcsec"],
            np.nan,
        )
        shares = dict(zip(SHARES, (ambiguous / observed, unmatched / observed), strict=True))
    cells: Columns = {
        "unix_s": unix_seconds(np.array(time_ns, dtype=np.int64)),
        "width_s": np.zeros(len(rows)),
        "batches": np.ones(len(rows)),
        "observed": observed,
        "unique": unique,
        "ambiguous": ambiguous,
        "unmatched": unmatched,
        "solved": np.array([each is not None for each in status], dtype=float),
        "suspect": np.array([each == "suspect" for each in status], dtype=float),
    }
    for name in VALUES:
        cells[f"{name}_n"] = (~np.isnan(values[name])).astype(float)
        cells[f"{name}_sum"] = np.nan_to_num(values[name])
    for name, value in (shares | values).items():
        cells[f"{name}_min"] = cells[f"{name}_max"] = value
    return cells
