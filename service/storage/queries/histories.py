"""Queries for attitude histories, the state of a spacecraft, its settings, and the list of runs."""

import json
import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, ClassVar

from pydantic import ValidationError
from sqlalchemy import Connection, Select, exists, func, select

from service.acquire.result import METHOD
from service.contract.base import Page
from service.contract.runs import Run
from service.contract.spacecraft import AttitudeRow, MissionThen, SpacecraftRow, StateFault
from service.missions.mission import Mission
from service.observations.schema import LIVE
from service.storage.archived import Archive
from service.storage.queries import pages
from service.storage.queries.pages import MOST_OPENED, Listing
from service.storage.queries.results import summary_of, summary_query
from service.storage.recording.answer import state_in
from service.storage.sql.tables import (
    batches,
    mission_uses,
    missions,
    results,
    rollups_daily,
    runs,
    solutions,
)
from service.times import DAY_S, Utc, bucket_start

log = logging.getLogger(__name__)


class RetiredMission(Mission):
    """Last recorded settings of a spacecraft that no longer has a mission file."""

    retired: ClassVar[bool] = True


@dataclass(frozen=True)
class Retired:
    """Spacecraft and trackers with recorded data that no mission file describes any more."""

    missions: dict[str, Mission] = field(default_factory=dict)
    """Last settings of each retired spacecraft that has batches, by name."""
    trackers: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Trackers in earlier settings of a spacecraft but not in its last ones, by spacecraft."""


def list_attitudes(
    connection: Connection,
    selected: pages.ResultFilter,
    *,
    archive: Archive,
    limit: int,
    cursor: str | None,
) -> Page[AttitudeRow]:
    """List the attitudes of current results, recorded and archived, oldest batch time first."""
    chosen = [*selected.conditions(), results.c.status.is_not(None)]
    query = attitudes().where(*chosen)
    listing = Listing(archive, query, selected, needs=("solution",), most_opened=MOST_OPENED)
    return listing.page(connection, limit, cursor, attitude_row)


def live_state(
    connection: Connection, mission: Mission, run: str, now: Utc, faults: Sequence[StateFault]
) -> SpacecraftRow:
    """State of a spacecraft in a run: its newest batch, its newest attitude, and its faults.

    `state` is that of the newest batch: good, suspect, no_attitude, or no_batches.  `attitude` is
    that batch's own, or None; `last_attitude` is the newest of any batch.  `faults` are those of
    the spacecraft's row in the fleet.
    """
    selected = pages.ResultFilter(run, mission.name)
    batch = pages.newest(connection, summary_query(), selected, now)
    solved = attitudes().where(results.c.status.is_not(None))
    row = pages.newest(connection, solved, selected, now)
    last = None if row is None else attitude_row(row)
    is_latest = batch is not None and last is not None and last.id == batch["id"]
    tracking = None
    if batch is not None:
        answer = select(results.c.answer).where(results.c.id == batch["id"])
        tracking = state_in(connection.execute(answer).scalar_one())
    return SpacecraftRow(
        name=mission.name,
        description=mission.description,
        retired=mission.retired,
        state="no_batches" if batch is None else batch["status"] or "no_attitude",
        latest_batch=None if batch is None else summary_of(batch),
        attitude=last if is_latest else None,
        last_attitude=last,
        tracking=tracking,
        faults=list(faults),
    )


def mission_history(connection: Connection, spacecraft: str) -> list[MissionThen]:
    """All settings with which a spacecraft was served, each with its first use, oldest first.

    A return to earlier settings is a new entry.
    """
    query = (
        select(missions.c.digest, missions.c.settings, mission_uses.c.since)
        .join_from(mission_uses, missions, mission_uses.c.digest == missions.c.digest)
        .where(mission_uses.c.spacecraft == spacecraft)
        .order_by(mission_uses.c.id)
    )
    # Two processes that start together may both have noted one change.
    uses = groupby(connection.execute(query).mappings(), key=lambda row: row["digest"])
    return [
        MissionThen(digest=digest, since=row["since"], settings=json.loads(row["settings"]))
        for digest, (row, *_) in ((digest, list(rows)) for digest, rows in uses)
    ]


def retired(connection: Connection, missions_of_files: Mapping[str, Mission]) -> Retired:
    """Find spacecraft with batches but no mission file, and trackers missing in last settings."""
    found = Retired()
    has_batches = exists().where(rollups_daily.c.spacecraft == mission_uses.c.spacecraft)
    query = (
        select(mission_uses.c.spacecraft, missions.c.settings)
        .join(missions, mission_uses.c.digest == missions.c.digest)
        .where(has_batches)
        .order_by(mission_uses.c.spacecraft, mission_uses.c.id.desc())
    )
    for name, uses in groupby(connection.execute(query), key=lambda row: row.spacecraft):
        settings = [use.settings for use in uses]
        mission = missions_of_files.get(name)
        if mission is None:
            try:
                mission = RetiredMission.model_validate_json(settings[0])
            except ValidationError as error:
                log.warning("%s: its recorded settings cannot be read: %s", name, error)
                continue
            found.missions[name] = mission
        names = {each["name"] for text in settings for each in json.loads(text)["trackers"]}
        found.trackers[name] = tuple(sorted(names - {each.name for each in mission.trackers}))
    return found


def list_runs(connection: Connection, spacecraft: Collection[str] | None = None) -> list[Run]:
    """List all runs, each with its number of batches, its spacecraft and the days it covers.

    With `spacecraft`, only batches of these count.
    """
    daily = rollups_daily.c
    query = select(
        daily.spacecraft,
        daily.run,
        func.sum(daily.batches).label("batches"),
        func.min(daily.bucket).label("first"),
        func.max(daily.bucket).label("last"),
    ).group_by(daily.run, daily.spacecraft)
    if spacecraft is not None:
        query = query.where(daily.spacecraft.in_(spacecraft))
    parts: dict[str, list[Any]] = {}
    for part in connection.execute(query.order_by(daily.run, daily.spacecraft)).mappings():
        parts.setdefault(part["run"], []).append(part)
    return [
        Run(
            run=row["name"],
            created=row["created"],
            alarms=row["alarms"] or row["name"] == LIVE,
            batches=int(sum(part["batches"] for part in parts[row["name"]])),
            spacecraft=[part["spacecraft"] for part in parts[row["name"]]],
            first_day=_day(min(part["first"] for part in parts[row["name"]])),
            last_day=_day(max(part["last"] for part in parts[row["name"]])),
        )
        for row in connection.execute(select(runs).order_by(runs.c.name)).mappings()
        if row["name"] in parts
    ]


def _day(number: int) -> str:
    return bucket_start(number, DAY_S).text[:10]


def attitudes() -> Select[Any]:
    """SQL query for the columns that `attitude_row` reads."""
    place = [results.c.id, *pages.PLACE, batches.c.batch, batches.c.time]
    return (
        select(*place, *(column for column in solutions.c if column.name != "result_id"))
        .join_from(results, batches, results.c.batch_id == batches.c.id)
        .join(solutions, solutions.c.result_id == results.c.id)
    )


def attitude_row(row: Any) -> AttitudeRow:
    """Convert a database row to an entry of an attitude history."""
    is_measured = row["method"] == METHOD
    return AttitudeRow(
        id=row["id"],
        batch=row["batch"],
        time=row["time"],
        quaternion=[row[name] for name in pages.QUATERNION],
        frame=row["frame"],
        covariance_arcsec2=pages.covariance_of([row[name] for name in pages.COVARIANCE]),
        residual_rms_arcsec=None if is_measured else row["residual_rms_arcsec"],
        predicted_rms_arcsec=None if is_measured else row["predicted_rms_arcsec"],
        taste=None if is_measured else row["taste"],
        method=row["method"],
        status=row["status"],
    )
