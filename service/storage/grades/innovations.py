"""The innovations of a period in order of time, page by page."""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from sqlalchemy import Connection, select, tuple_

from service.errors import BadBatch, Fault, shown_value
from service.filtering.state import Outcome
from service.grades.day import day_bounds
from service.grades.innovations import MeasuredInnovations
from service.grades.packing import unpacked_innovations
from service.gyro.block import texts_of
from service.storage.grades.models import Innovation
from service.storage.grades.rows import block_conditions
from service.storage.models.base import Page
from service.storage.queries.pages import ResultFilter
from service.storage.sql.grade_tables import INNOVATIONS, graded_blocks, graded_days

_PLACE = (graded_days.c.day, graded_blocks.c.position)
_BLOCKS = select(
    *_PLACE,
    graded_days.c.revision,
    graded_blocks.c.model,
    graded_blocks.c.samples,
    graded_blocks.c.packed,
).join_from(graded_days, graded_blocks, graded_blocks.c.day_id == graded_days.c.id)


def list_innovations(
    connection: Connection, selected: ResultFilter, *, limit: int, cursor: str | None
) -> Page[Innovation]:
    """How the measured attitudes of a period met the filter, the earliest first."""
    query = _BLOCKS.where(*block_conditions(selected, INNOVATIONS)).order_by(*_PLACE).limit(1)
    day, position, row = (-1, -1, 0) if cursor is None else _read_cursor(cursor)
    beyond = query if cursor is None else query.where(tuple_(*_PLACE) >= tuple_(day, position))
    items: list[Innovation] = []
    while (block := connection.execute(beyond).mappings().first()) is not None:
        found = unpacked_innovations(block["packed"], block["samples"])
        places = inside(found, selected)
        if (block["day"], block["position"]) == (day, position):
            places = places[places >= row]
        for place, item in zip(places.tolist(), _shown(block, found, places), strict=False):
            if len(items) == limit:
                return Page(items, f"{block['day']}.{block['position']}.{place}")
            items.append(item)
        beyond = query.where(tuple_(*_PLACE) > tuple_(block["day"], block["position"]))
    return Page(items, None)


def inside(found: MeasuredInnovations, selected: ResultFilter) -> Any:
    """The places of the measurements in the period."""
    chosen = np.ones(len(found), dtype=bool)
    if selected.start is not None:
        chosen &= found.tai_ns >= selected.start.tai_ns
    if selected.end is not None:
        chosen &= found.tai_ns < selected.end.tai_ns
    return np.flatnonzero(chosen)


def _shown(block: Any, found: MeasuredInnovations, places: Any) -> Iterator[Innovation]:
    start, _ = day_bounds(block["day"])
    chosen = found.taken(places)
    times = texts_of(start, np.asarray((chosen.tai_ns - start.tai_ns) * 1e-9))
    met = np.isfinite(chosen.nis)
    sigma = chosen.innovation_sigma_arcsec
    for k, time in enumerate(times):
        yield Innovation(
            time=time,
            outcome=Outcome(int(chosen.outcome[k])).name.lower(),
            innovation_arcsec=chosen.innovation_arcsec[k].tolist() if met[k] else None,
            innovation_sigma_arcsec=sigma[k].tolist() if met[k] else None,
            chi_square=float(chosen.nis[k]) if met[k] else None,
            difference_arcsec=chosen.difference_arcsec[k].tolist(),
            difference_sigma_arcsec=chosen.difference_sigma_arcsec[k].tolist(),
            model=block["model"],
            revision=block["revision"],
        )


def _read_cursor(cursor: str) -> tuple[int, int, int]:
    if not re.fullmatch(r"-?\d{1,8}\.\d{1,4}\.\d{1,5}", cursor, re.ASCII):
        raise BadBatch(Fault("cursor", "is not a cursor of this list", shown_value(cursor)))
    day, position, row = cursor.split(".")
    return int(day), int(position), int(row)
