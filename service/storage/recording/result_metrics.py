"""The metrics of results: quantities measured from an acquisition, and rollups of them."""

from collections.abc import Sequence
from itertools import chain

from service.acquire import Acquisition
from service.alarms.quantities import QUANTITIES, Measured
from service.storage.sql.columns import Row
from service.storage.sql.tables import (
    COUNTS,
    MAXIMA,
    MINIMA,
    ROLLED_UP,
    SHARES,
    SUMS,
    VALUES,
)


def metrics_of(acquisition: Acquisition) -> Row:
    """The measured quantities of an acquisition by name, None where it has none."""
    return {
        name: each.source.measure(acquisition)
        for name, each in QUANTITIES.items()
        if isinstance(each.source, Measured)
    }


_SHARES_OF = [QUANTITIES[name].value_of for name in SHARES]
_VALUES_OF = [QUANTITIES[name].value_of for name in VALUES]


def rolled_up(results: Sequence[Row]) -> Row:
    """The columns of a rollup of current results."""
    observed = [row["observed"] for row in results]
    status = [row["status"] for row in results]
    counts = (
        len(results),
        sum(observed),
        sum([row["unique"] for row in results]),
        sum([row["ambiguous"] for row in results]),
        sum([row["unmatched"] for row in results]),
        len(status) - status.count(None),
        status.count("suspect"),
    )
    shares = [[value for value in map(of, results) if value is not None] for of in _SHARES_OF]
    values = [[value for value in map(of, results) if value is not None] for of in _VALUES_OF]
    sums = chain.from_iterable((len(there), sum(there, 0.0)) for there in values)
    extremes = shares + values
    least = [min(there, default=None) for there in extremes]
    most = [max(there, default=None) for there in extremes]
    # In the order of the columns: to put their names together takes longer than all of this.
    return dict(zip(ROLLED_UP, (*counts, *sums, *least, *most), strict=True))


def merge(into: Row, row: Row) -> None:
    """Add one rollup to another: sums add up, of the extremes the outer ones stay."""
    for name in (*COUNTS, *SUMS):
        into[name] += row[name]
    for name in MINIMA:
        if into[name] is None or (row[name] is not None and row[name] < into[name]):
            into[name] = row[name]
    for name in MAXIMA:
        if into[name] is None or (row[name] is not None and row[name] > into[name]):
            into[name] = row[name]
