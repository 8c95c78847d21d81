"""Metrics of results and of their trackers, and rollups of metrics in memory or by SQL.

Rows of `tracker_values` exist only for spacecraft with several trackers: with one tracker the
result itself has the same values.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
from sqlalchemy import (
    BigInteger,
    ColumnElement,
    Connection,
    Double,
    Table,
    case,
    delete,
    func,
    insert,
    select,
)

from service.acquire import Acquisition
from service.contract.answers import Answer, Star
from service.identify.identification import Integers
from service.observations.calibrate import CorrectedObservations
from service.storage.recording.identity import digest_of_row
from service.storage.sql import tables
from service.storage.sql.columns import Row
from service.trends.measures import (
    STORED,
    BatchStars,
    Measured,
    MeasuredOfBatch,
    MeasuredStars,
    Ratio,
    StarShare,
)
from service.trends.quantities import QUANTITIES, Quantity
from service.vectors import Vector


def metrics_of(acquisition: Acquisition, stars: MeasuredStars | None = None) -> Row:
    """Measured quantities of an acquisition by name; None for a quantity without a value.

    `stars` are those of all its trackers, if already computed.
    """
    stars = stars or MeasuredStars.of_all(acquisition)
    of_batch = {
        name: source.measure(acquisition)
        for name, source in STORED.items()
        if isinstance(source, MeasuredOfBatch)
    }
    return of_batch | _measures(stars)


def _measures(stars: MeasuredStars) -> Row:
    """Measured values of a batch's or a tracker's stars, by name of the quantity."""
    return {
        name: source.measure(stars)
        for name, source in STORED.items()
        if isinstance(source, Measured)
    }


_SHARES_OF = [QUANTITIES[name].value_of for name in tables.SHARES]
_VALUES_OF = [QUANTITIES[name].value_of for name in tables.VALUES]


def rolled_up(current: Sequence[Row]) -> Row:
    """Sums of current results as one row of a rollup: counts, sums, least and greatest values."""
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
    # Values in the order of the columns: building the names takes longer than all of this.
    return dict(zip(tables.ROLLED_UP, (*counts, *sums, *least, *most), strict=True))


def merge(into: Row, row: Row) -> None:
    """Merge one rollup into another: sums are added, extremes widened."""
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
# `result_metrics.rolled_up` does the same for results in memory.  The index of current results has
# every column that is read here.


def _counts(of: Table) -> Mapping[str, ColumnElement[Any]]:
    stars = {name: of.c[name] for name in tables.COUNTED if name != "observed"}
    # Observed stars as the sum of the other counts, which the index has.
    return {"observed": stars["unique"] + stars["ambiguous"] + stars["unmatched"], **stars}


def value_sql(quantity: Quantity, of: Table = tables.results) -> ColumnElement[Any]:
    """SQL for a quantity of one result, or of one tracker in it; null without a value."""
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
"""SQL expressions over `results` for each column of a rollup."""
SUMMED_OF_TRACKERS = _summed(tables.tracker_values)
"""SQL expressions over `tracker_values` for each column of a rollup."""
OF_TRACKERS = tables.results.join(
    tables.tracker_values, tables.tracker_values.c.batch_id == tables.results.c.batch_id
)
"""Join of `tracker_values` with `results`, so that a query can choose current results."""


# ---- the trackers of a batch: stars by outcome, residuals, magnitudes -------------------------


def values_of_trackers(
    acquisition: Acquisition, answer: Answer, batch_id: str, stars: BatchStars
) -> list[Row]:
    """Rows of `tracker_values` for an acquisition; none where its mission has one tracker."""
    return [] if len(acquisition.mission.trackers) == 1 else tracker_rows(batch_id, answer, stars)


def catalog_rows(answer: Answer, place: Mapping[str, int]) -> list[Integers]:
    """Indices in the run catalog (n,) of the stars of every tracker, -1 for unidentified stars.

    `place` gives the index of a star's id; empty where the catalog no longer exists.
    """
    return [
        np.array([place.get(star.star.id, -1) if star.star else -1 for star in each.stars], int)
        for each in answer.observations
    ]


def tracker_rows(batch_id: str, answer: Answer, stars: BatchStars) -> list[Row]:
    """Rows of `tracker_values` for an answer, one for each tracker in the mission's order."""
    expected = [_expected_squares(answer, each) for each in stars.corrected]
    scale = _scale(answer, expected)
    rows = []
    for k, (observed, squares) in enumerate(zip(answer.observations, expected, strict=True)):
        outcomes = [star.outcome for star in observed.stars]
        used = list(_residuals(observed.stars))
        predicted = scale * math.fsum(squares[place] for place, _ in used)
        own = MeasuredStars(
            stars,
            range(k, k + 1),
            _rms(math.fsum(each**2 for _, each in used), len(used)),
            _rms(predicted, len(used)),
        )
        row = dict.fromkeys(tables.MEASURED) | {
            "batch_id": batch_id,
            "tracker": observed.tracker,
            "observed": len(outcomes),
            **{name: outcomes.count(name) for name in ("unique", "ambiguous", "unmatched")},
            "status": _status(answer, observed.tracker),
            **_measures(own),
        }
        rows.append(row | {"row_digest": digest_of_row(tables.tracker_values, row)})
    return rows


