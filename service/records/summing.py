"""The columns of a rollup, summed up by the database over current results.

What `measures.rolled_up` makes of results that are at hand; of many it is made where
they are, and one row is read instead of thousands.
The index of current results has every column that is asked for.
"""

from collections.abc import Mapping
from typing import Any

from sqlalchemy import BigInteger, ColumnElement, Double, case, func

from service.records.tables import SHARES, VALUES, results

_OF = results.c
_OBSERVED = _OF.unique + _OF.ambiguous + _OF.unmatched


def _sum(of: ColumnElement[Any]) -> ColumnElement[Any]:
    # PostgreSQL's sum over integers is a decimal number.
    return func.coalesce(func.sum(of), 0).cast(BigInteger)


def _over(part: ColumnElement[Any], whole: ColumnElement[Any]) -> ColumnElement[Any]:
    return part.cast(Double) / func.nullif(whole, 0).cast(Double)


def _summed() -> Mapping[str, ColumnElement[Any]]:
    values: dict[str, ColumnElement[Any]] = {
        name: _OF[name] if name in _OF else _over(_OF.residual_rms_arcsec, _OF.predicted_rms_arcsec)
        for name in VALUES
    }
    shares = {name: _over(_OF[name.removesuffix("_share")], _OBSERVED) for name in SHARES}
    columns: dict[str, ColumnElement[Any]] = {
        "batches": func.count(),
        "observed": _sum(_OBSERVED),
        "unique": _sum(_OF.unique),
        "ambiguous": _sum(_OF.ambiguous),
        "unmatched": _sum(_OF.unmatched),
        "solved": func.count(_OF.status),
        "suspect": _sum(case((_OF.status == "suspect", 1), else_=0)),
    }
    for name, value in values.items():
        columns[f"{name}_n"] = func.count(value)
        columns[f"{name}_sum"] = func.coalesce(func.sum(value), 0.0)
    for name, value in (shares | values).items():
        columns[f"{name}_min"], columns[f"{name}_max"] = func.min(value), func.max(value)
    return columns


SUMMED = {name: column.label(name) for name, column in _summed().items()}
"""Each column as SQL over `results`, for a query that groups them or sums up all."""
