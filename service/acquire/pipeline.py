"""The pipeline for many batches at once: calibration, star identification, attitude.

Common steps are done for all batches together in compiled loops: directions in body axes
(`correct_columns`), then votes, hypotheses and attitudes in the zones about the a priori attitudes
(`ZoneSearch`). Other batches continue from there one by one (`find_groups`): those without a good
result in the zone or without prior knowledge, and those with unexplained stars that may have a
second attitude.

An answer depends only on the batch, the mission and the catalog, not on the other batches. Not
finding a star is a result; only bad input raises an error.
"""

import operator
from collections.abc import Sequence

from msgspec import Struct
from msgspec.structs import replace

from service import __version__
from service.acquire.choices import aberration_velocity, choices_of
from service.acquire.contradictions import doubts_of
from service.acquire.result import (
    WORK_BOUND_HIT,
    Acquisition,
    Path,
    Provenance,
    RivalAttitude,
    measured_solution,
    outcome_counts,
    tracker_results,
    unmatched_results,
    warning_of_rival,
    warnings_of_attitude,
    warnings_of_batch,
    warnings_of_trackers,
    warnings_of_tracking,
)
from service.acquire.rivals import find_groups
from service.acquire.search import SearchResult
from service.acquire.zone_search import Search, StepTimer, ZoneSearch, as_row_error
from service.attitude.solution import AttitudeSolution, NoAttitude
from service.errors import BadBatch, Fault, shown_value
from service.identify.budget import MAX_WORK, WorkBudget
from service.identify.prior_attitude import prior_attitude
from service.missions.mission import Mission, Tracker
from service.observations.batch import ObservationBatch
from service.observations.calibrate import (
    CorrectedColumns,
    CorrectedObservations,
    correct_columns,
    trackers_of,
)
from service.observations.columns import BatchColumns
from service.observations.scans.reduce import reduced
from service.sky.cache import NotAtHand
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import sun_distance_au
from service.sky.model import SkyModel

SHORT_WORK = 100_000
"""Work units allowed to a batch whose answer must not wait, about seven milliseconds."""


class ResultColumns(Struct, frozen=True, eq=False):
    """Results of n batches as columns with one row each; see `CorrectedColumns` and `ZoneSearch`.

    `searches` has the settings of each row, `stars` the stars in body axes, and `zones` the results
    about the a priori attitudes, also for rows that continued. `finished` has the acquisitions of
    those rows, or the errors that prevented them.
    """

    searches: dict[int, Search]
    stars: CorrectedColumns
    zones: ZoneSearch
    finished: dict[int, Acquisition | Exception]

    def acquisition(self, row: int) -> Acquisition:
        """The acquisition of the batch in a row; raises the error that prevented it."""
        acquired = self.acquisition_or_error(row)
        if isinstance(acquired, Exception):
            raise acquired
        return acquired

    def acquisition_or_error(self, row: int) -> Acquisition | Exception:
        """The acquisition of the batch in a row, or the error that prevented it."""
        if row in self.finished:
            return self.finished[row]
        in_zones = self.zones.result(row)
        found = SearchResult(Path.ZONE, in_zones, None, list(in_zones.prior.warnings), ())
        return _composed(self.searches[row], self.stars.of_batch(row), found, None)


def acquire(
    batch: ObservationBatch, mission: Mission, sky: SkyModel, *, at_once: bool = False
) -> Acquisition:
    """Identify the stars of one batch and solve for its attitude; see `acquire_many`.

    Without a priori knowledge, or if it gives no good result, a search of the whole sky gives the
    attitude to search about. Raises `BadInput` for data that do not fit the mission: an unknown
    tracker, or a kind of prior that its zone cannot use.
    """
    columns = acquire_many(BatchColumns.of([batch]), mission, sky, at_once=at_once)
    return columns.acquisition(0)


def acquired(
    batches: Sequence[ObservationBatch], mission: Mission, sky: SkyModel, *, at_once: bool = False
) -> list[Acquisition | Exception]:
    """The acquisition of each batch of one mission, or the error that prevents it."""
    columns = acquire_many(BatchColumns.of(batches), mission, sky, at_once=at_once)
    return [columns.acquisition_or_error(row) for row in range(len(batches))]


