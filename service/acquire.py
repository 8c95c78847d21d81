"""THE STAIRCASE: batch, corrected, identified, solved.

One way down for every door: single posts, bulk, replay, simulator and what-if.
Pure: an answer depends on the batch, the mission and the catalog alone.  Not
finding a star is a result; only bad input raises.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter_ns as clock_ns

import numpy as np

from service import __version__
from service.attitude.solution import AttitudeSolution, NoAttitude
from service.attitude.solve import solve_attitude
from service.identify.identification import Identification, Outcome
from service.identify.matched import matched_vectors
from service.identify.presumed import Presumed, aim_of, presumed_attitude
from service.identify.starid import Sighting, identify_by_votes
from service.identify.verify import identify_verified
from service.missions.mission import Band, Identifier, Mission, Solver, Tests, Tolerances
from service.observe.batch import (
    BoresightPrior,
    ObservationBatch,
)
from service.observe.correct import CorrectedObservations, correct
from service.sky.ephemeris import observer_velocity, sun_distance_au
from service.sky.run_catalog import RunCatalog
from service.sky.view import Sky
from service.sky.zones import Aim, Zone, counts_within
from service.vectors import (
    ARCSEC_PER_RADIAN,
    Matrix,
    Vector,
    matrix_from_quaternion,
    separation_deg,
)

IDENTIFIERS: Mapping[Identifier, Callable[[Sighting], Identification]] = {
    "starid": identify_by_votes,
    "verified": identify_verified,
}


@dataclass(frozen=True)
class Choices:
    """What holds for one batch: its mission's settings with its own options in their place."""

    identifier: Identifier
    solver: Solver
    tolerances: Tolerances
    tests: Tests
    zone_grid_deg: float


@dataclass(frozen=True)
class TrackerResult:
    """One tracker's part: where its stars were looked for, and what was found.

    `stars` and `pairs` are those within the aim, the paper's NCAP and NTOT;
    `zone`, from the shelf, may hold more.  `residual_arcsec` is NaN for stars
    that are not unique and where there is no attitude.
    """

    corrected: CorrectedObservations
    aim: Aim
    zone: Zone
    zone_cached: bool
    stars: int
    pairs: int
    identification: Identification
    residual_arcsec: Vector


@dataclass(frozen=True)
class Provenance:
    """What an answer was made of."""

    catalog: str
    run_catalog: str
    epoch_year: float
    mission: str
    version: str


@dataclass(frozen=True)
class Acquisition:
    """Everything that came of one batch.

    `solution` is None where `reason` says why; never an older attitude.
    """

    batch: ObservationBatch
    mission: Mission
    choices: Choices
    run_catalog: RunCatalog
    trackers: tuple[TrackerResult, ...]
    solution: AttitudeSolution | None
    reason: NoAttitude | None
    warnings: tuple[str, ...]
    timings_us: Mapping[str, int]
    provenance: Provenance

    @property
    def counts(self) -> dict[str, int]:
        """Stars observed, and of them unique, ambiguous and unmatched."""
        found = Counter(int(o) for each in self.trackers for o in each.identification.outcome)
        counts = {"observed": sum(found.values())}
        for outcome in (Outcome.UNIQUE, Outcome.AMBIGUOUS, Outcome.UNMATCHED):
            counts[outcome.word] = found[int(outcome)]
        return counts


