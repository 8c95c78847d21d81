"""Current results as tables in order of time: one row per batch, star, or attitude."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from sqlalchemy import Select, select

from service.acquire.result import METHOD
from service.ephemerides.rows import AttitudeRows
from service.observations.decode import RECORDED_RATES
from service.storage.archived import Archive
from service.storage.queries.pages import (
    COVARIANCE,
    PLACE,
    QUATERNION,
    Listing,
    Reading,
    ResultFilter,
    all_rows,
)
from service.storage.sql.tables import COUNTED, MEASURED, batches, results, solutions, star_results
from service.table_files.table import Column, Page, Table
from service.trends.quantities import QUANTITIES
from service.vectors import Vector

PAGE = 5_000
"""Number of database rows read at once for a table."""

_QUALITY = ("residual_rms_arcsec", "predicted_rms_arcsec")
_QUERY: Select[Any] = (
    select(
        *PLACE,
        results.c.id,
        results.c.status,
        batches.c.batch,
        batches.c.time,
        batches.c.input,
        solutions.c.method,
        *(solutions.c[name] for name in (*QUATERNION, *COVARIANCE, *_QUALITY)),
        *(results.c[name] for name in COUNTED),
    )
    .join_from(results, batches, results.c.batch_id == batches.c.id)
    .outerjoin(solutions, solutions.c.result_id == results.c.id)
)


_UNKNOWN = (np.nan, np.nan, np.nan)


def attitude_pages(
    reading: Reading,
    archive: Archive,
    selected: ResultFilter,
    *,
    newest_first: bool = False,
    page: int = PAGE,
) -> Iterator[AttitudeRows]:
    """Selected current results with their attitudes, page by page.

    Archived results are merged with those in the database.

    No connection is held between two pages, so that a slow reader does not block others.
    """
    query = _QUERY.where(*selected.conditions())
    listing = Listing(archive, query, selected, newest_first, needs=("input", "solution"))
    return map(_columns, listing.row_pages(reading, page))


def _columns(rows: Sequence[Any]) -> AttitudeRows:
    time_ns, _, id, status, batch, time, sent, method, *numbers = zip(*rows, strict=True)
    values = np.array(numbers, dtype=np.float64)
    # Missing values are zero in the database.
    values[10:12, np.array(method, dtype=object) == METHOD] = np.nan
    rates = [RECORDED_RATES.decode(each).body_rates_deg_per_s for each in sent]
    return AttitudeRows(
        time_ns=np.array(time_ns, dtype=np.int64),
        time=_texts(time),
        id=_texts(id),
        batch=_texts(batch),
        status=_texts(status),
        method=_texts(method),
        quaternion=_across(values[:4]),
        covariance_arcsec2=_across(values[4:10]),
        # A batch that came without rates is recorded like one with rates of zero.
        rate_deg_per_s=np.array([each if each and any(each) else _UNKNOWN for each in rates]),
        residual_rms_arcsec=values[10],
        predicted_rms_arcsec=values[11],
        stars=_across(values[12:]).astype(np.int64),
        model=np.full(len(rows), None, dtype=object),
        revision=np.zeros(len(rows), dtype=np.int64),
        bias_deg_per_h=np.full((len(rows), 3), np.nan),
        bias_sigma_deg_per_h=np.full((len(rows), 3), np.nan),
    )


def _across(values: Vector) -> Vector:
    return np.ascontiguousarray(values.T)


def _texts(values: Sequence[Any]) -> Any:
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column


BATCHES, BATCHES_OF_STARS = 5_000, 500
"""Numbers of results read at once, for tables of batches and of stars."""

_NAMES = (
    Column("time", "utc", description="UTC. Time of the batch.", width=30),
    Column("tai_ns", "integer", "ns", description="TAI since 2000-01-01T12:00:00 TAI."),
    Column("batch", "text", description="Name of the batch.", width=128),
    Column("id", "text", description="Id of the result.", width=26),
)
_PLACES = {"time": batches.c.time, "tai_ns": results.c.time_ns, "batch": batches.c.batch}
BATCH_COLUMNS = (
    *_NAMES,
    Column("identifier", "text", description="Identifier of the stars.", width=32),
    Column("status", "text", description="good or suspect; empty without attitude.", width=16),
    Column("reason", "text", description="Why there is no attitude.", width=64),
    *(Column(name, "integer", description=f"Stars {name}.") for name in COUNTED),
    *(
        Column(name, unit=QUANTITIES[name].unit, description=QUANTITIES[name].label)
        for name in MEASURED
    ),
)
STAR_COLUMNS = (
    *_NAMES,
    Column("tracker", "text", description="Name of the tracker.", width=128),
    Column("position", "integer", description="Place of the star in the tracker's list, from 0."),
    Column("outcome", "text", description="unique, ambiguous or unmatched.", width=16),
    Column("star_id", "text", description="Id of the catalog star.", width=64),
    Column("votes", "integer", description="Pairs that support the catalog star."),
    Column("runner_up", "integer", description="The same for the second candidate."),
    Column("probability", description="Of the identification, where the identifier gives one."),
    Column(
        "residual_arcsec",
        unit="arcsec",
        description="Angle between the observed star and the catalog star at the attitude.",
    ),
)


def batch_table(
    reading: Reading, archive: Archive, selected: ResultFilter, about: Mapping[str, str]
) -> Table:
    """Table of selected batches with their quantities; rows are read during iteration."""
    read = [
        _PLACES[each.name] if each.name in _PLACES else results.c[each.name]
        for each in BATCH_COLUMNS
    ]
    query = select(*PLACE, *read).join_from(results, batches, results.c.batch_id == batches.c.id)
    listing = Listing(archive, query.where(*selected.conditions()), selected)
    pages = (
        _table_columns([row[len(PLACE) :] for row in rows])
        for rows in listing.row_pages(reading, BATCHES)
    )
    return Table(BATCH_COLUMNS, pages, {"product": "batches", **about})


def star_table(
    reading: Reading, archive: Archive, selected: ResultFilter, about: Mapping[str, str]
) -> Table:
    """Table of stars in selected batches with their outcomes; rows are read during iteration."""
    return Table(STAR_COLUMNS, _stars(reading, archive, selected), {"product": "stars", **about})


def _stars(reading: Reading, archive: Archive, selected: ResultFilter) -> Iterator[Page]:
    ids = select(*PLACE, results.c.id).where(*selected.conditions())
    places = {**_PLACES, "id": results.c.id}
    read = [
        places[each.name] if each.name in places else star_results.c[each.name]
        for each in STAR_COLUMNS
    ]
    query = (
        select(*PLACE, *read)
        .join_from(star_results, results, star_results.c.result_id == results.c.id)
        .join(batches, results.c.batch_id == batches.c.id)
        .order_by(*PLACE, star_results.c.tracker, star_results.c.position)
    )
    listing = Listing(archive, ids, selected, needs=("stars",))
    for rows in listing.row_pages(reading, BATCHES_OF_STARS):
        chosen = query.where(star_results.c.result_id.in_([row[-1] for row in rows]))
        with reading() as connection:
            places_of = [row[: len(PLACE)] for row in rows]
            stars = all_rows(connection, archive, ("stars",), chosen, places_of)
        if stars:
            yield _table_columns([row[len(PLACE) :] for row in stars])


def _table_columns(rows: Sequence[Any]) -> Page:
    return [list(column) for column in zip(*rows, strict=True)]
