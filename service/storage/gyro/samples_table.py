"""Gyro samples as a table, in order of time: one row per sample."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from sqlalchemy import Connection, func, select

from service.gyro.block import Nanoseconds, texts_of
from service.products.tables import Column, Page, Table
from service.storage.gyro.blocks import BlockFilter, block_of
from service.storage.sql.grade_tables import gyro_blocks

BLOCKS = 20
"""Blocks that are read together."""

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
    """The samples of a period, read as the table is.

    Where blocks interleave, so do their samples only block by block.
    """
    return Table(COLUMNS, _pages(reading, selected), {"product": "gyro", **about})


def count_samples(connection: Connection, selected: BlockFilter) -> int:
    """The samples of the blocks that touch a period: at least those of the period."""
    total = select(func.sum(gyro_blocks.c.samples)).where(*selected.conditions())
    return int(connection.scalar(total) or 0)


def _pages(reading: Reading, selected: BlockFilter) -> Iterator[Page]:
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


def _page(row: Any, selected: BlockFilter) -> Page:
    """The samples of a block that lie in the period."""
    block = block_of(row)
    times_ns = block.tai_ns
    inside = _inside(times_ns, selected)
    texts = texts_of(block.start, block.times_s[inside])
    names = [block.block] * len(texts)
    return [texts, times_ns[inside].tolist(), names, *block.rates_rad_per_s[inside].T.tolist()]


def _inside(times_ns: Nanoseconds, selected: BlockFilter) -> slice:
    first, last = 0, times_ns.size
    if selected.start is not None:
        first = int(np.searchsorted(times_ns, selected.start.tai_ns))
    if selected.end is not None:
        last = int(np.searchsorted(times_ns, selected.end.tai_ns))
    return slice(first, last)
