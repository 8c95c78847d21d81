"""The metrics of results: measured from an acquisition, and rolled up in memory or by SQL."""

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

from sqlalchemy import BigInteger, ColumnElement, Double, Table, case, func

from service.acquire import Acquisition
from service.alarms.quantities import QUANTITIES, Measured, Quantity, Ratio, StarShare
from service.storage.sql import tables
from service.storage.sql.columns import Row


def metrics_of(acquisition: Acquisition) -> Row:
    """The measured quantities of an acquisition by name, None where it has none."""
    return {
        name: each.source.measure(acquisition)
        for name, each in QUANTITIES.items()
        if isinstance(each.source, Measured)
    }


_SHARES_OF = [QUANTITIES[name].value_of for name in tables.SHARES]
_VALUES_OF = [QUANTITIES[name].value_of for name in tables.VALUES]


def rolled_up(current: Sequence[Row]) -> Row:
    """The columns of a rollup of current results."""
    observed = [row["observed"] for row in current]
    status = [row["status"] for row in current]
    counts = (
        len(current),
        sum(observed),
        sum([row["unique"] for row in current]),
        sum([row["ambiguous"] for row in current]),
        sum([row["unmatched"] for row in current]),
        len(status) - status.count(None),
        status.count("suspect"),
    )
    shares = [[value for value in map(of, current) if value is not None] for of in _SHARES_OF]
    values = [[value for value in map(of, current) if value is not None] for of in _VALUES_OF]
    sums = chain.from_iterable((len(present), sum(present, 0.0)) for present in values)
    extremes = shares + values
    least = [min(present, default=None) for present in extremes]
    most = [max(present, default=None) for present in extremes]
    # In the order of the columns: to put their names together takes longer than all of this.
    return dict(zip(tables.ROLLED_UP, (*counts, *sums, *least, *most), strict=True))


def merge(into: Row, row: Row) -> None:
    """Add one rollup to another: sums add up, of the extremes the outer ones stay."""
    for name in (*tables.COUNTS, *tables.SUMS):
        into[name] += row[name]
    for name in tables.MINIMA:
        if into[name] is None or (row[name] is not None and row[name] < into[name]):
            into[name] = row[name]
    for name in tables.MAXIMA:
        if into[name] is None or (row[name] is not None and row[name] > into[name]):
            into[name] = row[name]


# The columns of a rollup as SQL over current results, for sums that the database computes.
#
# `result_metrics.rolled_up` makes the same of results in memory.  The index of
# current results has every column that is read here.


def _counts(of: Table) -> Mapping[str, ColumnElement[Any]]:
    stars = {name: of.c[name] for name in tables.COUNTED if name != "observed"}
    # The sum of the others, which the index has.
    return {"observed": stars["unique"] + stars["ambiguous"] + stars["unmatched"], **stars}


def value_sql(quantity: Quantity, of: Table = tables.results) -> ColumnElement[Any]:
    """The value of one result, or of one tracker in it; null where it has none."""
    match quantity.source:
        case StarShare(part):
            counts = _counts(of)
            return _over(part(counts), counts["observed"])
        case Ratio(numerator, denominator):
            return _over(of.c[numerator], of.c[denominator])
        case _:
            return of.c[quantity.name]


def _sum(of: ColumnElement[Any]) -> ColumnElement[Any]:
    # PostgreSQL's sum over integers is a decimal number.
    return func.coalesce(func.sum(of), 0).cast(BigInteger)


def _over(part: ColumnElement[Any], whole: ColumnElement[Any]) -> ColumnElement[Any]:
    return part.cast(Double) / func.nullif(whole, 0).cast(Double)


def _summed(of: Table) -> Mapping[str, ColumnElement[Any]]:
    columns: dict[str, ColumnElement[Any]] = {
        "batches": func.count(),
        **{name: _sum(count) for name, count in _counts(of).items()},
        "solved": func.count(of.c.status),
        "suspect": _sum(case((of.c.status == "suspect", 1), else_=0)),
    }
    for name in tables.VALUES:
        value = value_sql(QUANTITIES[name], of)
        columns[f"{name}_n"] = func.count(value)
        columns[f"{name}_sum"] = func.coalesce(func.sum(value), 0.0)
    for name in (*tables.SHARES, *tables.VALUES):
        value = value_sql(QUANTITIES[name], of)
        columns[f"{name}_min"], columns[f"{name}_max"] = func.min(value), func.max(value)
    return {name: column.label(name) for name, column in columns.items()}


SUMMED = _summed(tables.results)
"""Each column as SQL over `results`, for a query that groups them or sums up all."""
SUMMED_OF_TRACKERS = _summed(tables.tracker_values)
"""The same over `tracker_values`."""
OF_TRACKERS = tables.results.join(
    tables.tracker_values, tables.tracker_values.c.batch_id == tables.results.c.batch_id
)
"""The source of a query over `tracker_values`, so that it can choose current results."""
