"""The search for the stars of a batch: about the a priori attitude, or in the whole sky."""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter_ns

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from service.acquire.choices import Choices
from service.acquire.lone_stars import identify_lone_stars
from service.acquire.result import Path
from service.acquire.warnings import PREDICTION_CONTRADICTED, WORK_BOUND_HIT
from service.attitude.solution import AttitudeSolution, NoAttitude
from service.identify.attitude_from_matches import attitude_of
from service.identify.budget import WorkBudget
from service.identify.hypotheses.groups import Mask
from service.identify.identification import Identification, Outcome, nothing_known
from service.identify.lost_in_space.finder import FoundAttitude, find_attitude
from service.identify.lost_in_space.solver import FEWEST_POINTS
from service.identify.prior_attitude import PriorAttitude, prior_attitude, search_region
from service.identify.sighting import Sighting
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import Mission
from service.observations.batch import ObservationBatch, PredictedPrior, QuaternionPrior
from service.observations.calibrate import CorrectedObservations
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import apparent
from service.sky.model import SkyModel
from service.sky.zones import SearchRegion, Zone
from service.vectors import (
    Matrix,
    Vector,
    attitude_error_arcsec,
    quaternion_from_matrix,
    read_only,
)

CONTRADICTED_CHI_SQUARE = 30.0
"""Of chi-square with three degrees of freedom: a right prediction passes it in 1e-6."""


class ZoneResult(Struct, frozen=True, eq=False, gc=False):
    """What was found in the zones about one presumed attitude.

    `places` are the region of each tracker, the zone that serves it, and whether
    that zone was cached.
    """

    prior: PriorAttitude
    places: list[tuple[SearchRegion, Zone, bool]]
    identifications: list[Identification]
    solved: AttitudeSolution | NoAttitude

    @property
    def good(self) -> bool:
        """Whether there is an attitude that its own residuals do not speak against."""
        return isinstance(self.solved, AttitudeSolution) and not self.solved.suspect


class SearchResult(Struct, frozen=True, eq=False, gc=False):
    """What was found for some stars of a batch: the path, the result in zones, or why none.

    `explained` (n,) of every tracker marks the stars of the likeliest hypothesis.
    """

    path: Path
    in_zones: ZoneResult | None
    refusal: NoAttitude | None
    warnings: list[str]
    explained: tuple[Mask, ...]

    @property
    def good(self) -> bool:
        """Whether there is an attitude that its own residuals do not speak against."""
        return self.in_zones is not None and self.in_zones.good

    @property
    def unique(self) -> list[Mask]:
        """The stars (n,) of every tracker that are unique; only where zones were searched."""
        assert self.in_zones is not None
        return [each.unique for each in self.in_zones.identifications]

    @property
    def solution(self) -> AttitudeSolution:
        """The attitude; only where there is one."""
        assert self.in_zones is not None
        assert isinstance(self.in_zones.solved, AttitudeSolution)
        return self.in_zones.solved


