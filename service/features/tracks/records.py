"""Records of tracks for the API, and the recorded batches that they are computed from."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from sqlalchemy import Connection, Select, select

from service.contract.answers import Answer
from service.contract.base import Count, Id, Moment, Record, doc
from service.errors import BadBatch, Fault
from service.features.tracks.linking import Gathering
from service.missions.mission import Mission, Tracker
from service.observations.calibrate import correct
from service.observations.decode import batch_from_canonical
from service.observations.scans.reduce import reduced
from service.storage.queries.pages import PLACE, ResultFilter
from service.storage.queries.results import answer_from_json, read_result, recorded_mission
from service.storage.sql.columns import Row
from service.storage.sql.tables import batches, results
from service.vectors import matrix_from_quaternion

_ROWS: Select[Any] = select(
    results.c.id,
    results.c.answer,
    results.c.mission_digest,
    results.c.time_ns,
    results.c.batch_id,
    batches.c.input,
).join_from(results, batches, results.c.batch_id == batches.c.id)


@dataclass(frozen=True, eq=False)
class RecordedBatches:
    """Database rows of consecutive batches in order of time, and their missions by digest."""

    rows: tuple[Row, ...]
    missions: dict[str, Mission]


def batches_of_period(connection: Connection, selected: ResultFilter, most: int) -> RecordedBatches:
    """All selected current results, as input for tracks.

    Raises `BadBatch` if there are more than `most`.
    """
    query = _ROWS.where(*selected.conditions()).order_by(*PLACE).limit(most + 1)
    rows = [dict(row) for row in connection.execute(query).mappings()]
    if len(rows) > most:
        message = f"the period has more than {most:,} batches; choose a shorter one"
        raise BadBatch(Fault("start", message))
    return _with_missions(connection, rows)


def batches_around(connection: Connection, id: str, each_side: int) -> RecordedBatches:
    """A result and the current ones nearest in time of its spacecraft and run.

    Raises `NotFound` without a result of this id.
    """
    result = read_result(connection, id)
    same = ResultFilter(result["run"], result["spacecraft"]).conditions()
    own = (results.c.batch_id, result["batch_id"])
    descending = [column.desc() for column in PLACE]
    earlier = _ROWS.where(*same, own[0] != own[1], results.c.time_ns <= result["time_ns"])
    later = _ROWS.where(*same, own[0] != own[1], results.c.time_ns > result["time_ns"])
    found = [
        *connection.execute(earlier.order_by(*descending).limit(each_side)).mappings(),
        *connection.execute(_ROWS.where(results.c.id == id)).mappings(),
        *connection.execute(later.order_by(*PLACE).limit(each_side)).mappings(),
    ]
    rows = sorted(map(dict, found), key=lambda row: (row["time_ns"], row["batch_id"]))
    return _with_missions(connection, rows)


def _with_missions(connection: Connection, rows: Sequence[Row]) -> RecordedBatches:
    digests = {row["mission_digest"] for row in rows}
    missions = {digest: recorded_mission(connection, digest) for digest in digests}
    return RecordedBatches(tuple(rows), missions)


def unexplained_points(recorded: RecordedBatches) -> Gathering:
    """Unmatched stars of batches with an attitude, converted to inertial directions.

    Observations are corrected with the settings used for their result.
    """
    trackers: dict[str, Tracker] = {}
    for mission in recorded.missions.values():
        trackers.update({each.name: each for each in mission.trackers})
    gathered = Gathering(list(trackers.values()))
    for row in recorded.rows:
        answer = answer_from_json(row["answer"])
        if answer.attitude is None:
            continue
        mission = recorded.missions[row["mission_digest"]]
        batch = reduced(batch_from_canonical(row["input"]), mission)
        gathered.add(
            batch,
            correct(batch, mission),
            _unmatched(answer),
            matrix_from_quaternion(answer.attitude.quaternion),
            np.array(answer.attitude.covariance_arcsec2),
            row["id"],
        )
    return gathered


def _unmatched(answer: Answer) -> list[Any]:
    return [
        np.array([k for k, star in enumerate(each.stars) if star.outcome == "unmatched"], np.int64)
        for each in answer.observations
    ]


TrackKindName = Literal["moving", "planet", "fixed_on_sky", "fixed_on_detector", "fixed"]


class TrackPoint(Record, frozen=True, kw_only=True):
    """A point of a track: an unmatched star of one batch and tracker."""

    id: Annotated[Id, doc("The result of the batch.")]
    tracker: str
    star: Annotated[Count, doc("Its place among the tracker's stars in the batch, from 0.")]
    time: Annotated[Moment, doc("Its own time, UTC.")]
    ra_deg: float
    dec_deg: float
    magnitude: float | None


class Track(Record, frozen=True, kw_only=True):
    """A track: points that move together, at most one per batch and tracker."""

    component: ClassVar[str] = "TrackOut"
    kind: Annotated[
        TrackKindName,
        doc(
            "`moving`: moves on the sky, and no planet does so there. `planet`: as a planet does. "
            "`fixed_on_sky`: keeps its place among the stars. `fixed_on_detector`: keeps its place "
            "on the detector while the sky passes, as a hot pixel does. `fixed`: keeps both, "
            "because the pointing was kept."
        ),
    ]
    planet: Annotated[str | None, doc("The planet's name; null for other kinds.")]
    planet_offset_arcsec: Annotated[
        float | None,
        doc("From the ephemeris, which is good to half a minute of arc; null for other kinds."),
    ]
    first: Annotated[Moment, doc("Time of the first point, UTC.")]
    last: Annotated[Moment, doc("Time of the last point, UTC.")]
    time: Annotated[Moment, doc("The middle, for which direction and rate hold, UTC.")]
    ra_deg: Annotated[float, doc("ICRS, as a star's in the catalog: without aberration.")]
    dec_deg: float
    sigma_ra_arcsec: Annotated[float, doc("On the sky: with the cosine of the declination.")]
    sigma_dec_arcsec: float
    rate_ra_arcsec_per_s: Annotated[float, doc("On the sky: with the cosine of the declination.")]
    rate_dec_arcsec_per_s: float
    sigma_rate_ra_arcsec_per_s: float
    sigma_rate_dec_arcsec_per_s: float
    rate_arcsec_per_s: Annotated[float, doc("Along the motion.")]
    sigma_rate_arcsec_per_s: float
    magnitude: Annotated[float | None, doc("Mean of the points; null if none came with one.")]
    sigma_magnitude: Annotated[
        float | None, doc("Sigma of the mean, from the scatter; null with fewer than two.")
    ]
    chi_square: Annotated[
        float, doc("Scatter about the motion; near `degrees_of_freedom` if the sigmas hold.")
    ]
    degrees_of_freedom: Count
    log10_expected: Annotated[
        float,
        doc("Logarithm of how many tracks as good points without any order would make."),
    ]
    points: list[TrackPoint]


class TrackList(Record, frozen=True, kw_only=True):
    """The tracks in a period, the track with the most points first."""

    spacecraft: str
    run: str
    batches: Annotated[Count, doc("Batches of the period.")]
    without_attitude: Annotated[Count, doc("Batches of these whose points have no direction.")]
    unexplained: Annotated[Count, doc("Unmatched stars of the others.")]
    linked: Annotated[Count, doc("Unmatched stars that are points of a track.")]
    items: list[Track]