def acquire(batch: ObservationBatch, mission: Mission, sky: Sky) -> Acquisition:
    """Identify a batch's stars and solve for the attitude.

    Raises `BadInput` for what does not fit the mission: a tracker it has not,
    a kind of a priori knowledge that its zone cannot use.
    """
    choices = choices_of(batch, mission)
    corrected = correct(batch, mission)
    presumed = presumed_attitude(batch.a_priori, batch.time, mission, batch.position_km)
    # At rest, directions stay geometric.
    velocity_c = np.zeros(3)
    if batch.aberration == "to_correct":
        velocity_c = observer_velocity(batch.time, batch.velocity_km_per_s)
    seen = [_seen(each, presumed, velocity_c) for each in corrected]
    sun_au = sun_distance_au(batch.time)

    clock = [clock_ns()]
    run_catalog = sky.run_catalog(mission, batch.time)
    places = [
        _place(each, index, presumed, mission, choices, run_catalog, sky)
        for index, each in enumerate(corrected)
    ]
    sightings = [
        Sighting(*each, aim, zone, choices.tolerances, choices.tests)
        for each, (aim, zone, _) in zip(seen, places, strict=True)
    ]
    clock.append(clock_ns())
    identify = IDENTIFIERS[choices.identifier]
    identifications = [identify(sighting) for sighting in sightings]
    clock.append(clock_ns())
    solved = _solve(choices, corrected, sightings, identifications, run_catalog, sun_au)
    clock.append(clock_ns())

    solution = solved if isinstance(solved, AttitudeSolution) else None
    trackers = tuple(
        TrackerResult(each, aim, zone, cached, *counts_within(zone, aim), identification, residual)
        for each, (aim, zone, cached), identification, residual in zip(
            corrected, places, identifications, _residuals(identifications, solution), strict=True
        )
    )
    steps = (round((end - start) / 1000) for start, end in pairwise(clock))
    return Acquisition(
        batch=batch,
        mission=mission,
        choices=choices,
        run_catalog=run_catalog,
        trackers=trackers,
        solution=solution,
        reason=solved if isinstance(solved, NoAttitude) else None,
        warnings=(*presumed.warnings, *_warnings(batch, mission, trackers, presumed, solution)),
        timings_us=dict(zip(("zone", "identify", "solve"), steps, strict=True)),
        provenance=Provenance(
            sky.catalog.digest,
            run_catalog.digest,
            run_catalog.epoch_year,
            mission.digest,
            __version__,
        ),
    )


def choices_of(batch: ObservationBatch, mission: Mission) -> Choices:
    """The settings that hold for a batch.

    A test that cannot be made is off: that of the pole in a cap, and what
    compares with the presumed roll where an a priori boresight leaves it open.
    """
    options = batch.options
    tests = {**options.tests, **dict.fromkeys(_impossible_tests(batch, mission), False)}
    grid_deg = options.zone_grid_deg
    return Choices(
        identifier=options.identifier or mission.identifier,
        solver=options.solver or mission.solver,
        tolerances=mission.tolerances.model_copy(update=options.tolerances),
        tests=mission.tests.model_copy(update=tests),
        zone_grid_deg=mission.zone.grid_deg if grid_deg is None else grid_deg,
    )


def _impossible_tests(batch: ObservationBatch, mission: Mission) -> tuple[str, ...]:
    pole = () if isinstance(mission.zone, Band) else ("pole",)
    roll = ("cross_product", "fov_rotation") if isinstance(batch.a_priori, BoresightPrior) else ()
    return pole + roll


def _place(
    corrected: CorrectedObservations,
    index: int,
    presumed: Presumed,
    mission: Mission,
    choices: Choices,
    run_catalog: RunCatalog,
    sky: Sky,
) -> tuple[Aim, Zone, bool]:
    aim = aim_of(corrected.tracker, presumed, mission, f"observations.{index}.tracker")
    zone, cached = sky.zone(
        mission,
        run_catalog,
        aim,
        choices.tolerances.pair_separation_max_deg,
        choices.zone_grid_deg,
    )
    return aim, zone, cached


def _seen(
    corrected: CorrectedObservations, presumed: Presumed, velocity_c: Vector
) -> tuple[Vector, Vector, Vector, Vector | None, Vector, Vector]:
    """What a sighting holds of the observation: the first fields of `Sighting`, in order."""
    return (
        np.dot(corrected.direction_body, presumed.attitude),
        corrected.magnitude_mag,
        corrected.sigma_arcsec / ARCSEC_PER_RADIAN,
        presumed.known_axis,
        velocity_c,
        corrected.tracker.body_from_tracker[:, 2] @ presumed.attitude,
    )


