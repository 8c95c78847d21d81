"""Storage of gyro blocks: each recorded once, listed, read, and exported as a table of samples."""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from sqlalchemy import ColumnElement, Connection, func, insert, select

from service.contract.base import Page
from service.contract.spacecraft import GyroBlockRow, GyroSamples
from service.errors import AcquisitionError, BadBatch, Conflict, Fault, NotFound, shown_value
from service.gyro import blocks as gyro
from service.storage.recording import events
from service.storage.sql.columns import Row
from service.storage.sql.statements import insert_runs
from service.storage.sql.tables import gyro_blocks, runs
from service.table_files.table import Column, Table
from service.table_files.table import Page as TablePage
from service.times import Utc, recorded_utc, shifted
from service.vectors import Vector

SHOWN = GyroBlockRow.__struct_fields__
SPAN_NS = int(gyro.MAX_SPAN_S) * 10**9
TIMES = [gyro_blocks.c[name] for name in ("start_ns", "samples", "step_s", "times_s")]
"""Columns of a gyro block's row from which the times of its samples are computed."""


@dataclass(frozen=True)
class Recorded:
    """Outcome of recording a gyro block: the block, and whether it was known before."""

    row: GyroBlockRow
    replayed: bool


@dataclass(frozen=True)
class BlockFilter:
    """Filter that selects the gyro blocks of a spacecraft and a run with a time in a period.

    A block counts from its first sample to its last.
    """

    spacecraft: str
    run: str
    start: Utc | None = None
    end: Utc | None = None

    def conditions(self) -> list[ColumnElement[bool]]:
        """Convert the filter of gyro blocks to SQL conditions."""
        c = gyro_blocks.c
        chosen = [c.spacecraft == self.spacecraft, c.run == self.run]
        if self.start is not None:
            # The index has only the start, and no block spans more than SPAN_NS.
            chosen += [c.end_ns >= self.start.tai_ns, c.start_ns >= self.start.tai_ns - SPAN_NS]
        if self.end is not None:
            chosen.append(c.start_ns < self.end.tai_ns)
        return chosen


def row_of(block: gyro.GyroBlock, id: str, received: Utc) -> Row:
    """Database row of a new gyro block."""
    times_ns = block.tai_ns
    return {
        "id": id,
        "spacecraft": block.spacecraft,
        "run": block.run,
        "block": block.block,
        "start": block.start.text,
        "end": block.end.text,
        "start_ns": int(times_ns[0]),
        "end_ns": int(times_ns[-1]),
        "received": received.text,
        "fingerprint": block.fingerprint,
        "samples": times_ns.size,
        "step_s": block.step_s,
        "times_s": gyro.pack(block.times_s) if block.step_s is None else None,
        "rates_rad_per_s": gyro.pack(block.rates_rad_per_s),
    }


def find_block(connection: Connection, block: gyro.GyroBlock, row: Row) -> GyroBlockRow | None:
    """Find a recorded gyro block with the same body; None if there is none.

    Raises `Conflict` where another body has its name, `SampleTaken` where another block holds one
    of its times.
    """
    c = gyro_blocks.c
    names = ("spacecraft", "run", "block")
    same = select(gyro_blocks).where(*(c[name] == row[name] for name in names))
    found = connection.execute(same).mappings().first()
    where = f"{block.spacecraft}, run {block.run}: block {shown_value(block.block)}"
    if found is not None:
        if found["fingerprint"] != row["fingerprint"]:
            raise Conflict(f"{where} is recorded with another body")
        return shown(found)
    times_ns = block.tai_ns
    near = select(c.block, c.end_ns, *TIMES).where(
        c.spacecraft == block.spacecraft,
        c.run == block.run,
        c.start_ns < row["end_ns"] + gyro.SAME_TIME_NS,
        c.end_ns > row["start_ns"] - gyro.SAME_TIME_NS,
        # The index has the start first, and no block spans more than SPAN_NS.
        c.start_ns > row["start_ns"] - gyro.SAME_TIME_NS - SPAN_NS,
    )
    for other in connection.execute(near.order_by(c.start_ns)).mappings():
        shared_ns = gyro.first_shared_ns(
            times_ns, gyro.tai_ns_of(other["start_ns"], times_of(other))
        )
        if shared_ns is not None:
            at = shifted(block.start, (shared_ns - row["start_ns"]) * 1e-9).text
            raise gyro.SampleTaken(
                f"{where} has a sample at {at}, which block {shown_value(other['block'])} holds "
                "already"
            )
    return None


