"""Batches of a period: a bounded sample of them, and the arrays that its charts show.

Nothing is identified here.  Directions are computed from the batches as sent, with the settings of
the mission at the time of each result.  Batches (b) are in order of time.  Unknown values are NaN.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from sqlalchemy import BigInteger, Connection, Select, bindparam, select

from service import vectors
from service.acquire.choices import aberration_velocity
from service.contract.answers import Answer, Star
from service.identify.prior_attitude import PriorAttitude, search_region
from service.missions.mission import Mission, Tracker
from service.observations.batch import ObservationBatch
from service.observations.calibrate import CorrectedObservations, correct
from service.observations.schema import submission_from_json
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import apparent, sun_direction
from service.sky.model import SkyModel
from service.sky.zones import SearchRegion
from service.storage.queries.pages import PLACE, ResultFilter, newest_first
from service.storage.queries.results import answer_from_json, recorded_mission
from service.storage.queries.star_field import presumed_attitude
from service.storage.queries.time_buckets import BucketFilter, read_buckets
from service.storage.sql.columns import Row
from service.storage.sql.tables import batches, results
from service.times import HOUR_S, Utc, utc_of_unix
from service.vectors import Matrix, Vector

MOST_READ = 600
"""Largest number of batches read in full: their stars take less than a second."""

_SHOWN: Select[tuple[str, str, int, str, float | None, str]] = select(
    results.c.answer,
    results.c.mission_digest,
    results.c.time_ns,
    results.c.batch_id,
    results.c.a_priori_angle_deg,
    batches.c.input,
).join_from(results, batches, results.c.batch_id == batches.c.id)
_FROM_NS = bindparam("from_ns", type_=BigInteger)


@dataclass(frozen=True, eq=False)
class PeriodAttitudes:
    """Attitudes of the sampled batches (b) of a period, as arrays.

    `quaternion` (b, 4) is inertial to body, `covariance_arcsec2` (b, 3, 3) of the error rotation
    about the body axes.  `status` is `good`, `suspect` or `no_attitude`.  `follows` (b,) is True if
    no other batch lies between a batch and the sampled one before it.
    """

    time_ns: npt.NDArray[np.int64]
    time: tuple[str, ...]
    status: tuple[str, ...]
    quaternion: Vector
    covariance_arcsec2: Vector
    follows: npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class TrackerStarsOfPeriod:
    """Unique stars (n) of one tracker, and its boresight in each sampled batch.

    `place_deg` (n, 2) is h and v on the focal plane.  `residual_arcsec` (n, 2) is observed minus
    predicted along h and along v, and `expected_arcsec` (n, 2) its standard deviation: the star's
    sigma less the part of the noise that the attitude absorbs.  Both are NaN for a star that the
    attitude does not use.  `boresight` (b, 3) is inertial; without an attitude that of the a priori
    one.
    """

    tracker: str
    field_of_view_radius_deg: float
    sigma_arcsec: float
    boresight: Vector
    place_deg: Vector
    residual_arcsec: Vector
    expected_arcsec: Vector
    observed_mag: Vector
    catalog_mag: Vector
    region: SearchRegion | None
    """Region of the sky searched for the stars of the latest batch."""


@dataclass(frozen=True, eq=False)
class PeriodStars:
    """Stars of the sampled batches of a period, by tracker; `total` counts all its batches.

    `other_catalog` counts the sampled batches that were identified with a star catalog which the
    service no longer has; their stars are left out.  `sun` (b, 3) are inertial directions to the
    Sun.
    """

    total: int
    attitudes: PeriodAttitudes
    trackers: tuple[TrackerStarsOfPeriod, ...]
    other_catalog: int
    sun: Vector
    first: Utc | None
    last: Utc | None

    @property
    def read(self) -> int:
        """Number of batches in the sample."""
        return len(self.attitudes.time)


@dataclass(frozen=True)
class PeriodSample:
    """Sample of the `total` batches of a period in order of time, with missions by digest.

    `follows` (b,) is True if no other batch lies between a batch and the sampled one before it.
    """

    total: int
    follows: npt.NDArray[np.bool_]
    rows: tuple[Row, ...]
    missions: dict[str, Mission]


def sample_period(
    connection: Connection, span: BucketFilter, most: int = MOST_READ
) -> PeriodSample:
    """Sample a period: all batches, or pairs of neighbours spread evenly, at most `most` batches.

    Each pair is drawn at random from one of equal parts of the batches, so that a periodic effect
    is neither always nor never sampled.  The batches of an hour count as spread evenly over it.
    For a long period the hourly counts are read, and no more batches than for a short one.
    """
    hours = read_buckets(connection, span, "hour", ("batches",))
    total = int(hours["batches"].sum())
    selected = ResultFilter(span.run, span.spacecraft, span.start, span.end)
    query = _SHOWN.order_by(*PLACE)
    if total <= most:
        chosen = query.where(*selected.conditions()).limit(most)
        rows = tuple(map(dict, connection.execute(chosen).mappings()))
        follows = np.arange(len(rows)) > 0
    else:
        drawn = _drawn_times_ns(hours["unix_s"], hours["batches"], most // 2)
        # The first hour may begin before the period.
        pairs = _pairs(connection, selected, [max(each, span.start.tai_ns) for each in drawn])
        drawn_ids = {id for pair in pairs for id in pair}
        # Leave out the period, which would make SQLite search it for each id.
        chosen = query.where(results.c.current, results.c.batch_id.in_(drawn_ids))
        rows = tuple(map(dict, connection.execute(chosen).mappings()))
        ids = [row["batch_id"] for row in rows]
        follows = np.array([False, *(pair in pairs for pair in pairwise(ids))])
    digests = {row["mission_digest"] for row in rows}
    missions = {digest: recorded_mission(connection, digest) for digest in digests}
    return PeriodSample(total, follows, rows, missions)


def _drawn_times_ns(
    unix_s: npt.NDArray[np.float64], count: npt.NDArray[np.float64], pairs: int
) -> list[int]:
    """Draw a random time (ns of TAI) in each of `pairs` parts of a period with as many batches."""
    rng = np.random.default_rng(0)
    rank = (np.arange(pairs) + rng.random(pairs)) * count.sum() / pairs
    before = np.concatenate([[0.0], np.cumsum(count)])
    place = np.clip(np.searchsorted(before, rank, side="right") - 1, 0, len(count) - 1)
    at_s = unix_s[place] + (rank - before[place]) / count[place] * HOUR_S
    return [utc_of_unix(each).tai_ns for each in at_s.tolist()]


def _pairs(
    connection: Connection, selected: ResultFilter, begins_ns: Sequence[int]
) -> set[tuple[str, str]]:
    """First two batches after each given time; near the end of the period the last two."""
    forward = (
        select(results.c.batch_id)
        # With a single lower bound the index is entered at that bound.
        .where(*replace(selected, start=None).conditions(), results.c.time_ns >= _FROM_NS)
        .order_by(*PLACE)
        .limit(2)
    )
    backward = newest_first(select(results.c.batch_id).where(*selected.conditions())).limit(2)
    found = set()
    for begin_ns in begins_ns:
        pair = [row[0] for row in connection.execute(forward, {"from_ns": begin_ns})]
        if len(pair) < 2:
            pair = [row[0] for row in connection.execute(backward)][::-1]
        found.add((pair[0], pair[1]))
    return found


LEAST_EXPECTED = 0.1
"""Least expected residual as a fraction of sigma; below it the attitude follows the star itself."""
ALIGNED_DEG = 0.01
_UNKNOWN_DIRECTION = (np.nan, np.nan, np.nan)


@dataclass
class _Collected:
    """Lists of arrays for one tracker's stars, filled batch by batch."""

    tracker: Tracker
    boresight: list[Vector]
    place_deg: list[Vector] = field(default_factory=list)
    residual_arcsec: list[Vector] = field(default_factory=list)
    expected_arcsec: list[Vector] = field(default_factory=list)
    observed_mag: list[Vector] = field(default_factory=list)
    catalog_mag: list[Vector] = field(default_factory=list)
    region: SearchRegion | None = None


