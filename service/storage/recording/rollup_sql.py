"""The columns of a rollup as SQL over current results, for sums that the database computes.

`result_metrics.rolled_up` makes the same of results in memory.  The index of
current results has every column that is read here.
"""

from collections.abc import Mapping
from typing import Any

from sqlalchemy import BigInteger, ColumnElement, Double, case, func

from service.alarms.quantities import QUANTITIES, Quantity, Ratio, StarShare
from service.storage.sql.rollup_tables import SHARES, VALUES
from service.storage.sql.tables import results

_STARS = {name: results.c[name] for name in ("unique", "ambiguous", "unmatched")}
_COUNTS: Mapping[str, ColumnElement[Any]] = {
    "observed": _STARS["unique"] + _STARS["ambiguous"] + _STARS["unmatched"],
    **_STARS,
}


def value_sql(quantity: Quantity) -> ColumnElement[Any]:
    """The value of one result; null where it has none."""
    match quantity.source:
        case StarShare(part):
            return _over(part(_COUNTS), _COUNTS["observed"])
        case Ratio(numerator, denominator):
            return _over(results.c[numerator], results.c[denominator])
        case _:
            return results.c[quantity.name]


def _sum(of: ColumnElement[Any]) -> ColumnElement[Any]:
    # PostgreSQL's sum over integers is a decimal number.
    return func.coalesce(func.sum(of), 0).cast(BigInteger)


def _over(part: ColumnElement[Any], whole: ColumnElement[Any]) -> ColumnElement[Any]:
    return part.cast(Double) / func.nullif(whole, 0).cast(Double)


def _summed() -> Mapping[str, ColumnElement[Any]]:
    columns: dict[str, ColumnElement[Any]] = {
        "batches": func.count(),
        **{name: _sum(count) for name, count in _COUNTS.items()},
        "solved": func.count(results.c.status),
        "suspect": _sum(case((results.c.status == "suspect", 1), else_=0)),
    }
    for name in VALUES:
        value = value_sql(QUANTITIES[name])
        columns[f"{name}_n"] = func.count(value)
        columns[f"{name}_sum"] = func.coalesce(func.sum(value), 0.0)
    for name in (*SHARES, *VALUES):
        value = value_sql(QUANTITIES[name])
        columns[f"{name}_min"], columns[f"{name}_max"] = func.min(value), func.max(value)
    return columns


SUMMED = {name: column.label(name) for name, column in _summed().items()}
"""Each column as SQL over `results`, for a query that groups them or sums up all."""
