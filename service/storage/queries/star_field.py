"""Star charts of a batch in the field of view of each tracker, and its trackers compared.

Nothing is identified here: the outcomes are those of the shown answer, so that the chart of an old
result shows that result.  Directions are given as `h_deg`, `v_deg`: that of (tan h, tan v, 1) in
the tracker's axes.
"""

import math

import numpy as np
from msgspec import Struct

from service import vectors
from service.acquire.choices import aberration_velocity
from service.contract.answers import Answer, Star, TrackerStars
from service.errors import BadBatch, Fault
from service.identify.prior_attitude import PriorAttitude, prior_attitude, search_region
from service.missions.mission import Mission, Tracker
from service.observations.batch import ObservationBatch, QuaternionPrior
from service.observations.calibrate import CorrectedObservations, correct
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import apparent
from service.sky.model import SkyModel
from service.sky.zones import SearchRegion
from service.storage.recording.result_metrics import catalog_rows, tracker_rows
from service.storage.sql.columns import Row
from service.trends.measures import BatchStars
from service.vectors import Matrix, Vector, read_only

MARGIN = 1.25
"""Radius of a star chart, as a multiple of the radius of the field of view."""
WIDEST_DEG = 15.0
"""Largest radius of a star chart in degrees, unless its field of view needs a larger one."""
EDGE_STEP_DEG = 0.5


class Boresight(Struct, frozen=True, kw_only=True):
    """Direction of a tracker's boresight in the inertial frame."""

    ra_deg: float
    dec_deg: float


class CatalogStarPlace(Struct, frozen=True, kw_only=True):
    """Position of a catalog star in a star chart."""

    id: str
    magnitude: float
    h_deg: float
    v_deg: float


class ObservedStarPlace(Struct, frozen=True, kw_only=True):
    """Position of an observed star in a star chart, with its outcome and residual.

    The residual is observed minus predicted along h and along v, None if the attitude does not use
    the star.
    """

    outcome: str
    star: str | None
    rivals: list[str]
    magnitude: float | None
    h_deg: float
    v_deg: float
    residual_arcsec: tuple[float, float] | None


class TrackerField(Struct, frozen=True, kw_only=True):
    """Star chart of one tracker; `zone_edges` are lines of [h, v] in degrees."""

    tracker: str
    boresight: Boresight
    field_of_view_radius_deg: float
    radius_deg: float
    magnitude_limit_mag: float
    zone_edges: list[list[list[float]]]
    catalog: list[CatalogStarPlace]
    observed: list[ObservedStarPlace]


class StarField(Struct, frozen=True, kw_only=True):
    """Star charts of all trackers of a batch.

    `through` is "quest", "triad" or "a_priori": the attitude by which catalog stars are drawn.
    `same_catalog` is True if the run catalog is the one of the answer.
    """

    through: str
    same_catalog: bool
    trackers: list[TrackerField]


def star_field_of(
    batch: ObservationBatch, mission: Mission, sky: SkyModel, answer: Answer
) -> StarField:
    """Build the star charts of a batch's trackers, with the identifications of an answer.

    The answer's attitude transforms catalog stars into the tracker's axes.  Without one the a
    priori attitude does, and the stars are displaced by its error.  Raises `BadInput` for a batch
    that does not fit the mission.
    """
    solved = answer.attitude
    presumed = presumed_attitude(batch, answer, mission)
    if presumed is None:
        message = "nothing is known of the attitude, neither beforehand nor from the stars"
        raise BadBatch(Fault("a_priori", message, "null"))
    attitude = (
        presumed.attitude if solved is None else vectors.matrix_from_quaternion(solved.quaternion)
    )
    run_catalog = sky.run_catalog(mission, batch.time)
    rows = {name: row for row, name in enumerate(run_catalog.star_id)}
    trackers = zip(correct(batch, mission), answer.observations, strict=True)
    return StarField(
        through="a_priori" if solved is None else solved.method,
        same_catalog=run_catalog.digest == answer.provenance.run_catalog,
        trackers=[
            _tracker(each, index, found, attitude, presumed, batch, mission, run_catalog, rows)
            for index, (each, found) in enumerate(trackers)
        ],
    )


def presumed_attitude(
    batch: ObservationBatch, answer: Answer, mission: Mission
) -> PriorAttitude | None:
    """Attitude about which stars were searched, or the one found in the whole sky; else None."""
    prior = batch.a_priori
    if answer.attitude is not None and answer.path != "zone":
        # The whole sky was searched, and gave the attitude.
        prior = QuaternionPrior(read_only(np.array(answer.attitude.quaternion)))
    return None if prior is None else prior_attitude(prior, batch.time, mission, batch.position_km)


