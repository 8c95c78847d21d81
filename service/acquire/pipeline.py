"""The pipeline of one batch: calibrate, search for the stars, solve for the attitude.

Single posts, bulk, replays, the simulator and what-if all use it.  It is pure: an
answer depends on the batch, the mission and the catalog alone.  Not finding a
star is a result; only bad input raises.
"""

from service import __version__
from service.acquire.choices import Choices, aberration_velocity, choices_of
from service.acquire.measured import measured_solution
from service.acquire.result import (
    Acquisition,
    Path,
    Provenance,
    outcome_counts,
    tracker_results,
    unmatched_results,
)
from service.acquire.rivals import find_groups
from service.acquire.search import Search, StepTimer
from service.acquire.warnings import (
    WORK_BOUND_HIT,
    warning_of_rival,
    warnings_of_attitude,
    warnings_of_batch,
    warnings_of_trackers,
    warnings_of_tracking,
)
from service.attitude.solution import AttitudeSolution, NoAttitude
from service.errors import BadBatch, Fault, shown_value
from service.identify.budget import WorkBudget
from service.identify.prior_attitude import prior_attitude
from service.missions.mission import Mission
from service.observations.batch import ObservationBatch
from service.observations.calibrate import correct
from service.observations.scans.reduce import reduced
from service.sky.cache import NotAtHand
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import sun_distance_au
from service.sky.model import SkyModel

SHORT_WORK = 100_000
"""The most units of work of what is solved at once: seven milliseconds."""


def acquire_at_once(batch: ObservationBatch, mission: Mission, sky: SkyModel) -> Acquisition:
    """`acquire` for who must not wait; raises `NotAtHand` where it would take long.

    That is so where the whole sky is searched, a zone has to be built, or more work is counted
    than `SHORT_WORK`.  The answer is the same.
    """
    budget = WorkBudget(SHORT_WORK)
    acquisition = acquire(batch, mission, sky.at_hand(), budget)
    if budget.was_hit:
        raise NotAtHand
    return acquisition


def acquire(
    batch: ObservationBatch, mission: Mission, sky: SkyModel, budget: WorkBudget | None = None
) -> Acquisition:
    """Identify a batch's stars and solve for the attitude.

    Without a priori knowledge, or where it leads to nothing good, the whole sky
    gives the attitude to search about.  Raises `BadInput` for what does not fit
    the mission: a tracker that it has not, a kind of a priori knowledge that its
    zone cannot use.
    """
    if batch.tracking is not None and not batch.tracking.resolved:
        told = "last needs the record of a service, which predicts the attitude from it"
        raise BadBatch(Fault("a_priori.from", told, shown_value("last")))
    batch = reduced(batch, mission)
    choices = choices_of(batch, mission)
    if batch.measurement is not None:
        return _measured(
            batch, mission, choices, sky, measured_solution(batch.measurement, mission)
        )
    corrected = correct(batch, mission)
    given = batch.a_priori
    prior = None if given is None else prior_attitude(given, batch.time, mission, batch.position_km)
    velocity_c = aberration_velocity(batch)
    sun_au = sun_distance_au(batch.time)

    timer = StepTimer()
    run_catalog = sky.run_catalog(mission, batch.time)
    search = Search(
        *(batch, mission, choices, prior, velocity_c, sun_au, run_catalog, sky),
        *(timer, budget or WorkBudget()),
    )
    found, rival = find_groups(search, corrected)
    in_zones = found.in_zones

    solved = found.refusal if in_zones is None else in_zones.solved
    solution = solved if isinstance(solved, AttitudeSolution) else None
    warnings = found.warnings + warnings_of_batch(batch, mission)
    warnings += warnings_of_tracking(batch, mission, solution, prior, found.path is Path.ZONE)
    if in_zones is None:
        trackers = unmatched_results(corrected)
    else:
        trackers = tracker_results(corrected, in_zones.places, in_zones.identifications, solution)
        if solution is not None:
            warnings += warnings_of_attitude(solution, mission, prior)
        if rival is not None:
            warnings.append(warning_of_rival(rival))
        attitude = in_zones.prior.attitude if solution is None else solution.matrix
        warnings += warnings_of_trackers(trackers, attitude)
    if search.budget.was_hit and not any(each.startswith(WORK_BOUND_HIT) for each in warnings):
        warnings.append(f"{WORK_BOUND_HIT}: the search for a second group of stars was cut short")
    return Acquisition(
        batch=batch,
        mission=mission,
        choices=choices,
        prior=prior,
        path=found.path,
        run_catalog=run_catalog,
        trackers=trackers,
        counts=outcome_counts(trackers),
        solution=solution,
        rival=rival,
        reason=solved if isinstance(solved, NoAttitude) else None,
        warnings=tuple(warnings),
        timings_us=timer.us,
        provenance=_provenance(sky, run_catalog, mission),
    )


def _measured(
    batch: ObservationBatch,
    mission: Mission,
    choices: Choices,
    sky: SkyModel,
    solution: AttitudeSolution,
) -> Acquisition:
    """The acquisition of an attitude that a tracker measured itself."""
    run_catalog = sky.run_catalog(mission, batch.time)
    return Acquisition(
        batch=batch,
        mission=mission,
        choices=choices,
        prior=None,
        path=Path.MEASURED,
        run_catalog=run_catalog,
        trackers=(),
        counts=outcome_counts(()),
        solution=solution,
        rival=None,
        reason=None,
        warnings=(),
        timings_us=StepTimer().us,
        provenance=_provenance(sky, run_catalog, mission),
    )


def _provenance(sky: SkyModel, run_catalog: RunCatalog, mission: Mission) -> Provenance:
    return Provenance(
        sky.catalog.digest, run_catalog.digest, run_catalog.epoch_year, mission.digest, __version__
    )