def acquire_many(
    batches: BatchColumns, mission: Mission, sky: SkyModel, *, at_once: bool = False
) -> ResultColumns:
    """Identify the stars of many batches of one mission, and solve for their attitudes.

    A faulty batch gets its error, the others their results. `at_once` is for callers that must not
    wait: a row gets `NotAtHand` if it needs the whole sky, a new zone, or more work than
    `SHORT_WORK`. The other answers are the same.
    """
    sky = sky.at_hand() if at_once else sky
    timer = StepTimer(len(batches.batches))
    several: list[ObservationBatch] = []
    trackers: list[Tracker | None] = []
    searches: dict[int, Search] = {}
    finished: dict[int, Acquisition | Exception] = {}
    for row, batch in enumerate(batches.batches):
        its_trackers: Sequence[Tracker | None] = [None] * len(batch.observations)
        try:
            if batch.tracking is not None and not batch.tracking.resolved:
                message = "last needs the record of a service, which predicts the attitude from it"
                raise BadBatch(Fault("a_priori.from", message, shown_value("last")))
            batch = reduced(batch, mission)
            if batch.measurement is not None:
                finished[row] = _measured(batch, mission, sky)
            else:
                its_trackers = trackers_of(batch, mission)
                budget = WorkBudget(SHORT_WORK if at_once else MAX_WORK)
                searches[row] = _search(batch, mission, sky, timer, budget)
        except Exception as error:
            # A failure of one batch is its result: the others continue.
            finished[row] = as_row_error(error)
        several.append(batch)
        trackers += its_trackers
    if not all(map(operator.is_, several, batches.batches)):
        # Readings of scanning trackers became angles.
        batches = BatchColumns.of(several)
    stars = correct_columns(batches, trackers)
    timer.begin()
    zones = ZoneSearch(stars)
    for row, search in searches.items():
        if search.prior is not None and search.identifier.uses_prior:
            try:
                zones.add(row, search, search.prior)
            except Exception as error:
                # As above, the others continue.
                finished[row] = as_row_error(error)
    zones.run(timer)
    finished |= zones.errors
    final = set(zones.final_rows())
    for row, search in searches.items():
        if row not in finished and row not in final:
            finished[row] = _continued(search, stars.of_batch(row), zones, row)
        if at_once and search.budget.was_hit and isinstance(finished.get(row), Acquisition | None):
            finished[row] = NotAtHand()
    return ResultColumns(searches, stars, zones, finished)


def _search(
    batch: ObservationBatch, mission: Mission, sky: SkyModel, timer: StepTimer, budget: WorkBudget
) -> Search:
    """The common input of all searches for one batch's stars: prior, catalog, settings, limits."""
    time, a_priori = batch.time, batch.a_priori
    return Search(
        batch=batch,
        mission=mission,
        choices=choices_of(batch, mission),
        prior=None
        if a_priori is None
        else prior_attitude(a_priori, time, mission, batch.position_km),
        velocity_c=aberration_velocity(batch),
        sun_au=sun_distance_au(time),
        run_catalog=sky.run_catalog(mission, time),
        sky=sky,
        timer=timer,
        budget=budget,
    )


def _continued(
    search: Search, corrected: tuple[CorrectedObservations, ...], zones: ZoneSearch, row: int
) -> Acquisition | Exception:
    """Acquisition, or its error, of a batch that needs more than zones about its prior."""
    search = replace(search, timer=search.timer.of_one())
    first = zones.result(row) if row in zones else None
    try:
        return _composed(search, corrected, *find_groups(search, corrected, first))
    except Exception as error:
        # The error is the row's own result, as callers of `acquire_many` expect.
        return as_row_error(error)


def _composed(
    search: Search,
    corrected: tuple[CorrectedObservations, ...],
    found: SearchResult,
    rival: RivalAttitude | None,
) -> Acquisition:
    """The acquisition of a batch, made from the results of its searches, with warnings."""
    batch, mission, prior = search.batch, search.mission, search.prior
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
            doubts, is_contradicted = doubts_of(
                search, solution, corrected, in_zones.identifications
            )
            warnings += doubts
            if is_contradicted:
                solution = replace(solution, suspect=True)
        if rival is not None:
            warnings.append(warning_of_rival(rival))
        attitude = in_zones.prior.attitude if solution is None else solution.matrix
        warnings += warnings_of_trackers(trackers, attitude)
    if search.budget.was_hit and not any(each.startswith(WORK_BOUND_HIT) for each in warnings):
        warnings.append(f"{WORK_BOUND_HIT}: the search for a second group of stars was cut short")
    return Acquisition(
        batch=batch,
        mission=mission,
        choices=search.choices,
        prior=prior,
        path=found.path,
        run_catalog=search.run_catalog,
        trackers=trackers,
        counts=outcome_counts(trackers),
        solution=solution,
        rival=rival,
        reason=solved if isinstance(solved, NoAttitude) else None,
        warnings=tuple(warnings),
        timings_us=search.timer.us,
        provenance=_provenance(search.sky, search.run_catalog, mission),
    )


def _measured(batch: ObservationBatch, mission: Mission, sky: SkyModel) -> Acquisition:
    """The acquisition of an attitude measured by a tracker itself."""
    assert batch.measurement is not None
    run_catalog = sky.run_catalog(mission, batch.time)
    return Acquisition(
        batch=batch,
        mission=mission,
        choices=choices_of(batch, mission),
        prior=None,
        path=Path.MEASURED,
        run_catalog=run_catalog,
        trackers=(),
        counts=outcome_counts(()),
        solution=measured_solution(batch.measurement, mission),
        rival=None,
        reason=None,
        warnings=batch.remarks,
        timings_us=StepTimer().us,
        provenance=_provenance(sky, run_catalog, mission),
    )


def _provenance(sky: SkyModel, run_catalog: RunCatalog, mission: Mission) -> Provenance:
    return Provenance(
        sky.catalog.digest, run_catalog.digest, run_catalog.epoch_year, mission.digest, __version__
    )
