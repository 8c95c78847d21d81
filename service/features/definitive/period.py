"""Filtered and smoothed attitudes of a period: thinned for charts, in pages, and for limits."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from sqlalchemy import Connection, select, tuple_

from service.attitude.definitive import (
    GRADES,
    DefinitiveSamples,
    Grade,
    Integers,
    MeasuredInnovations,
    Outcome,
    Status,
    day_bounds,
    unpacked,
    unpacked_innovations,
)
from service.contract.base import Page
from service.errors import BadBatch, Fault, shown_value
from service.feature import feature_modules
from service.features.definitive.records import DayKey, DefinitiveDayRow, Innovation, shown
from service.gyro.blocks import texts_of
from service.missions.mission import Mission
from service.storage.gyro import inside
from service.storage.queries.definitive import (
    BLOCKS,
    MOST_BLOCKS,
    PLACE,
    Block,
    block_conditions,
    blocks_of,
    packed_samples,
    rejected_samples,
)
from service.storage.queries.pages import ResultFilter
from service.storage.queries.time_buckets import buckets_between
from service.storage.recording.results import runs_with_alarms
from service.storage.sql.definitive_tables import INNOVATIONS, graded_days
from service.times import DAY_S, Utc
from service.trends.limits import SampledDay
from service.trends.quantities import REJECTED

PARTS = 600
"""Number of equal parts of a period, with one sample each: the resolution of a chart."""
_SEVERITY = {Status.NONE: 3, Status.LOST: 3, Status.DOUBTFUL: 2, Status.STARTING: 1}


@dataclass(frozen=True, eq=False)
class DefinitivePeriod:
    """Filtered and smoothed attitudes of a period, thinned to the resolution of a chart.

    `samples` have one sample in each of `PARTS` equal parts of the period, the one with the worst
    status; both grades have the same times.  `is_gyro` (n,) is true for samples filtered with a
    gyro.  `innovations` have in each part one accepted measurement, and the unused one with the
    largest chi-square.  `is_whole` is true if every block was read.  `stretches` are the model,
    first and last moment (TAI nanoseconds) of every block of up to an hour; `days` the latest of
    `total_days`.
    """

    samples: dict[Grade, DefinitiveSamples]
    is_gyro: npt.NDArray[np.bool_]
    innovations: MeasuredInnovations | None
    is_whole: bool
    stretches: list[tuple[str, int, int]]
    days: list[DefinitiveDayRow]
    total_days: int


def definitive_period(
    connection: Connection, spacecraft: str, run: str, start: Utc, end: Utc
) -> DefinitivePeriod | None:
    """Read the filtered and smoothed attitudes of a period; None if none are recorded."""
    selected = ResultFilter(run, spacecraft, start, end)
    blocks = blocks_of(connection, selected, "smoothed")
    if not blocks:
        return None
    measured = blocks_of(connection, selected, INNOVATIONS)
    c = graded_days.c
    chosen = c.current, c.spacecraft == spacecraft, c.run == run
    within = buckets_between(c.day, start, end, DAY_S)
    query = select(graded_days).where(*chosen, *within).order_by(c.day)
    days = connection.execute(query).mappings().all()
    read = _spread(blocks)
    whole = {grade: _samples(connection, grade, read) for grade in GRADES}
    places = _of_each_part(
        whole["smoothed"].tai_ns,
        np.maximum(*(_severity(whole[grade].status) for grade in GRADES)),
        start,
        end,
    )
    is_gyro = _repeated_models(read, whole["smoothed"].tai_ns)
    return DefinitivePeriod(
        samples={grade: each.taken(places) for grade, each in whole.items()},
        is_gyro=is_gyro[places],
        innovations=_innovations(connection, _spread(measured), selected, start, end),
        is_whole=len(blocks) <= MOST_BLOCKS and len(measured) <= MOST_BLOCKS,
        stretches=[(each.model, each.start_ns, each.end_ns) for each in blocks],
        days=[shown(row) for row in days[-40:]],
        total_days=len(days),
    )


def _spread(blocks: Sequence[Block]) -> list[Block]:
    if len(blocks) <= MOST_BLOCKS:
        return list(blocks)
    chosen = np.unique(np.rint(np.linspace(0, len(blocks) - 1, MOST_BLOCKS)).astype(int))
    return [blocks[place] for place in chosen.tolist()]


def _samples(connection: Connection, grade: Grade, read: Sequence[Block]) -> DefinitiveSamples:
    found = [unpacked(row.packed, row.samples) for row in packed_samples(connection, grade, read)]
    return DefinitiveSamples.joined(found)


def _severity(status: Integers) -> Integers:
    severity = np.zeros(len(status), dtype=np.int64)
    for code, value in _SEVERITY.items():
        severity[status == code] = value
    return severity


def _of_each_part(time_ns: Integers, rank: npt.ArrayLike, start: Utc, end: Utc) -> Integers:
    """Index of the row with the highest rank in each part of a period, the first of equals."""
    within = np.flatnonzero((time_ns >= start.tai_ns) & (time_ns < end.tai_ns))
    length_ns = max(end.tai_ns - start.tai_ns, 1)
    part = ((time_ns[within] - start.tai_ns) / length_ns * PARTS).astype(np.int64)
    order = np.lexsort((time_ns[within], -np.asarray(rank)[within], part))
    _, first = np.unique(part[order], return_index=True)
    return np.asarray(within[order[first]])


def _repeated_models(read: Sequence[Block], time_ns: Integers) -> npt.NDArray[np.bool_]:
    is_gyro = np.array([each.model == "gyro" for each in read])
    begins = np.array([each.start_ns for each in read])
    return np.asarray(is_gyro[np.searchsorted(begins, time_ns, side="right") - 1])


def _innovations(
    connection: Connection, read: Sequence[Block], selected: ResultFilter, start: Utc, end: Utc
) -> MeasuredInnovations | None:
    """Thinned innovations of a period; None if none were recorded, as in older revisions."""
    if not read:
        return None
    parts = []
    for row in packed_samples(connection, INNOVATIONS, read):
        found = unpacked_innovations(row.packed, row.samples)
        parts.append(found.taken(inside(found.tai_ns, selected.start, selected.end)))
    whole = MeasuredInnovations.joined(parts)
    is_used = whole.is_used
    nis = np.where(np.isfinite(whole.nis), whole.nis, np.inf)
    places = []
    for chosen, rank in (
        (np.flatnonzero(is_used), np.zeros(len(whole))),
        (np.flatnonzero(~is_used), nis),
    ):
        kept = _of_each_part(whole.tai_ns[chosen], rank[chosen], start, end)
        places.append(chosen[kept])
    return whole.taken(np.sort(np.concatenate(places)))


def list_innovations(
    connection: Connection, selected: ResultFilter, *, limit: int, cursor: str | None
) -> Page[Innovation]:
    """One page of innovations of measured attitudes in a period, earliest first."""
    query = BLOCKS.where(*block_conditions(selected, INNOVATIONS)).order_by(*PLACE).limit(1)
    day, position, row = (-1, -1, 0) if cursor is None else _read_cursor(cursor)
    beyond = query if cursor is None else query.where(tuple_(*PLACE) >= tuple_(day, position))
    items: list[Innovation] = []
    while (block := connection.execute(beyond).mappings().first()) is not None:
        found = unpacked_innovations(block["packed"], block["samples"])
        places = inside(found.tai_ns, selected.start, selected.end)
        if (block["day"], block["position"]) == (day, position):
            places = places[places >= row]
        for place, item in zip(places.tolist(), _shown(block, found, places), strict=False):
            if len(items) == limit:
                return Page(items, f"{block['day']}.{block['position']}.{place}")
            items.append(item)
        beyond = query.where(tuple_(*PLACE) > tuple_(block["day"], block["position"]))
    return Page(items, None)


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


def evaluate_day(
    connection: Connection, mission: Mission, key: DayKey, row: DefinitiveDayRow, features_off: str
) -> None:
    """Evaluate limits on the share of rejected measurements for a newly recorded day.

    Earlier days than the latest raise no alarms, and neither do runs without alarms.
    """
    modules = feature_modules("shares", features_off)
    if not modules or not runs_with_alarms(connection, {key.run}):
        return
    if not _is_latest(connection, key):
        return
    start, end = day_bounds(key.day)
    samples = rejected_samples(connection, ResultFilter(key.run, key.spacecraft, start, end))
    day = SampledDay(REJECTED, key.run, start, samples, row.revision, row.created)
    for module in modules:
        module.evaluate_day(connection, mission, day)


def _is_latest(connection: Connection, key: DayKey) -> bool:
    c = graded_days.c
    later = select(c.id).where(
        c.spacecraft == key.spacecraft, c.run == key.run, c.current, c.day > key.day
    )
    return connection.execute(later.limit(1)).first() is None