def record_block(connection: Connection, block: gyro.GyroBlock, row: Row) -> Recorded:
    """Record a gyro block and add an event, unless the block is known; see `find_block`."""
    insert_runs(connection, {block.run: row["received"]})
    # Lock the run: of two processes that record blocks, neither sees the other's samples.
    lock = select(runs.c.name).where(runs.c.name == block.run)
    connection.execute(lock.with_for_update(key_share=True))
    found = find_block(connection, block, row)
    if found is not None:
        return Recorded(found, replayed=True)
    connection.execute(insert(gyro_blocks), row)
    new = shown(row)
    events.add_event(connection, "gyro", new, run=block.run, spacecraft=block.spacecraft)
    return Recorded(new, replayed=False)


def record_or_refuse(
    connection: Connection, block: gyro.GyroBlock, row: Row
) -> Recorded | AcquisitionError:
    """Record a gyro block; a refused one returns its error, and nothing is inserted."""
    try:
        return record_block(connection, block, row)
    except AcquisitionError as error:
        return error


def list_blocks(
    connection: Connection, selected: BlockFilter, *, limit: int, cursor: str | None
) -> Page[GyroBlockRow]:
    """List the gyro blocks that a filter selects, without their samples, the earliest first."""
    c = gyro_blocks.c
    # No two blocks of a spacecraft and a run have the same first sample.
    query = select(c.start_ns, *(c[name] for name in SHOWN)).where(*selected.conditions())
    if cursor is not None:
        query = query.where(c.start_ns > _read_cursor(cursor))
    rows = list(connection.execute(query.order_by(c.start_ns).limit(limit + 1)).mappings())
    is_last = len(rows) <= limit
    rows = rows[:limit]
    return Page([shown(row) for row in rows], None if is_last else str(rows[-1]["start_ns"]))


def read_block(connection: Connection, spacecraft: str, id: str) -> GyroSamples:
    """Read a gyro block of a spacecraft with its samples; raises `NotFound`."""
    chosen = gyro_blocks.c.id == id, gyro_blocks.c.spacecraft == spacecraft
    query = select(gyro_blocks).where(*chosen)
    row = connection.execute(query).mappings().first()
    if row is None:
        raise NotFound(f"there is no gyro block of {spacecraft} with the id {shown_value(id)}")
    return GyroSamples(
        **{name: row[name] for name in SHOWN},
        times_s=times_of(row).tolist(),
        rates_rad_per_s=rates_of(row).tolist(),
    )


def block_of(row: Any) -> gyro.GyroBlock:
    """Convert a database row to a gyro block; raises `ValueError` for unreadable samples."""
    return gyro.GyroBlock(
        row["spacecraft"],
        row["run"],
        row["block"],
        recorded_utc(row["start"]),
        row["step_s"],
        times_of(row),
        rates_of(row),
    )


def times_of(row: Any) -> Vector:
    """Times of a gyro block's samples, in seconds after the block's start."""
    if row["step_s"] is not None:
        return gyro.times_of_steps(row["step_s"], row["samples"])
    return gyro.unpack(row["times_s"], (row["samples"],))


def rates_of(row: Any) -> Vector:
    """Angular rates of a gyro block's samples in rad/s, shape (n, 3)."""
    return gyro.unpack(row["rates_rad_per_s"], (row["samples"], 3))


def shown(row: Any) -> GyroBlockRow:
    """Convert a database row to the record of a gyro block that answers show."""
    return GyroBlockRow(**{name: row[name] for name in SHOWN})