def period_stars(sample: PeriodSample, sky: SkyModel) -> PeriodStars:
    """Compute attitudes, boresights, residuals and magnitudes of a sample of batches."""
    rows_of: dict[str, dict[str, int]] = {}
    read = [
        (
            submission_from_json(row["input"]).batch,
            answer_from_json(row["answer"]),
            sample.missions[row["mission_digest"]],
        )
        for row in sample.rows
    ]
    collected: dict[str, _Collected] = {}
    other_catalog = 0
    for place, (batch, answer, mission) in enumerate(read):
        run_catalog = sky.run_catalog(mission, batch.time)
        digest = run_catalog.digest
        if digest not in rows_of:
            rows_of[digest] = {name: row for row, name in enumerate(run_catalog.star_id)}
        is_known = digest == answer.provenance.run_catalog
        other_catalog += not is_known
        presumed = presumed_attitude(batch, answer, mission)
        for tracker in mission.trackers:
            into = collected.setdefault(
                tracker.name, _Collected(tracker, [np.array(_UNKNOWN_DIRECTION)] * len(read))
            )
            into.boresight[place] = _boresight(tracker, answer, presumed, mission)
        for seen, found in zip(correct(batch, mission), answer.observations, strict=True):
            into = collected[seen.tracker.name]
            into.tracker = seen.tracker
            into.region = _region(seen.tracker, presumed, mission)
            if is_known:
                _add(into, batch, answer, seen, found.stars, run_catalog, rows_of[digest])
    times = [batch.time for batch, _, _ in read]
    return PeriodStars(
        total=sample.total,
        attitudes=_attitudes(sample, [answer for _, answer, _ in read]),
        trackers=tuple(_joined(each) for each in collected.values()),
        other_catalog=other_catalog,
        sun=np.array([sun_direction(each.time, each.position_km) for each, _, _ in read]),
        first=times[0] if times else None,
        last=times[-1] if times else None,
    )