def _solve(
    choices: Choices,
    corrected: Sequence[CorrectedObservations],
    sightings: Sequence[Sighting],
    identifications: Sequence[Identification],
    run_catalog: RunCatalog,
    sun_au: float,
) -> AttitudeSolution | NoAttitude:
    parts = [
        matched_vectors(
            each.direction_body,
            sighting.sigma_rad,
            identification.star,
            run_catalog.direction,
            sighting.velocity_c,
            sun_au,
        )
        for each, sighting, identification in zip(
            corrected, sightings, identifications, strict=True
        )
    ]
    observed, reference, sigma_rad = (
        parts[0] if len(parts) == 1 else (np.concatenate(each) for each in zip(*parts, strict=True))
    )
    return solve_attitude(
        observed,
        reference,
        sigma_rad,
        np.repeat(np.arange(len(parts)), [len(part[2]) for part in parts]),
        tuple(each.tracker.name for each in corrected),
        choices.solver,
    )


def _residuals(
    identifications: list[Identification], solution: AttitudeSolution | None
) -> list[Vector]:
    """The solution's residuals spread over the stars of each tracker, NaN where there is none."""
    residuals = [np.full(len(each.outcome), np.nan) for each in identifications]
    if solution is not None:
        taken = 0
        for residual, identification in zip(residuals, identifications, strict=True):
            mask = identification.unique
            used = int(mask.sum())
            residual[mask] = solution.residual_arcsec[taken : taken + used]
            taken += used
    return residuals


def _warnings(
    batch: ObservationBatch,
    mission: Mission,
    trackers: tuple[TrackerResult, ...],
    presumed: Presumed,
    solution: AttitudeSolution | None,
) -> list[str]:
    warnings = [
        f"test_off: {name} was asked for and cannot be made of this a priori knowledge"
        for name in _impossible_tests(batch, mission)
        if batch.options.tests.get(name)
    ]
    if batch.aberration == "to_correct" and batch.velocity_km_per_s is None:
        warnings.append(
            "velocity_of_earth_alone: no velocity_km_per_s was given; "
            "aberration was corrected for Earth's motion only"
        )
    attitude = (
        presumed.attitude if solution is None else matrix_from_quaternion(solution.quaternion)
    )
    if solution is not None:
        warnings += _doubts(solution, attitude, mission, presumed)
    for each in trackers:
        tracker = each.corrected.tracker
        boresight = attitude.T @ tracker.body_from_tracker[:, 2]
        if each.aim.reaches_past(boresight, tracker.field_of_view_radius_deg):
            warnings.append(
                f"field_of_view_past_zone_edge: the field of view of {tracker.name} reaches past "
                "the edge of its zone; stars beyond it cannot be identified"
            )
        if each.identification.bounded:
            warnings.append(
                f"work_bound_hit: the search for the stars of {tracker.name} ended at its bound"
            )
        stars = each.identification.star[each.identification.unique]
        if len(set(stars.tolist())) < len(stars):
            warnings.append(f"same_star_twice: two stars of {tracker.name} have one identity")
    return warnings


def _doubts(
    solution: AttitudeSolution, attitude: Matrix, mission: Mission, presumed: Presumed
) -> list[str]:
    """What speaks against an attitude: its own residuals, and the a priori knowledge."""
    doubts = []
    if solution.suspect:
        doubts.append(
            f"attitude_suspect: residuals of {solution.residual_rms_arcsec:.1f} arcsec rms "
            f"where {solution.predicted_rms_arcsec:.1f} are expected: a star is misidentified "
            "or noisier than its sigma"
        )
    zone = mission.zone
    allowed_deg = zone.half_width_deg if isinstance(zone, Band) else zone.radius_deg
    axis = mission.axis_body
    off_deg = separation_deg(attitude.T @ axis, presumed.attitude.T @ axis)
    if off_deg > allowed_deg:
        doubts.append(
            f"attitude_off_a_priori: its {'pole' if isinstance(zone, Band) else 'boresight'} lies "
            f"{off_deg:.1f} deg from where the a priori knowledge has it"
        )
    return doubts
