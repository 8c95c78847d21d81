"""Histories as tables: the names of the columns with their units, and a row a bucket or batch."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

from service.app.output_formats import TableRow
from service.storage.models.trends import History
from service.times import utc_of_unix

BATCH_COLUMNS = ("time", "batch", "id")
BUCKET_PARTS = ("count", "mean", "min", "max")


@dataclass(frozen=True)
class Table:
    """The names of columns and the rows, page by page."""

    columns: Sequence[str]
    pages: Iterable[Iterable[TableRow]]


def history_table(history: History) -> Table:
    """The table of a history; see `trends.history`."""
    if history.strategy == "latest":
        return batch_table(iter([history]))
    series = history.series
    columns = [f"{name}_{part}" for name in series for part in BUCKET_PARTS]
    starts = [utc_of_unix(each).text for each in history.unix_s]
    widths = [history.bucket_s] * len(starts)
    values: list[Any] = [history.batches]
    values += [getattr(each, part) for each in series.values() for part in BUCKET_PARTS]
    rows = zip(starts, widths, *values, strict=True)
    return Table(["start", "bucket_s", "batches", *columns], [rows])


def batch_table(pages: Iterator[History]) -> Table:
    """The table of pages of batches; see `trends.every_batch`.

    The first page is read at once: its errors are raised here.
    """
    first = next(pages)
    columns = [*BATCH_COLUMNS, *first.series]
    return Table(columns, (_batch_rows(page) for page in chain([first], pages)))


def _batch_rows(page: History) -> Iterable[TableRow]:
    values: list[Any] = [each.value for each in page.series.values()]
    return zip(*(getattr(page, name) for name in BATCH_COLUMNS), *values, strict=True)
