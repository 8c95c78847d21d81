"""Checks the recorded gyro blocks for consistency, a few at a time; changes nothing."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from sqlalchemy import Engine, select, tuple_

from service.gyro.block import Nanoseconds
from service.gyro.overlap import SAME_TIME_NS, first_shared_ns
from service.storage.gyro.blocks import block_of
from service.storage.sql.grade_tables import gyro_blocks

AT_ONCE = 50
ORDER = (gyro_blocks.c.spacecraft, gyro_blocks.c.run, gyro_blocks.c.start_ns, gyro_blocks.c.id)


def of_the_gyro_blocks(engine: Engine) -> Iterator[str]:
    """The faults of the gyro blocks, a sentence each.

    A block must be the one that was sent, and no two of a spacecraft and a run may share a time.
    """
    before: list[tuple[Any, Nanoseconds]] = []
    for row in _rows(engine):
        name = f"gyro block {row['id']}"
        try:
            block = block_of(row)
            times_ns = block.tai_ns
            rising = bool(np.all(np.diff(times_ns) >= SAME_TIME_NS))
        except ValueError as error:
            yield f"{name}: its samples cannot be read: {error}"
            continue
        if block.fingerprint != row["fingerprint"]:
            yield f"{name}: its samples are not those that were fingerprinted"
        told = row["start_ns"], row["end_ns"], row["end"]
        if not rising or told != (int(times_ns[0]), int(times_ns[-1]), block.end.text):
            yield f"{name}: its times are not those of its samples"
        near = row["start_ns"] - SAME_TIME_NS
        place = row["spacecraft"], row["run"]
        before = [
            (other, others_ns)
            for other, others_ns in before
            if other["end_ns"] > near and (other["spacecraft"], other["run"]) == place
        ]
        for other, others_ns in before:
            if first_shared_ns(times_ns, others_ns) is not None:
                yield f"{name}: it shares a time with gyro block {other['id']}"
        before.append((row, times_ns))


def _rows(engine: Engine) -> Iterator[Any]:
    query = select(gyro_blocks).order_by(*ORDER).limit(AT_ONCE)
    beyond = query
    while True:
        with engine.begin() as connection:
            rows = connection.execute(beyond).mappings().all()
        yield from rows
        if len(rows) < AT_ONCE:
            return
        last = [rows[-1][column.name] for column in ORDER]
        beyond = query.where(tuple_(*ORDER) > tuple_(*last))