def _boresight(
    tracker: Tracker, answer: Answer, presumed: PriorAttitude | None, mission: Mission
) -> Vector:
    """Inertial boresight direction of a tracker in a batch; NaN if not known."""
    if answer.attitude is not None:
        attitude = vectors.matrix_from_quaternion(answer.attitude.quaternion)
    elif presumed is None or not _knows(tracker, presumed, mission):
        return np.array(_UNKNOWN_DIRECTION)
    else:
        attitude = presumed.attitude
    return np.asarray(tracker.boresight_body @ attitude)


def _knows(tracker: Tracker, presumed: PriorAttitude, mission: Mission) -> bool:
    """True if a priori knowledge gives a tracker's boresight: known roll, or on the axis."""
    off_deg = vectors.angle_between_deg(tracker.boresight_body, mission.axis_body)
    return presumed.roll_known or bool(off_deg <= ALIGNED_DEG)


def _region(
    tracker: Tracker, presumed: PriorAttitude | None, mission: Mission
) -> SearchRegion | None:
    is_cap = mission.zone.kind == "cap"
    if presumed is None or (is_cap and not _knows(tracker, presumed, mission)):
        return None
    return search_region(tracker, presumed, mission, "observations")


def _add(
    into: _Collected,
    batch: ObservationBatch,
    answer: Answer,
    seen: CorrectedObservations,
    stars: list[Star],
    run_catalog: RunCatalog,
    rows: dict[str, int],
) -> None:
    """Add the unique stars of one tracker in one batch to the collected arrays."""
    pairs = [(k, rows[each.star.id]) for k, each in enumerate(stars) if each.star is not None]
    if not pairs:
        return
    own, row = np.array(pairs).T
    turned = into.tracker.body_from_tracker
    direction = seen.direction_body[own] @ turned
    x, y, z = direction.T
    into.place_deg.append(np.degrees(np.stack([np.arctan2(x, z), np.arctan2(y, z)], axis=1)))
    into.observed_mag.append(seen.magnitude_mag[own])
    into.catalog_mag.append(run_catalog.magnitude_mag[row])
    residual, expected = np.full((2, len(own), 2), np.nan)
    if answer.attitude is not None:
        to_tracker = turned.T @ vectors.matrix_from_quaternion(answer.attitude.quaternion)
        natural = run_catalog.direction_at(batch.time)[row]
        predicted = apparent(natural, aberration_velocity(batch), batch.time) @ to_tracker.T
        covariance = turned.T @ np.array(answer.attitude.covariance_arcsec2) @ turned
        residual, expected = _residuals(direction, predicted, covariance, seen.sigma_arcsec[own])
        is_used = np.array([stars[k].residual_arcsec is not None for k in own.tolist()])
        residual[~is_used] = expected[~is_used] = np.nan
    into.residual_arcsec.append(residual)
    into.expected_arcsec.append(expected)