def _tracker(
    corrected: CorrectedObservations,
    index: int,
    found: TrackerStars,
    attitude: Matrix,
    presumed: PriorAttitude,
    batch: ObservationBatch,
    mission: Mission,
    run_catalog: RunCatalog,
    rows: dict[str, int],
) -> TrackerField:
    tracker = corrected.tracker
    region = search_region(tracker, presumed, mission, f"observations.{index}.tracker")
    to_tracker = tracker.body_from_tracker.T @ attitude
    named = {name: rows[name] for star in found.stars for name in _names(star) if name in rows}
    seen = corrected.direction_body @ tracker.body_from_tracker
    radius_deg = _radius_deg(tracker, seen, run_catalog.direction[list(named.values())], to_tracker)
    near = _near(run_catalog, region, to_tracker[2], radius_deg)
    shown = np.union1d(near, np.array(list(named.values()), np.int64))
    natural = run_catalog.direction_at(batch.time)[shown]
    seen_at = apparent(natural, aberration_velocity(batch), batch.time) @ to_tracker.T
    place_of = dict(zip(shown.tolist(), seen_at, strict=True))
    ra_deg, dec_deg = vectors.to_ra_dec(to_tracker[2])
    return TrackerField(
        tracker=tracker.name,
        boresight=Boresight(ra_deg=float(ra_deg), dec_deg=float(dec_deg)),
        field_of_view_radius_deg=tracker.field_of_view_radius_deg,
        radius_deg=radius_deg,
        magnitude_limit_mag=mission.catalog.magnitude_limit_mag,
        zone_edges=_zone_edges(region, to_tracker, radius_deg),
        catalog=[
            CatalogStarPlace(
                id=run_catalog.star_id[row],
                magnitude=float(run_catalog.magnitude_mag[row]),
                **_angles(direction),
            )
            for row, direction in place_of.items()
            if direction[2] > 0
        ],
        observed=[
            ObservedStarPlace(
                outcome=star.outcome,
                star=None if star.star is None else star.star.id,
                rivals=list(star.rivals or []),
                magnitude=_number(corrected.magnitude_mag[k]),
                residual_arcsec=_residual(seen[k], star, rows, place_of),
                **_angles(seen[k]),
            )
            for k, star in enumerate(found.stars)
        ],
    )


def _names(star: Star) -> list[str]:
    return [*(star.rivals or []), *([star.star.id] if star.star else [])]


def _radius_deg(tracker: Tracker, seen: Vector, named: Vector, to_tracker: Matrix) -> float:
    """Radius of a star chart in degrees: all stars of the answer, within the largest extent."""
    boresight = np.array([0.0, 0.0, 1.0])
    spoken_of = np.concatenate([seen, named @ to_tracker.T])
    farthest = float(np.max(vectors.angle_between_deg(spoken_of, boresight), initial=0.0))
    wide = tracker.field_of_view_radius_deg * MARGIN
    return max(wide, min(farthest * 1.05, WIDEST_DEG))


def _near(
    run_catalog: RunCatalog, region: SearchRegion, boresight: Vector, radius_deg: float
) -> Vector:
    """Rows of the run catalog's zone stars that lie within a star chart, its corners included."""
    most = min(90.0, radius_deg * math.sqrt(2.0))
    near = np.flatnonzero(run_catalog.direction @ boresight >= math.cos(math.radians(most)))
    angle = vectors.angle_between_deg(run_catalog.direction[near], region.axis)
    return np.asarray(near[(angle >= region.least_deg) & (angle <= region.most_deg)])


def _zone_edges(
    region: SearchRegion, to_tracker: Matrix, radius_deg: float
) -> list[list[list[float]]]:
    """Boundaries of the search zone inside a star chart, as lines of [h, v] in degrees."""
    axis = to_tracker @ region.axis
    first = vectors.unit(np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))]))
    second = np.cross(axis, first)
    lines: list[list[list[float]]] = []
    for bound_deg in (region.least_deg, region.most_deg):
        if not 0.0 < bound_deg < 180.0:
            continue
        sine, cosine = math.sin(math.radians(bound_deg)), math.cos(math.radians(bound_deg))
        turn = np.radians(np.arange(0.0, 360.0 + EDGE_STEP_DEG, EDGE_STEP_DEG))[:, None]
        edge = axis * cosine + sine * (first * np.cos(turn) + second * np.sin(turn))
        inside = edge[:, 2] > math.cos(math.radians(min(89.0, radius_deg * math.sqrt(2.0) + 1.0)))
        for part in np.split(np.arange(len(edge)), np.flatnonzero(np.diff(inside)) + 1):
            if inside[part[0]] and len(part) > 1:
                hv = np.degrees(np.arctan(edge[part, :2] / edge[part, 2:]))
                lines.append(np.round(hv, 4).tolist())
    return lines


def _residual(
    seen: Vector, star: Star, rows: dict[str, int], place_of: dict[int, Vector]
) -> tuple[float, float] | None:
    row = rows.get(star.star.id) if star.star else None
    if star.residual_arcsec is None or row is None:
        return None
    along_h = vectors.unit(np.array([1.0, 0.0, 0.0]) - seen[0] * seen)
    along_v = np.cross(seen, along_h)
    off = (seen - place_of[row]) * vectors.ARCSEC_PER_RADIAN
    return float(off @ along_h), float(off @ along_v)


def _angles(direction: Vector) -> dict[str, float]:
    x, y, z = direction.tolist()
    return {"h_deg": math.degrees(math.atan2(x, z)), "v_deg": math.degrees(math.atan2(y, z))}


def _number(value: float | Vector) -> float | None:
    return None if np.isnan(value) else float(value)


def tracker_comparison(
    batch: ObservationBatch, mission: Mission, sky: SkyModel, answer: Answer
) -> list[Row]:
    """Rows of `tracker_values` for each tracker of a batch, with the mission's sigma.

    Offsets from the catalog are unknown if the answer's run catalog no longer exists.
    """
    run_catalog = sky.run_catalog(mission, batch.time)
    place: dict[str, int] = {}
    if run_catalog.digest == answer.provenance.run_catalog:
        place = {id: row for row, id in enumerate(run_catalog.star_id)}
    corrected = correct(batch, mission)
    star = catalog_rows(answer, place)
    stars = BatchStars(batch, corrected, star, run_catalog, answer.attitude is not None)
    rows = tracker_rows(answer.id or "", answer, stars)
    return [
        row | {"sigma_arcsec": each.tracker.sigma_arcsec}
        for row, each in zip(rows, corrected, strict=True)
    ]
