"""Recorded errors of a priori attitudes, by which the size of zones is judged."""

import math

from sqlalchemy import Connection, select

from service.storage.queries.pages import ResultFilter, newest_first
from service.storage.sql.tables import results, solutions


def latest_prior_errors(
    connection: Connection, selected: ResultFilter, limit: int
) -> tuple[list[float], list[float]]:
    """Angles in degrees from a priori to found attitudes of the latest batches, and their sigmas.

    They are in order from the newest batch.  Batches without an a priori or a good attitude are
    left out: a wrong identification gives an angle of any size.
    """
    angle_deg, columns = results.c.a_priori_angle_deg, solutions.c
    variance_arcsec2 = columns.p11 + columns.p22 + columns.p33
    query = (
        select(angle_deg, variance_arcsec2.label("variance_arcsec2"))
        .join_from(results, solutions, columns.result_id == results.c.id)
        .where(*selected.conditions(), angle_deg.is_not(None), results.c.status == "good")
    )
    rows = connection.execute(newest_first(query).limit(limit)).all()
    return [row[0] for row in rows], [math.sqrt(row[1]) / 3600.0 for row in rows]