def _residuals(
    direction: Vector, predicted: Vector, covariance_arcsec2: Matrix, sigma_arcsec: Vector
) -> tuple[Vector, Vector]:
    """Residuals (n, 2) of stars along h and v in arcsec, and their standard deviations.

    All in tracker axes.  An attitude error e moves a direction d by e x d, that is along the
    tangent h by e . v and along v by -e . h.  The optimal attitude absorbs that much of the star's
    own noise, so that sigma^2 - v' P v remains along h.
    """
    along_h = vectors.unit(np.array([1.0, 0.0, 0.0]) - direction[:, :1] * direction)
    along_v = np.cross(direction, along_h)
    off = (direction - predicted) * vectors.ARCSEC_PER_RADIAN
    residual = np.stack([np.sum(off * along_h, axis=1), np.sum(off * along_v, axis=1)], axis=1)
    taken = np.stack(
        [
            np.einsum("ni,ij,nj->n", along, covariance_arcsec2, along)
            for along in (along_v, along_h)
        ],
        axis=1,
    )
    left = sigma_arcsec[:, None] ** 2 - taken
    is_free = left > (LEAST_EXPECTED * sigma_arcsec[:, None]) ** 2
    return residual, np.where(is_free, np.sqrt(np.where(is_free, left, 1.0)), np.nan)


def _attitudes(sample: PeriodSample, answers: list[Answer]) -> PeriodAttitudes:
    count = len(answers)
    quaternion, covariance = np.full((count, 4), np.nan), np.full((count, 3, 3), np.nan)
    for place, answer in enumerate(answers):
        if answer.attitude is not None:
            quaternion[place] = answer.attitude.quaternion
            covariance[place] = answer.attitude.covariance_arcsec2
    return PeriodAttitudes(
        time_ns=np.array([row["time_ns"] for row in sample.rows], dtype=np.int64),
        time=tuple(answer.time for answer in answers),
        status=tuple(
            "no_attitude" if answer.attitude is None else answer.attitude.status
            for answer in answers
        ),
        quaternion=quaternion,
        covariance_arcsec2=covariance,
        follows=sample.follows,
    )


def _joined(parts: _Collected) -> TrackerStarsOfPeriod:
    pairs, single = np.empty((0, 2)), np.empty(0)
    return TrackerStarsOfPeriod(
        tracker=parts.tracker.name,
        field_of_view_radius_deg=parts.tracker.field_of_view_radius_deg,
        sigma_arcsec=parts.tracker.sigma_arcsec,
        boresight=np.stack(parts.boresight),
        place_deg=np.concatenate([pairs, *parts.place_deg]),
        residual_arcsec=np.concatenate([pairs, *parts.residual_arcsec]),
        expected_arcsec=np.concatenate([pairs, *parts.expected_arcsec]),
        observed_mag=np.concatenate([single, *parts.observed_mag]),
        catalog_mag=np.concatenate([single, *parts.catalog_mag]),
        region=parts.region,
    )
