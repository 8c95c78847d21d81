"""The search for the stars of a batch about the a priori attitude, or in the whole sky."""

import math
from collections.abc import Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from service.acquire.result import PREDICTION_CONTRADICTED, WORK_BOUND_HIT, Path
from service.acquire.zone_search import Search, ZoneResult, ZoneSearch
from service.attitude.solution import DIFFERENT_CHI_SQUARE, AttitudeSolution, NoAttitude
from service.identify.attitude_from_matches import attitude_of
from service.identify.budget import WorkBudget
from service.identify.hypotheses.evidence import LOG_CLUTTER_SPAN, log_magnitudes
from service.identify.hypotheses.groups import Mask
from service.identify.hypotheses.verified import UNIQUE_PROBABILITY
from service.identify.identification import Identification, Outcome, nothing_known
from service.identify.lost_in_space.finder import FoundAttitude, find_attitude
from service.identify.lost_in_space.solver import FEWEST_POINTS
from service.identify.prior_attitude import PriorAttitude, prior_attitude
from service.observations.batch import PredictedPrior, QuaternionPrior
from service.observations.calibrate import CorrectedColumns, CorrectedObservations
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import apparent
from service.vectors import (
    ARCSEC_PER_RADIAN,
    Matrix,
    Vector,
    attitude_error_arcsec,
    quaternion_from_matrix,
    read_only,
)


class SearchResult(Struct, frozen=True, eq=False, gc=False):
    """The result for some stars of a batch: the search path, and the result in zones or a refusal.

    `explained` (n,) marks, for every tracker, the stars that the most likely hypothesis explains.
    """

    path: Path
    in_zones: ZoneResult | None
    refusal: NoAttitude | None
    warnings: list[str]
    explained: tuple[Mask, ...]

    @property
    def good(self) -> bool:
        """True if an attitude was found and its residuals are not suspect."""
        return self.in_zones is not None and self.in_zones.good

    @property
    def unique(self) -> list[Mask]:
        """Masks (n,) of the unique stars of each tracker; `in_zones` must not be None."""
        assert self.in_zones is not None
        return [each.unique for each in self.in_zones.identifications]

    @property
    def solution(self) -> AttitudeSolution:
        """The attitude solution; requires that there is one."""
        assert self.in_zones is not None
        assert isinstance(self.in_zones.solved, AttitudeSolution)
        return self.in_zones.solved


def find(
    search: Search, corrected: tuple[CorrectedObservations, ...], first: ZoneResult | None = None
) -> SearchResult:
    """Identify stars about the a priori attitude, or else in the whole sky.

    `first` is the result about the a priori attitude if it is known already.
    """
    prior, path = search.prior, Path.LOST_IN_SPACE
    in_zones = refusal = None
    warnings: list[str] = []
    explained: tuple[Mask, ...] | None = None
    if prior is not None and search.identifier.uses_prior:
        path, in_zones = Path.ZONE, first or find_about(search, corrected, prior)
        warnings += prior.warnings
        falls_back = _falls_back(search, corrected, in_zones)
        if contradicts(in_zones, prior):
            # The named stars are as wrong as the attitude.
            in_zones, refusal = None, NoAttitude.FEWER_THAN_THREE_STARS
            falls_back = _whole_sky_can_tell(corrected)
            explained = tuple(np.zeros(len(each.sigma_rad), bool) for each in corrected)
            warnings.append(PREDICTION_CONTRADICTED)
        if falls_back:
            path = Path.ZONE_THEN_LOST_IN_SPACE
        elif in_zones is not None and prior.predicted is not None:
            in_zones = _with_lone_stars(search, corrected, in_zones, prior.predicted)
    if path is not Path.ZONE:
        search.sky.require_whole_sky()
        found = find_attitude(
            corrected,
            search.velocity_c,
            search.run_catalog,
            search.mission,
            search.sky,
            search.budget,
        )
        search.timer.end("identify")
        refusal, explained = found.refusal, found.explained
        if found.attitude is not None:
            again = find_about(
                search, found.corrected, _presumed(search, found.attitude), search.budget
            )
            warnings_found = found.warnings
            if not isinstance(again.solved, AttitudeSolution):
                again = _with_found_stars(search, found, again)
                kept = (
                    "zone_without_attitude: none was found in the zone about that of the whole "
                    "sky, which is kept with its own stars"
                )
                warnings_found = (*found.warnings, kept)
            # The zone's result stands unless the whole sky gives a better one.
            if in_zones is None or again.good:
                in_zones = again
                contradicted = [each for each in warnings if each == PREDICTION_CONTRADICTED]
                warnings = [*again.prior.warnings, *contradicted, *warnings_found]
        elif in_zones is not None:
            warnings.append(f"lost_in_space_refused: {refusal}")
        if found.bounded:
            warnings.append(f"{WORK_BOUND_HIT}: the search in the whole sky ended at its bound")
    if in_zones is not None:
        explained = tuple(each.explained for each in in_zones.identifications)
    assert explained is not None
    return SearchResult(path, in_zones, refusal, warnings, explained)


