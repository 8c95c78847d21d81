"""Current results as tables, in order of time: one row per batch, or one per star."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy import select

from service.alarms.quantities import QUANTITIES
from service.products.tables import Column, Page, Table
from service.storage.archive.reading import Archive
from service.storage.queries.pages import PLACE, ResultFilter
from service.storage.queries.with_archive.rows import ArchiveUse, Reading, all_rows, row_pages
from service.storage.sql.tables import COUNTED, MEASURED, batches, results, star_results

BATCHES, BATCHES_OF_STARS = 5_000, 500
"""Results that are read together."""

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
    """The batches that are selected with their quantities; read as the table is."""
    read = [
        _PLACES[each.name] if each.name in _PLACES else results.c[each.name]
        for each in BATCH_COLUMNS
    ]
    query = select(*PLACE, *read).join_from(results, batches, results.c.batch_id == batches.c.id)
    chosen = selected.conditions()
    pages = (
        _columns([row[len(PLACE) :] for row in rows])
        for rows in row_pages(reading, ArchiveUse(archive), query.where(*chosen), selected, BATCHES)
    )
    return Table(BATCH_COLUMNS, pages, {"product": "batches", **about})


def star_table(
    reading: Reading, archive: Archive, selected: ResultFilter, about: Mapping[str, str]
) -> Table:
    """The stars of the batches that are selected with their outcomes; read as the table is."""
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
    use = ArchiveUse(archive, ("stars",))
    for rows in row_pages(reading, use, ids, selected, BATCHES_OF_STARS):
        chosen = query.where(star_results.c.result_id.in_([row[-1] for row in rows]))
        with reading() as connection:
            stars = all_rows(connection, use, chosen, [row[: len(PLACE)] for row in rows])
        if stars:
            yield _columns([row[len(PLACE) :] for row in stars])


def _columns(rows: Sequence[Any]) -> Page:
    return [list(column) for column in zip(*rows, strict=True)]
