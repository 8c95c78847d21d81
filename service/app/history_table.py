"""Histories as tables: the names of the columns with units, and one row per bucket or batch."""

from collections.abc import Iterator
from itertools import chain
from typing import Any

from service.alarms.quantities import QUANTITIES, QuantityName
from service.products.tables import Column, Page, Table
from service.storage.models.spacecraft import History
from service.times import utc_of_unix

BATCH_COLUMNS = (
    Column("time", "utc", description="UTC. Time of the batch.", width=30),
    Column("batch", "text", description="Name of the batch.", width=128),
    Column("id", "text", description="Id of the result.", width=26),
)
BUCKET_COLUMNS = (
    Column("start", "utc", description="UTC. Start of the bucket.", width=30),
    Column("bucket_s", "integer", "s", description="Width of the bucket."),
    Column("batches", "integer", description="Batches in the bucket."),
)
BUCKET_PARTS = {
    "count": "batches with a value",
    "mean": "mean",
    "min": "least of a batch",
    "max": "greatest of a batch",
}


def history_table(history: History) -> Table:
    """The table of a history; see `trends.history`."""
    if history.strategy == "latest":
        return batch_table(iter([history]))
    columns = [
        _column(name, part, told) for name in history.series for part, told in BUCKET_PARTS.items()
    ]
    starts = [utc_of_unix(each).text for each in history.unix_s]
    page: list[Any] = [starts, [history.bucket_s] * len(starts), history.batches]
    page += [getattr(each, part) for each in history.series.values() for part in BUCKET_PARTS]
    return Table([*BUCKET_COLUMNS, *columns], [page], _about(history))


def batch_table(pages: Iterator[History]) -> Table:
    """The table of pages of batches; see `trends.every_batch`.

    The first page is read at once: its errors are raised here.
    """
    first = next(pages)
    columns = [*BATCH_COLUMNS, *(_column(name) for name in first.series)]
    return Table(columns, (_batch_page(page) for page in chain([first], pages)), _about(first))


def _batch_page(page: History) -> Page:
    values: list[Any] = [each.value for each in page.series.values()]
    return [*(getattr(page, each.name) for each in BATCH_COLUMNS), *values]


def _column(name: QuantityName, part: str = "", told: str = "") -> Column:
    quantity = QUANTITIES[name]
    about = f"{quantity.label}: {told}" if told else quantity.label
    if part == "count":
        return Column(f"{name}_count", "integer", description=about)
    return Column(f"{name}_{part}" if part else name, unit=quantity.unit, description=about)


def _about(history: History) -> dict[str, str]:
    return {
        "product": "history",
        "spacecraft": history.spacecraft,
        "run": history.run,
        "start": history.start or "",
        "end": history.end or "",
    }