class StepTimer:
    """Time spent in each step, summed where a step is taken again."""

    def __init__(self) -> None:
        self.ns = dict.fromkeys(("zone", "identify", "solve"), 0)
        self._last = perf_counter_ns()

    def end(self, step: str) -> None:
        """Add the time since the last call to a step."""
        now = perf_counter_ns()
        self.ns[step] += now - self._last
        self._last = now

    @property
    def us(self) -> dict[str, int]:
        """Whole microseconds of each step."""
        return {step: ns // 1000 for step, ns in self.ns.items()}


@dataclass(frozen=True)
class Search:
    """Searches for the stars of one batch, all of them or a part."""

    batch: ObservationBatch
    mission: Mission
    choices: Choices
    prior: PriorAttitude | None
    velocity_c: Vector
    sun_au: float
    run_catalog: RunCatalog
    sky: SkyModel
    timer: StepTimer
    budget: WorkBudget

    def find(self, corrected: tuple[CorrectedObservations, ...]) -> SearchResult:
        """Identify these stars about the a priori attitude, else in the whole sky."""
        prior, path = self.prior, Path.LOST_IN_SPACE
        in_zones = refusal = None
        warnings: list[str] = []
        explained: tuple[Mask, ...] | None = None
        if prior is not None and IDENTIFIERS[self.choices.identifier].uses_prior:
            # The rest is for the whole sky, and for the stars that the answer leaves.
            budget = self.budget.share(3, 4)
            path, in_zones = Path.ZONE, self.find_about(corrected, prior, budget)
            warnings += prior.warnings
            falls_back = self._falls_back(corrected, in_zones)
            if contradicts(in_zones, prior):
                # The stars that were named stand or fall with the attitude.
                in_zones, refusal = None, NoAttitude.FEWER_THAN_THREE_STARS
                falls_back = _whole_sky_can_tell(corrected)
                explained = tuple(np.zeros(len(each.sigma_rad), bool) for each in corrected)
                warnings.append(PREDICTION_CONTRADICTED)
            if falls_back:
                path = Path.ZONE_THEN_LOST_IN_SPACE
            elif in_zones is not None and prior.predicted is not None:
                in_zones = self._with_lone_stars(corrected, in_zones, prior.predicted)
        if path is not Path.ZONE:
            self.sky.require_whole_sky()
            found = find_attitude(
                corrected,
                self.velocity_c,
                self.run_catalog,
                self.mission,
                self.sky,
                self.budget,
            )
            self.timer.end("identify")
            refusal, explained = found.refusal, found.explained
            if found.attitude is not None:
                again = self.find_about(
                    found.corrected, self._presumed(found.attitude), self.budget
                )
                warnings_found = found.warnings
                if not isinstance(again.solved, AttitudeSolution):
                    again = self._with_found_stars(found, again)
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

    def _presumed(self, attitude: Matrix) -> PriorAttitude:
        """The attitude that the whole sky gave, to search about as about the a priori one."""
        prior = QuaternionPrior(read_only(quaternion_from_matrix(attitude)))
        if self.prior is not None and self.prior.predicted is not None:
            # The tests of the batch are those of a cap.
            prior = replace(self.prior.predicted, quaternion=prior.quaternion)
        return prior_attitude(prior, self.batch.time, self.mission, self.batch.position_km)

    def _with_found_stars(self, found: FoundAttitude, in_zones: ZoneResult) -> ZoneResult:
        """The result in zones with the stars of the whole sky in place of those of the zones."""
        identifications = [
            replace(
                nothing_known(len(star)),
                outcome=np.where(star >= 0, int(Outcome.UNIQUE), int(Outcome.UNMATCHED)),
                star=star,
                probability=np.where(star >= 0, found.probability, np.nan),
            )
            for star in found.star
        ]
        solved = self._solve(found.corrected, identifications)
        self.timer.end("solve")
        return ZoneResult(in_zones.prior, in_zones.places, identifications, solved)

    def _with_lone_stars(
        self,
        corrected: Sequence[CorrectedObservations],
        in_zones: ZoneResult,
        predicted: PredictedPrior,
    ) -> ZoneResult:
        """The result in zones, with the stars that the prediction identifies if it is poor."""
        if isinstance(in_zones.solved, AttitudeSolution):
            return in_zones
        identifications = identify_lone_stars(
            corrected,
            in_zones.identifications,
            in_zones.prior.attitude,
            predicted.covariance_arcsec2,
            self.run_catalog,
            apparent(
                self.run_catalog.direction_at(self.batch.time), self.velocity_c, self.batch.time
            ),
        )
        solved = self._solve(corrected, identifications)
        self.timer.end("identify")
        found = replace(in_zones, identifications=identifications, solved=solved)
        return in_zones if contradicts(found, in_zones.prior) else found

    def find_about(
        self,
        corrected: Sequence[CorrectedObservations],
        prior: PriorAttitude,
        budget: WorkBudget,
    ) -> ZoneResult:
        """Identify stars in the zones about a presumed attitude, and solve for theirs.

        Every tracker may spend its equal part of what the trackers before it left.
        """
        places = [self._place(each, index, prior) for index, each in enumerate(corrected)]
        sightings = [
            self.sighting(each, prior, region, zone)
            for each, (region, zone, _) in zip(corrected, places, strict=True)
        ]
        trackers = len(sightings)
        self.timer.end("zone")
        identify = IDENTIFIERS[self.choices.identifier].identify
        identifications = [
            identify(replace(sighting, budget=budget.share(1, trackers - index)))
            for index, sighting in enumerate(sightings)
        ]
        self.timer.end("identify")
        solved = self._solve(corrected, identifications)
        self.timer.end("solve")
        return ZoneResult(prior, places, identifications, solved)

    def _place(
        self, corrected: CorrectedObservations, index: int, prior: PriorAttitude
    ) -> tuple[SearchRegion, Zone, bool]:
        region = search_region(
            corrected.tracker, prior, self.mission, f"observations.{index}.tracker"
        )
        zone, cached = self.sky.zone(
            self.mission,
            self.run_catalog,
            region,
            self.choices.tolerances.pair_separation_max_deg,
            self.choices.zone_grid_deg,
        )
        return region, zone, cached

    def sighting(
        self,
        corrected: CorrectedObservations,
        prior: PriorAttitude,
        region: SearchRegion,
        zone: Zone,
    ) -> Sighting:
        """What the identifier is given of one tracker."""
        guide = None
        if IDENTIFIERS[self.choices.identifier].needs_guide:
            self.sky.require_whole_sky()
            guide = self.sky.guide(self.run_catalog, corrected.tracker.field_of_view_radius_deg)
        return Sighting(
            np.dot(corrected.direction_body, prior.attitude),
            corrected.magnitude_mag,
            corrected.sigma_rad,
            # numba compiles anew for a read-only array, which the client's own is.
            None if prior.known_axis is None else prior.known_axis.copy(),
            self.velocity_c,
            # A cap is searched about the boresight itself.
            region.axis
            if region.kind == "cap"
            else np.dot(corrected.tracker.boresight_body, prior.attitude),
            region,
            zone,
            self.choices.rules,
            guide,
        )

    def _solve(
        self, corrected: Sequence[CorrectedObservations], identifications: Sequence[Identification]
    ) -> AttitudeSolution | NoAttitude:
        direction, sigma_rad = corrected[0].direction_body, corrected[0].sigma_rad
        star, tracker_of = identifications[0].star, None
        if len(corrected) > 1:
            direction = read_only(np.concatenate([each.direction_body for each in corrected]))
            sigma_rad = np.concatenate([each.sigma_rad for each in corrected])
            star = np.concatenate([each.star for each in identifications])
            counts = [len(each.sigma_rad) for each in corrected]
            tracker_of = np.repeat(np.arange(len(corrected)), counts)
        return attitude_of(
            direction,
            sigma_rad,
            star,
            tracker_of,
            tuple(each.tracker.name for each in corrected),
            self.run_catalog.direction_at(self.batch.time),
            self.velocity_c,
            self.sun_au,
            self.choices.solver,
        )

    def _falls_back(self, corrected: Sequence[CorrectedObservations], in_zones: ZoneResult) -> bool:
        """Whether the result about the a priori attitude is so poor that the sky is searched.

        A prediction may fail at any time: its batch is without other knowledge then.
        """
        identifier = IDENTIFIERS[self.choices.identifier]
        is_allowed = identifier.falls_back and self.mission.lost_in_space_fallback
        if in_zones.prior.predicted is not None:
            is_allowed = identifier.searches_zone
        return not in_zones.good and is_allowed and _whole_sky_can_tell(corrected)


def contradicts(in_zones: ZoneResult, prior: PriorAttitude) -> bool:
    """Whether an attitude that was found about a prediction cannot be the predicted one."""
    predicted, solved = prior.predicted, in_zones.solved
    if predicted is None or not isinstance(solved, AttitudeSolution):
        return False
    apart_arcsec = attitude_error_arcsec(solved.matrix, prior.attitude)
    covariance_arcsec2 = predicted.covariance_arcsec2 + solved.covariance_arcsec2
    weighted = float(apart_arcsec @ np.linalg.solve(covariance_arcsec2, apart_arcsec))
    return weighted > CONTRADICTED_CHI_SQUARE


def _whole_sky_can_tell(corrected: Sequence[CorrectedObservations]) -> bool:
    return any(len(each.magnitude_mag) >= FEWEST_POINTS for each in corrected)
