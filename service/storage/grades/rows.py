"""Filtered and smoothed attitudes of a period page by page, and the filtered one of live data."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from sqlalchemy import ColumnElement, Connection, Select, func, select, tuple_

from service.filtering.result import Status
from service.grades.carried import Carried
from service.grades.day import Grade, day_bounds, unpacked
from service.gyro import texts_of
from service.products.attitudes import AttitudeRows
from service.storage.grades.inputs import inside
from service.storage.models.products import LiveAttitude
from service.storage.queries.pages import ResultFilter, covariance_of
from service.storage.queries.time_buckets import buckets_between
from service.storage.sql.grade_tables import graded_blocks, graded_days
from service.times import DAY_S, Utc

METHODS: dict[Grade, str] = {"filtered": "ekf", "smoothed": "filter_smoother"}
"""The words of CCSDS ACM's AD_METHOD."""
STATUS = {Status.GOOD: "good", Status.STARTING: "suspect", Status.DOUBTFUL: "suspect"}
PLACE = (graded_days.c.day, graded_blocks.c.position)
BLOCKS = select(
    *PLACE,
    graded_days.c.id,
    graded_days.c.revision,
    graded_blocks.c.model,
    graded_blocks.c.samples,
    graded_blocks.c.packed,
).join_from(graded_days, graded_blocks, graded_blocks.c.day_id == graded_days.c.id)


def graded_pages(
    reading: Callable[[], AbstractContextManager[Connection]],
    selected: ResultFilter,
    grade: Grade,
    *,
    newest_first: bool = False,
    page: int | None = None,
) -> Iterator[AttitudeRows]:
    """The samples of the latest revisions in a period, a block of up to an hour at a time.

    Of each block no more than the first `page`.  Between two blocks no connection is held.
    """
    order = [column.desc() if newest_first else column for column in PLACE]
    query = BLOCKS.where(*block_conditions(selected, grade)).order_by(*order).limit(1)
    beyond: Select[Any] = query
    while True:
        with reading() as connection:
            row = connection.execute(beyond).mappings().first()
        if row is None:
            return
        rows = _rows(row, selected, grade)
        if newest_first:
            rows = rows.taken(slice(None, None, -1))
        if len(rows):
            yield rows.taken(slice(0, page))
        place, last = tuple_(*PLACE), tuple_(row["day"], row["position"])
        beyond = query.where(place < last if newest_first else place > last)


def count_samples_of(connection: Connection, selected: ResultFilter, grade: Grade) -> int:
    """The samples of the blocks that touch a period: at least those of the period."""
    total = select(func.sum(graded_blocks.c.samples)).join_from(
        graded_days, graded_blocks, graded_blocks.c.day_id == graded_days.c.id
    )
    return int(connection.scalar(total.where(*block_conditions(selected, grade))) or 0)


def block_conditions(selected: ResultFilter, kind: str) -> list[ColumnElement[bool]]:
    """The blocks of a grade, or of innovations, that touch a period, as SQL; latest revisions."""
    days, blocks = graded_days.c, graded_blocks.c
    chosen: list[ColumnElement[bool]] = [
        days.current,
        days.spacecraft == selected.spacecraft,
        days.run == selected.run,
        blocks.grade == kind,
        *buckets_between(days.day, selected.start, selected.end, DAY_S),
    ]
    if selected.start is not None:
        chosen.append(blocks.end_ns >= selected.start.tai_ns)
    if selected.end is not None:
        chosen.append(blocks.start_ns < selected.end.tai_ns)
    return chosen


def _rows(row: Any, selected: ResultFilter, grade: Grade) -> AttitudeRows:
    """The samples of a block that lie in the period."""
    found = unpacked(row["packed"], row["samples"])
    found = found.taken(inside(found.tai_ns, selected))
    n = len(found)
    start, _ = day_bounds(row["day"])
    status = _repeated(None, n)
    for code, word in STATUS.items():
        status[found.status == code] = word
    known = np.where([each is None for each in status], np.nan, 1.0).reshape(n, 1)
    time = _repeated(None, n)
    time[:] = texts_of(start, np.asarray((found.tai_ns - start.tai_ns) * 1e-9))
    unknown = np.full(n, np.nan)
    return AttitudeRows(
        time_ns=found.tai_ns,
        time=time,
        id=_repeated(row["id"], n),
        batch=_repeated(None, n),
        status=status,
        method=_repeated(METHODS[grade], n),
        quaternion=found.quaternion * known,
        covariance_arcsec2=found.covariance_arcsec2 * known,
        rate_deg_per_s=found.rate_deg_per_s * known,
        residual_rms_arcsec=unknown,
        predicted_rms_arcsec=unknown,
        stars=np.zeros((n, 4), dtype=np.int64),
        model=_repeated(row["model"], n),
        revision=np.full(n, row["revision"], dtype=np.int64),
        bias_deg_per_h=found.bias_deg_per_h,
        bias_sigma_deg_per_h=found.bias_sigma_deg_per_h,
    )


def _repeated(value: str | None, n: int) -> Any:
    column = np.empty(n, dtype=object)
    column[:] = value
    return column


def live_attitude(name: str, day_start: Utc, carried: Carried | None) -> LiveAttitude | None:
    """The answer about the last epoch; None where there is no attitude, or it is lost."""
    if carried is None or (word := STATUS.get(Status(int(carried.sample.status[0])))) is None:
        return None
    sample = carried.sample
    (time,) = texts_of(day_start, np.asarray((sample.tai_ns - day_start.tai_ns) * 1e-9))
    is_gyro = carried.model == "gyro"
    return LiveAttitude(
        spacecraft=name,
        time=time,
        quaternion=sample.quaternion[0].tolist(),
        covariance_arcsec2=covariance_of(sample.covariance_arcsec2[0].tolist()),
        rate_deg_per_s=sample.rate_deg_per_s[0].tolist(),
        bias_deg_per_h=sample.bias_deg_per_h[0].tolist() if is_gyro else None,
        bias_sigma_deg_per_h=sample.bias_sigma_deg_per_h[0].tolist(),
        status=word,
        model=carried.model,
    )