def _presumed(search: Search, attitude: Matrix) -> PriorAttitude:
    """A whole-sky attitude in the form of a presumed one, for a search of zones about it."""
    prior = QuaternionPrior(read_only(quaternion_from_matrix(attitude)))
    if search.prior is not None and search.prior.predicted is not None:
        # The tests of the batch are those of a cap.
        prior = replace(search.prior.predicted, quaternion=prior.quaternion)
    return prior_attitude(prior, search.batch.time, search.mission, search.batch.position_km)


def _with_found_stars(search: Search, found: FoundAttitude, in_zones: ZoneResult) -> ZoneResult:
    """A result in zones with its identifications replaced by those of the whole sky."""
    identifications = [
        replace(
            nothing_known(len(star)),
            outcome=np.where(star >= 0, int(Outcome.UNIQUE), int(Outcome.UNMATCHED)),
            star=star,
            probability=np.where(star >= 0, found.probability, np.nan),
        )
        for star in found.star
    ]
    solved = _solve(search, found.corrected, identifications)
    search.timer.end("solve")
    return ZoneResult(in_zones.prior, in_zones.places, identifications, solved)


def _with_lone_stars(
    search: Search,
    corrected: Sequence[CorrectedObservations],
    in_zones: ZoneResult,
    predicted: PredictedPrior,
) -> ZoneResult:
    """Complete a result in zones without an attitude by stars that the prediction identifies."""
    if isinstance(in_zones.solved, AttitudeSolution):
        return in_zones
    identifications = identify_lone_stars(
        corrected,
        in_zones.identifications,
        in_zones.prior.attitude,
        predicted.covariance_arcsec2,
        search.run_catalog,
        apparent(search.catalog_direction, search.velocity_c, search.batch.time),
    )
    solved = _solve(search, corrected, identifications)
    search.timer.end("identify")
    found = replace(in_zones, identifications=identifications, solved=solved)
    return in_zones if contradicts(found, in_zones.prior) else found


def find_about(
    search: Search,
    corrected: Sequence[CorrectedObservations],
    prior: PriorAttitude,
    budget: WorkBudget | None = None,
) -> ZoneResult:
    """Identify stars in the zones about a presumed attitude, and solve for the attitude."""
    zones = ZoneSearch(CorrectedColumns.of(corrected))
    zones.add(0, search, prior, budget)
    zones.run(search.timer)
    for error in zones.errors.values():
        raise error
    return zones.result(0)


def _solve(
    search: Search,
    corrected: Sequence[CorrectedObservations],
    identifications: Sequence[Identification],
) -> AttitudeSolution | NoAttitude:
    stars = CorrectedColumns.of(corrected)
    return attitude_of(
        stars.direction_body,
        stars.sigma_rad,
        np.concatenate([each.star for each in identifications]),
        np.repeat(np.arange(len(corrected)), np.diff(stars.star_offsets)),
        tuple(each.tracker.name for each in corrected),
        search.catalog_direction,
        search.velocity_c,
        search.sun_au,
        search.choices.solver,
    )


def _falls_back(
    search: Search, corrected: Sequence[CorrectedObservations], in_zones: ZoneResult
) -> bool:
    """True if the result about the a priori attitude is so poor that the whole sky is searched.

    A prediction may fail at any time, which leaves its batch without prior knowledge.
    """
    identifier = search.identifier
    is_allowed = identifier.falls_back and search.mission.lost_in_space_fallback
    if in_zones.prior.predicted is not None:
        is_allowed = identifier.searches_zone
    return not in_zones.good and is_allowed and _whole_sky_can_tell(corrected)


def contradicts(in_zones: ZoneResult, prior: PriorAttitude) -> bool:
    """True if the attitude found about a prediction contradicts the prediction."""
    predicted, solved = prior.predicted, in_zones.solved
    if predicted is None or not isinstance(solved, AttitudeSolution):
        return False
    apart_arcsec = attitude_error_arcsec(solved.matrix, prior.attitude)
    covariance_arcsec2 = predicted.covariance_arcsec2 + solved.covariance_arcsec2
    weighted = float(apart_arcsec @ np.linalg.solve(covariance_arcsec2, apart_arcsec))
    return weighted > DIFFERENT_CHI_SQUARE


def _whole_sky_can_tell(corrected: Sequence[CorrectedObservations]) -> bool:
    return any(len(each.magnitude_mag) >= FEWEST_POINTS for each in corrected)


# Identification of single stars by a predicted attitude, for batches too poor for an attitude. One
# star has no pair to distinguish it. With an accurate prediction its place and magnitude do: a
# catalog star is weighed against chance, which is a point that is no star, or a failed prediction.