def _residuals(stars: Sequence[Star]) -> Iterator[tuple[int, float]]:
    """Index and residual of each star that the attitude uses."""
    for place, star in enumerate(stars):
        if star.residual_arcsec is not None:
            yield place, star.residual_arcsec


def _status(answer: Answer, tracker: str) -> str | None:
    """Status of a tracker: `suspect` if it disagrees with the others; None without an attitude."""
    if answer.attitude is None:
        return None
    return "suspect" if answer.attitude.outlier == tracker else "good"


def _expected_squares(answer: Answer, seen: CorrectedObservations) -> Vector:
    """Expected squared residual in arcsec^2 of each star (n,); zeros without an attitude.

    For the best attitude it is the noise along both tangent axes, less the part that the attitude,
    of covariance P, absorbs: 2 sigma^2 - (trace P - d' P d).
    """
    if answer.attitude is None:
        return np.zeros(len(seen.sigma_arcsec))
    covariance = np.array(answer.attitude.covariance_arcsec2)
    direction = seen.direction_body
    along = np.einsum("ni,ij,nj->n", direction, covariance, direction)
    return np.asarray(2.0 * seen.sigma_arcsec**2 - (np.trace(covariance) - along))


def _scale(answer: Answer, expected: Sequence[Vector]) -> float:
    """Factor that scales the expected squared residuals to the sum that the answer predicts, or 0.

    It is 1 for QUEST. TRIAD's attitude absorbs a different part of the noise, which its answer
    gives for all stars together only.
    """
    if answer.attitude is None or answer.attitude.predicted_rms_arcsec is None:
        return 0.0
    used = [
        squares[place]
        for squares, stars in zip(expected, answer.observations, strict=True)
        for place, _ in _residuals(stars.stars)
    ]
    total = math.fsum(used)
    return len(used) * answer.attitude.predicted_rms_arcsec**2 / total if total > 0.0 else 0.0


def _rms(squares: float, count: int) -> float | None:
    """Root mean square from a sum of squares and a count; None if either is zero."""
    return math.sqrt(squares / count) if count and squares > 0.0 else None


def is_waiting(connection: Connection, spacecraft: str, run: str) -> bool:
    """True if some batches of a spacecraft's run are not yet split by tracker."""
    query = select(tables.tracker_splits.c.run).where(
        tables.tracker_splits.c.spacecraft == spacecraft, tables.tracker_splits.c.run == run
    )
    return connection.execute(query).first() is not None


def split_anew(connection: Connection, spacecraft: str) -> None:
    """Mark all batches of a spacecraft for splitting by tracker: it now has several."""
    connection.execute(
        delete(tables.tracker_splits).where(tables.tracker_splits.c.spacecraft == spacecraft)
    )
    recorded, trends = (
        select(table.c.spacecraft, table.c.run).where(table.c.spacecraft == spacecraft)
        for table in (tables.results, tables.rollups_daily)
    )
    # Archived batches appear in the trends only, and the latest batches in the record only.
    runs = recorded.union(trends)
    connection.execute(insert(tables.tracker_splits).from_select(["spacecraft", "run"], runs))
