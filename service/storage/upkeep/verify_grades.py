"""Checks the recorded days of filtered and smoothed attitudes, a day at a time; changes nothing."""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np
from sqlalchemy import Connection, Engine, func, select

from service.grades.day import GRADES, GradedSamples
from service.grades.innovations import MeasuredInnovations
from service.grades.packing import unpacked, unpacked_innovations
from service.storage.sql.grade_tables import INNOVATIONS, graded_blocks, graded_days

AT_ONCE = 500
_UNPACKED: dict[str, Callable[[bytes, int], GradedSamples | MeasuredInnovations]] = {
    INNOVATIONS: unpacked_innovations
}


def of_the_grades(engine: Engine) -> Iterator[str]:
    """The faults of the graded days, a sentence each.

    The samples of a current day must be those that were digested, in order of time, within the
    day and as many as it says; an earlier revision has none.
    """
    last = ""
    while True:
        query = select(graded_days.c.id).where(graded_days.c.id > last).order_by(graded_days.c.id)
        with engine.begin() as connection:
            ids = connection.scalars(query.limit(AT_ONCE)).all()
        for id in ids:
            # As of one moment: a new revision takes the samples from the one before.
            with engine.begin() as connection:
                yield from _of_a_day(connection, id)
        if len(ids) < AT_ONCE:
            return
        last = ids[-1]


def _of_a_day(connection: Connection, id: str) -> Iterator[str]:
    row = connection.execute(select(graded_days).where(graded_days.c.id == id)).mappings().first()
    if row is None:
        return
    name = f"graded day {id}"
    c = graded_blocks.c
    if not row["current"]:
        if connection.scalar(select(func.count()).where(c.day_id == id)):
            yield f"{name}: it has samples, though it is not the current revision"
        return
    digest, samples = hashlib.sha256(), Counter[str]()
    for grade in (*GRADES, INNOVATIONS):
        end_ns = row["start_ns"]
        chosen = select(graded_blocks).where(c.day_id == row["id"], c.grade == grade)
        for block in connection.execute(chosen.order_by(c.position)).mappings():
            where = f"{name}: block {block['position']} of {grade}"
            try:
                found = _UNPACKED.get(grade, unpacked)(block["packed"], block["samples"])
            except ValueError as error:
                yield f"{where}: its samples cannot be read: {error}"
                continue
            digest.update(block["packed"])
            samples[grade] += block["samples"]
            times = found.tai_ns
            bounds = block["start_ns"], block["end_ns"]
            # Measurements of two trackers may be of the same moment.
            least = 0 if grade == INNOVATIONS else 1
            if np.any(np.diff(times) < least) or bounds != (int(times[0]), int(times[-1])):
                yield f"{where}: its times are not those of its samples"
            if block["start_ns"] < end_ns or block["end_ns"] >= row["end_ns"]:
                yield f"{where}: it does not lie within its day, after the block before it"
            end_ns = block["end_ns"]
    if any(samples[grade] != row["samples"] for grade in GRADES):
        yield f"{name}: it has not as many samples as it says"
    elif f"sha256:{digest.hexdigest()}" != row["digest"]:
        yield f"{name}: its samples are not those that were digested"