CLUTTER = 0.1
"""Probability that a point is no catalog star, equal to the prior mean in `hypotheses.evidence`."""
FAILED = 0.01
"""Probability that a prediction has failed, as at a flip that the mission does not declare."""
GATE = 30.0
"""Chi-square (two degrees of freedom) beyond which catalog stars have no weight."""


def identify_lone_stars(
    corrected: Sequence[CorrectedObservations],
    identifications: Sequence[Identification],
    attitude: Matrix,
    covariance_arcsec2: Matrix,
    run_catalog: RunCatalog,
    inertial: Vector,
) -> list[Identification]:
    """Identifications completed by stars that a predicted attitude identifies, unless two are one.

    `attitude` (3, 3), inertial to body, is the predicted one with its covariance about the body
    axes; `inertial` (N, 3) are the apparent directions of the run catalog's stars. A star is unique
    from the same probability as under `verified`.
    """
    found = [
        _of_tracker(each, identified, attitude, covariance_arcsec2, run_catalog, inertial)
        for each, identified in zip(corrected, identifications, strict=True)
    ]
    rows = [int(row) for each in found for row in each.star if row >= 0]
    # Two detections of one star cannot be told apart.
    return found if len(set(rows)) == len(rows) else list(identifications)


def _of_tracker(
    corrected: CorrectedObservations,
    identified: Identification,
    attitude: Matrix,
    covariance_arcsec2: Matrix,
    run_catalog: RunCatalog,
    inertial: Vector,
) -> Identification:
    outcome, star = identified.outcome.copy(), identified.star.copy()
    probability = identified.probability.copy()
    hypothesis = None if identified.hypothesis is None else identified.hypothesis.copy()
    radius_rad = math.radians(corrected.tracker.field_of_view_radius_deg)
    view_sr = 2.0 * math.pi * (1.0 - math.cos(radius_rad))
    chance = CLUTTER / view_sr + FAILED * len(run_catalog) / (4.0 * math.pi)
    predicted = inertial @ attitude.T
    for k in np.flatnonzero(~identified.unique).tolist():
        row, likely = _likeliest(
            corrected.direction_body[k],
            float(corrected.sigma_rad[k]),
            float(corrected.magnitude_mag[k]),
            predicted,
            covariance_arcsec2 / ARCSEC_PER_RADIAN**2,
            run_catalog.magnitude_mag,
            chance,
        )
        if likely >= UNIQUE_PROBABILITY:
            outcome[k], star[k], probability[k] = int(Outcome.UNIQUE), row, likely
            if hypothesis is not None:
                hypothesis[k] = row
    rivals = tuple(
        () if is_unique else each
        for is_unique, each in zip(star >= 0, identified.rivals, strict=True)
    )
    likely_rivals = identified.rival_probability
    if likely_rivals:
        likely_rivals = tuple(
            () if is_unique else each
            for is_unique, each in zip(star >= 0, likely_rivals, strict=True)
        )
    return replace(
        identified,
        outcome=outcome,
        star=star,
        probability=probability,
        hypothesis=hypothesis,
        rivals=rivals,
        rival_probability=likely_rivals,
    )


def _likeliest(
    seen: Vector,
    sigma_rad: float,
    magnitude_mag: float,
    predicted: Vector,
    covariance_rad2: Matrix,
    catalog_mag: Vector,
    chance: float,
) -> tuple[int, float]:
    """The most likely catalog star at a point in body axes, and its probability; else -1 and 0.

    `chance` is the density of false points per steradian.
    """
    first = np.cross(seen, np.eye(3)[int(np.argmin(np.abs(seen)))])
    first /= np.linalg.norm(first)
    across = np.stack([first, np.cross(seen, first)])
    # A rotation about one of the two perpendicular axes moves the point along the other.
    turned = np.stack([across[1], -across[0]])
    covariance = turned @ covariance_rad2 @ turned.T + sigma_rad**2 * np.eye(2)
    off = (predicted - seen) @ across.T
    squares = np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance), off)
    near = np.flatnonzero((squares < GATE) & (predicted @ seen > 0.0))
    if not len(near):
        return -1, 0.0
    log_peak = -math.log(2.0 * math.pi) - 0.5 * math.log(float(np.linalg.det(covariance)))
    weights = log_peak - 0.5 * squares[near]
    log_chance = math.log(chance)
    if not math.isnan(magnitude_mag):
        apart = magnitude_mag - catalog_mag[near]
        weights += [log_magnitudes.py_func(1, each, each * each) for each in apart.tolist()]
        log_chance -= LOG_CLUTTER_SPAN
    weights = np.exp(weights + math.log((1.0 - CLUTTER) * (1.0 - FAILED)) - log_chance)
    best = int(np.argmax(weights))
    return int(near[best]), float(weights[best] / (1.0 + weights.sum()))
