"""Current results of a spacecraft with their attitudes, in order of time, page by page."""

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
import numpy as np
from sqlalchemy import Select, select

from service.acquire.measured import METHOD
from service.products.attitudes import AttitudeRows
from service.storage.archive.reading import Archive
from service.storage.queries.pages import PLACE, ResultFilter
from service.storage.queries.with_archive.rows import ArchiveUse, Reading, row_pages
from service.storage.sql.tables import COUNTED, batches, results, solutions
from service.vectors import Vector

PAGE = 5_000
"""Rows that are read together."""

_SOLVED = ("q1", "q2", "q3", "qc", "p11", "p12", "p13", "p22", "p23", "p33")
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
        *(solutions.c[name] for name in (*_SOLVED, *_QUALITY)),
        *(results.c[name] for name in COUNTED),
    )
    .join_from(results, batches, results.c.batch_id == batches.c.id)
    .outerjoin(solutions, solutions.c.result_id == results.c.id)
)


class _Rates(msgspec.Struct):
    """Of a recorded input, the rates alone."""

    body_rates_deg_per_s: tuple[float, float, float] | None = None


_RATES = msgspec.json.Decoder(_Rates)
_UNKNOWN = (np.nan, np.nan, np.nan)


def attitude_pages(
    reading: Reading,
    archive: Archive,
    selected: ResultFilter,
    *,
    newest_first: bool = False,
    page: int = PAGE,
) -> Iterator[AttitudeRows]:
    """Every current result that is selected, with its attitude, page by page.

    Those of the archive are read with the recorded ones.

    Between two pages no connection is held, so that a slow reader keeps none from others.
    """
    use = ArchiveUse(archive, ("input", "solution"))
    pages = row_pages(
        reading,
        use,
        _QUERY.where(*selected.conditions()),
        selected,
        page,
        newest_first=newest_first,
    )
    return map(_columns, pages)


def _columns(rows: Sequence[Any]) -> AttitudeRows:
    time_ns, _, id, status, batch, time, sent, method, *numbers = zip(*rows, strict=True)
    values = np.array(numbers, dtype=np.float64)
    # In the table they are zero.
    values[10:12, np.array(method, dtype=object) == METHOD] = np.nan
    rates = [_RATES.decode(each).body_rates_deg_per_s for each in sent]
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
