"""The share of archived batches in the trends, hour by hour.

A trend holds recorded and archived batches alike.  Where an hour is counted anew from the
recorded ones, the share that is kept here is added.
"""

import json
from collections.abc import Iterator, Mapping, Sequence

from sqlalchemy import Connection, delete, insert, select

from service.storage.recording.result_metrics import OF_TRACKERS, SUMMED, SUMMED_OF_TRACKERS, merge
from service.storage.sql.columns import Row
from service.storage.sql.tables import (
    COUNTS,
    MAXIMA,
    MINIMA,
    SUMS,
    archived_hours,
    results,
    tracker_values,
)

WHOLE = ""
"""In place of a tracker: the spacecraft as a whole."""
_NOTHING: Row = dict.fromkeys((*COUNTS, *SUMS), 0) | dict.fromkeys((*MINIMA, *MAXIMA))


def keep_share(
    connection: Connection,
    part_id: int,
    spacecraft: str,
    run: str,
    of_hour: Mapping[int, Sequence[str]],
) -> None:
    """Note what the current results of recorded batches add to each hour.

    `of_hour` has the ids of the batches by the number of their hour.
    """
    found: dict[int, dict[str, Row]] = {}
    for hour, batch_ids in of_hour.items():
        chosen = results.c.current, results.c.batch_id.in_(batch_ids)
        whole = connection.execute(select(*SUMMED.values()).where(*chosen)).mappings().one()
        of_trackers = (
            select(tracker_values.c.tracker, *SUMMED_OF_TRACKERS.values())
            .select_from(OF_TRACKERS)
            .where(*chosen)
            .group_by(tracker_values.c.tracker)
        )
        found[hour] = {WHOLE: dict(whole)}
        for row in connection.execute(of_trackers).mappings():
            share = dict(row)
            found[hour][share.pop("tracker")] = share
    insert_share(connection, part_id, spacecraft, run, found)


def insert_share(
    connection: Connection,
    part_id: int,
    spacecraft: str,
    run: str,
    of_hour: Mapping[int, Mapping[str, Row]],
) -> None:
    """Note the share of a part in each hour, by tracker and for the `WHOLE`."""
    own = {"spacecraft": spacecraft, "run": run, "part_id": part_id}
    rows = [
        own | {"bucket": hour, "tracker": tracker, "sums": json.dumps(share)}
        for hour, shares in of_hour.items()
        for tracker, share in shares.items()
    ]
    if rows:
        connection.execute(insert(archived_hours), rows)


def forget_share(connection: Connection, part_id: int, spacecraft: str, run: str) -> None:
    """Delete the share of a part whose batches are recorded again."""
    c = archived_hours.c
    own = c.spacecraft == spacecraft, c.run == run, c.part_id == part_id
    connection.execute(delete(archived_hours).where(*own))


def shares_of_hour(connection: Connection, spacecraft: str, run: str, hour: int) -> dict[str, Row]:
    """The share of all archived batches of an hour, by tracker and for the `WHOLE`."""
    c = archived_hours.c
    query = select(c.tracker, c.sums).where(
        c.spacecraft == spacecraft, c.run == run, c.bucket == hour
    )
    found: dict[str, Row] = {}
    for tracker, sums in connection.execute(query):
        merge(found.setdefault(tracker, dict(_NOTHING)), _NOTHING | json.loads(sums))
    return found


def every_share(connection: Connection) -> Iterator[tuple[str, str, str, int, Row]]:
    """Every share as (spacecraft, run, tracker, hour, columns)."""
    c = archived_hours.c
    query = select(c.spacecraft, c.run, c.tracker, c.bucket, c.sums)
    for spacecraft, run, tracker, hour, sums in connection.execute(query):
        yield spacecraft, run, tracker, hour, _NOTHING | json.loads(sums)