def _read_cursor(cursor: str) -> int:
    # From 2031-09 on a time in nanoseconds has 19 digits.
    if not re.fullmatch(r"-?\d{1,19}", cursor, re.ASCII) or abs(int(cursor)) >= 1 << 63:
        raise BadBatch(Fault("cursor", "is not a cursor of this list", shown_value(cursor)))
    return int(cursor)


BLOCKS = 20
"""Number of gyro blocks read from the database at a time."""

Reading = Callable[[], AbstractContextManager[Connection]]

COLUMNS = (
    Column("time", "utc", description="UTC. Time of the sample.", width=30),
    Column("tai_ns", "integer", "ns", description="TAI since 2000-01-01T12:00:00 TAI."),
    Column("block", "text", description="Name of the block.", width=128),
    *(
        Column(
            f"rate_{axis}_rad_per_s",
            unit="rad/s",
            description=f"Rate about the gyro's axis {axis}, as it was sent.",
        )
        for axis in (1, 2, 3)
    ),
)


def sample_table(reading: Reading, selected: BlockFilter, about: Mapping[str, str]) -> Table:
    """Table of a period's gyro samples, read from the database page by page.

    Samples of interleaved blocks are in order within each block only.
    """
    return Table(COLUMNS, _pages(reading, selected), {"product": "gyro", **about})


def count_samples(connection: Connection, selected: BlockFilter) -> int:
    """Count the samples of the gyro blocks that overlap a period: an upper bound for the period."""
    total = select(func.sum(gyro_blocks.c.samples)).where(*selected.conditions())
    return int(connection.scalar(total) or 0)


def _pages(reading: Reading, selected: BlockFilter) -> Iterator[TablePage]:
    c = gyro_blocks.c
    query = select(gyro_blocks).where(*selected.conditions()).order_by(c.start_ns).limit(BLOCKS)
    beyond = query
    while True:
        with reading() as connection:
            rows = connection.execute(beyond).mappings().all()
        for row in rows:
            page = _page(row, selected)
            if page[0]:
                yield page
        if len(rows) < BLOCKS:
            return
        beyond = query.where(c.start_ns > rows[-1]["start_ns"])


def _page(row: Any, selected: BlockFilter) -> TablePage:
    """Columns of a product's table for one gyro block's samples from `start` to before `end`."""
    block = block_of(row)
    times_ns = block.tai_ns
    first, last = 0, times_ns.size
    if selected.start is not None:
        first = int(np.searchsorted(times_ns, selected.start.tai_ns))
    if selected.end is not None:
        last = int(np.searchsorted(times_ns, selected.end.tai_ns))
    inside = slice(first, last)
    texts = gyro.texts_of(block.start, block.times_s[inside])
    names = [block.block] * len(texts)
    return [texts, times_ns[inside].tolist(), names, *block.rates_rad_per_s[inside].T.tolist()]


def gyro_in(connection: Connection, selected: BlockFilter) -> tuple[gyro.Nanoseconds, Vector]:
    """Gyro samples of a period, merged in order of time: times in ns of TAI, rates in rad/s."""
    times, rates = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    query = select(gyro_blocks).where(*selected.conditions()).order_by(gyro_blocks.c.start_ns)
    for row in connection.execute(query).mappings():
        times.append(gyro.tai_ns_of(row["start_ns"], times_of(row)))
        rates.append(rates_of(row))
    tai_ns, rate = np.concatenate(times), np.concatenate(rates)
    places = inside(tai_ns, selected.start, selected.end)
    tai_ns, rate = tai_ns[places], rate[places]
    order = np.argsort(tai_ns, kind="stable")
    return tai_ns[order], rate[order]


def inside(tai_ns: gyro.Nanoseconds, start: Utc | None, end: Utc | None) -> npt.NDArray[np.intp]:
    """Indices of the times, in ns of TAI, from `start` to before `end`."""
    chosen = np.ones(len(tai_ns), dtype=bool)
    if start is not None:
        chosen &= tai_ns >= start.tai_ns
    if end is not None:
        chosen &= tai_ns < end.tai_ns
    return np.flatnonzero(chosen)
