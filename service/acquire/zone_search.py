"""The search for stars in zones about presumed attitudes, for many batches at once.

Trackers are grouped by the zone that serves them, so that each zone is fetched once; stars are
identified, and then attitudes solved, in compiled loops.
"""

from collections.abc import Hashable, Sequence
from time import perf_counter_ns

import numpy as np
from msgspec import Struct

from service.acquire.choices import Choices
from service.acquire.result import Place
from service.attitude.solution import METHODS, WORST_AXIS_RAD, AttitudeSolution, NoAttitude
from service.errors import AcquisitionError
from service.identify.attitude_from_matches import fit_sightings, room_for_fits, with_tracker_fits
from service.identify.budget import WorkBudget
from service.identify.hypotheses.ledger import LEAST_GROUP
from service.identify.identification import Identification, room_for_identities
from service.identify.prior_attitude import PriorAttitude, search_region
from service.identify.sighting import (
    PRIOR_DIRECTION,
    PRIOR_ROTATION,
    Sighting,
    room_for_sightings,
)
from service.identify.voting.starid import refuse_endless
from service.missions.identifiers import IDENTIFIERS, IdentifierEntry
from service.missions.mission import Mission, SolverName, Tracker
from service.observations.batch import ObservationBatch
from service.observations.calibrate import CorrectedColumns
from service.sky.cache import NotAtHand
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.model import SkyModel
from service.sky.zones import SearchRegion, Zone, count_within, zone_key
from service.vectors import Vector


def as_row_error(error: Exception) -> Exception:
    """The same error, made ready to be stored as the result of a row.

    Expected errors (`AcquisitionError`, `NotAtHand`) lose their traceback, which would keep all
    columns in memory.
    """
    is_expected = isinstance(error, AcquisitionError | NotAtHand)
    return error.with_traceback(None) if is_expected else error


class StepTimer:
    """Timer of the pipeline's steps, with the sum of each for one or more batches."""

    def __init__(self, batches: int = 1) -> None:
        self.ns = dict.fromkeys(("zone", "identify", "solve"), 0)
        self._batches = max(batches, 1)
        self.begin()

    def begin(self) -> None:
        """Start the timer of the next step now, so that the time before counts for none."""
        self._last = perf_counter_ns()

    def end(self, step: str) -> None:
        """Add the time since the last call, or the beginning, to a step of the pipeline."""
        now = perf_counter_ns()
        self.ns[step] += now - self._last
        self._last = now

    def of_one(self) -> "StepTimer":
        """A timer for one of the batches, starting with its equal share of the time so far."""
        timer = StepTimer()
        timer.ns = {step: ns // self._batches for step, ns in self.ns.items()}
        return timer

    @property
    def us(self) -> dict[str, int]:
        """The time of each step in whole microseconds, divided equally among the batches."""
        return {step: ns // 1000 // self._batches for step, ns in self.ns.items()}


class Search(Struct, frozen=True, eq=False):
    """Common input of every search for the stars of one batch, or for a part of them."""

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

    @property
    def identifier(self) -> IdentifierEntry:
        """The registry's entry of the batch's identifier."""
        return IDENTIFIERS[self.choices.identifier]

    @property
    def catalog_direction(self) -> Vector:
        """Unit vectors (N, 3) of the run catalog's stars on the day of the batch."""
        return self.run_catalog.direction_at(self.batch.time)

    @property
    def zone_choices(self) -> tuple[float, float]:
        """The largest pair separation of a zone, and the grid step of zone axes, in degrees."""
        return self.choices.tolerances.pair_separation_max_deg, self.choices.zone_grid_deg

    def zone(self, region: SearchRegion) -> tuple[Zone, bool]:
        """The zone that serves a search region, and true if it was cached."""
        return self.sky.zone(self.mission, self.run_catalog, region, *self.zone_choices)


class ZoneResult(Struct, frozen=True, eq=False):
    """The result of a search in the zones about one presumed attitude.

    `places` are the search regions of the trackers.
    """

    prior: PriorAttitude
    places: list[Place]
    identifications: list[Identification]
    solved: AttitudeSolution | NoAttitude

    @property
    def good(self) -> bool:
        """True if an attitude was found and its residuals are not suspect."""
        return isinstance(self.solved, AttitudeSolution) and not self.solved.suspect


class _Asked(Struct, frozen=True, eq=False):
    """Request of a zone search for one batch: presumed attitude, search regions, and work limit."""

    search: Search
    prior: PriorAttitude
    trackers: Sequence[Tracker]
    regions: Sequence[SearchRegion]
    budget: WorkBudget


class ZoneSearch:
    """Searches for the stars of many batches, each about its own presumed attitude.

    | column | shape | |
    |---|---|---|
    | `stars` | | the batches' stars in body axes: `CorrectedColumns` of n batches, t trackers |
    | `seen` | by tracker, and by star | the same about the presumed attitudes |
    | `found` | by tracker, and by star | outcome, star, votes, probability, rivals |
    | `fits` | by batch, and residuals by star | quaternions, covariance, figures |
    | `cached` | (t,) | whether the zone was in the cache |
    | `within` | (t, 2) | stars and pairs within the region searched |

    `add` defines the search of a row, `run` searches, and then `errors` has, by row, the errors
    that prevented a result.
    """

    def __init__(self, stars: CorrectedColumns) -> None:
        n, t, m = len(stars.tracker_offsets) - 1, len(stars.trackers), len(stars.sigma_rad)
        self.stars = stars
        self.seen = room_for_sightings(stars.star_offsets, stars.sigma_rad, stars.magnitude_mag)
        self.found = room_for_identities(t, m)
        self.fits = room_for_fits(n, m)
        self.cached, self.within = np.zeros(t, np.bool_), np.zeros((t, 2), np.int64)
        self.errors: dict[int, Exception] = {}
        self._asked: dict[int, _Asked] = {}
        self._by_itself: dict[int, Identification] = {}
        """Identifications by tracker, from identifiers that take one sighting at a time."""
        self._zones: dict[tuple[int, *tuple[Hashable, ...]], list[tuple[int, int]]] = {}
        """Lists of (row, tracker) that are identified together, by the settings that they share."""

    def __contains__(self, row: int) -> bool:
        return row in self._asked

    def add(
        self,
        row: int,
        search: Search,
        prior: PriorAttitude,
        budget: WorkBudget | None = None,
        regions: Sequence[SearchRegion] | None = None,
    ) -> None:
        """Add a search for a row's stars about a presumed attitude, with a work limit.

        The default limit is three quarters of the batch's; the rest is for the whole sky, and for
        stars left unexplained. `regions` replace the trackers' regions derived from the prior.
        Raises `BadBatch` as `search_region` does.
        """
        stars, seen, rows = self.stars, self.seen, self.stars.trackers_of(row)
        trackers = [each for each in stars.trackers[rows.start : rows.stop] if each is not None]
        if regions is None:
            regions = [
                search_region(tracker, prior, search.mission, f"observations.{index}.tracker")
                for index, tracker in enumerate(trackers)
            ]
        offsets, known = stars.star_offsets[rows.start : rows.stop + 1].tolist(), prior.known_axis
        rules = search.choices.rules
        same_rules = rules.limits, rules.switches, rules.tests.match_groups
        for index, (t, region, tracker) in enumerate(zip(rows, regions, trackers, strict=True)):
            first, last = offsets[index : index + 2]
            seen.direction[first:last] = np.dot(stars.direction_body[first:last], prior.attitude)
            # A cap is centred on the boresight itself.
            is_cap = region.kind == "cap"
            seen.boresight[t] = (
                region.axis if is_cap else np.dot(tracker.boresight_body, prior.attitude)
            )
            seen.velocity[t] = search.velocity_c
            seen.prior_kind[t] = PRIOR_ROTATION if known is None else PRIOR_DIRECTION
            seen.prior_axis[t] = region.axis if known is None else known
            seen.set_region(t, region)
            zone = zone_key(search.mission.name, search.run_catalog, region, *search.zone_choices)
            # Trackers of one batch use its budget one after another.
            key = index, search.choices.identifier, *same_rules, zone
            self._zones.setdefault(key, []).append((row, t))
        budget = budget or search.budget.share(3, 4)
        self._asked[row] = _Asked(search, prior, trackers, regions, budget)

    def run(self, timer: StepTimer) -> None:
        """Identify the stars zone by zone, and solve for the attitudes."""
        for (index, *_), sightings in sorted(self._zones.items(), key=lambda each: each[0][0]):
            sightings = [each for each in sightings if each[0] not in self.errors]
            if not sightings:
                continue
            first = self._asked[sightings[0][0]]
            try:
                zone, cached = first.search.zone(first.regions[index])
            except Exception as error:
                # The batches of this zone fail; those of other zones continue.
                self.errors |= dict.fromkeys((row for row, _ in sightings), as_row_error(error))
                continue
            timer.end("zone")
            self._identify(zone, index, sightings)
            # For the others the zone was in the cache.
            self.cached[sightings[0][1]] = cached
            timer.end("identify")
        self._solve()
        timer.end("solve")

    def _identify(self, zone: Zone, index: int, sightings: list[tuple[int, int]]) -> None:
        """Identify the stars of the trackers, given as (row, tracker), that a zone serves."""
        seen, offsets = self.seen, self.stars.star_offsets
        first = self._asked[sightings[0][0]].search
        identifier, rules = first.identifier, first.choices.rules
        which = np.array([t for _, t in sightings])
        budgets: dict[int, WorkBudget] = {}
        for row, t in sightings:
            asked = self._asked[row]
            self.cached[t] = True
            seen.set_zone(t, asked.regions[index], zone)
            budget = asked.budget.share(1, len(asked.regions) - index)
            stars = slice(offsets[t], offsets[t + 1])
            try:
                if identifier.by_columns:
                    refuse_endless(seen.direction[stars], zone, rules)
                    budgets[t], seen.left[t] = budget, budget.left
                else:
                    alone = identifier.identify(self._sighting(t, asked, index, zone, budget))
                    self._by_itself[t], self.found.star[stars] = alone, alone.star
            except Exception as error:
                # This batch fails; the others of the zone continue.
                self.errors[row] = as_row_error(error)
        count_within(zone, which, seen.axis, seen.least, seen.most, self.within)
        if budgets:
            if len(budgets) < len(which):
                which = np.array(list(budgets))
            identifier.identify(which, seen, zone, rules, self.found)
        for t, budget in budgets.items():
            budget.spend(budget.left - int(seen.left[t]))

    def _sighting(
        self, t: int, asked: _Asked, index: int, zone: Zone, budget: WorkBudget
    ) -> Sighting:
        """The sighting of one tracker, for an identifier that takes one at a time."""
        seen, search, guide = self.seen, asked.search, None
        first, last = seen.offsets[t : t + 2]
        if search.identifier.needs_guide:
            search.sky.require_whole_sky()
            radius_deg = asked.trackers[index].field_of_view_radius_deg
            guide = search.sky.guide(search.run_catalog, radius_deg)
        return Sighting(
            direction=seen.direction[first:last],
            magnitude_mag=seen.magnitude[first:last],
            sigma_rad=seen.sigma_rad[first:last],
            known_axis=None if asked.prior.known_axis is None else seen.prior_axis[t],
            velocity_c=search.velocity_c,
            boresight=seen.boresight[t],
            region=asked.regions[index],
            zone=zone,
            rules=search.choices.rules,
            guide=guide,
            budget=budget,
        )

    def _solve(self) -> None:
        """Solve all attitudes, in one call for each combination of catalog, day and solver."""
        together: dict[Hashable, tuple[Vector, SolverName, list[int]]] = {}
        n = len(self.stars.tracker_offsets) - 1
        velocity_c, sun_au = np.empty((n, 3)), np.empty(n)
        for row, asked in self._asked.items():
            if row not in self.errors:
                search = asked.search
                velocity_c[row], sun_au[row] = search.velocity_c, search.sun_au
                directions, solver = search.catalog_direction, search.choices.solver
                key = id(directions), solver
                together.setdefault(key, (directions, solver, []))[2].append(row)
        offsets = self.stars.star_offsets[self.stars.tracker_offsets]
        for directions, solver, rows in together.values():
            fit_sightings(
                *(np.array(rows), offsets, self.stars.direction_body, self.stars.sigma_rad),
                *(self.found.star, directions, velocity_c, sun_au, WORST_AXIS_RAD),
                *(METHODS.index(solver), self.fits),
            )

    # ---- results -----------------------------------------------------------------------------

    def final_rows(self) -> list[int]:
        """The rows of batches whose result in zones is final, without any further search.

        They have a good attitude, or an identifier that never searches the whole sky, and too few
        stars left for a second group. A batch with a prediction is never final here, since its
        attitude may contradict the prediction.
        """
        offsets, trackers = self.stars.star_offsets.tolist(), self.stars.tracker_offsets.tolist()
        explained, final = self.found.explained.tolist(), []
        for row, asked in self._asked.items():
            identifier = asked.search.identifier
            may_be_a_group = identifier.weighs_hypotheses and any(
                offsets[t + 1] - offsets[t] - explained[t] >= LEAST_GROUP
                for t in range(trackers[row], trackers[row + 1])
            )
            is_enough = self.fits.is_good(row) or not identifier.falls_back
            if is_enough and not may_be_a_group and asked.prior.predicted is None:
                final.append(row)
        return final

    def result(self, row: int) -> ZoneResult:
        """The result of the search in zones for a row: identified stars, and attitude or reason."""
        asked, stars, trackers = self._asked[row], self.stars, self.stars.trackers_of(row)
        search = asked.search
        offsets = stars.star_offsets[trackers.start : trackers.stop + 1].tolist()
        places, identifications = [], []
        for index, t in enumerate(trackers):
            within = self.within[t].tolist()
            places.append(Place(asked.regions[index], bool(self.cached[t]), *within))
            first, last = offsets[index : index + 2]
            identifications.append(
                self._by_itself.get(t)
                or self.found.of_sighting(t, first, last, search.identifier.weighs_hypotheses)
            )
        solved = self.fits.of_batch(row, offsets[0], offsets[-1], search.choices.solver)
        if len(places) > 1 and isinstance(solved, AttitudeSolution):
            own = slice(offsets[0], offsets[-1])
            solved = with_tracker_fits(
                *(solved, stars.direction_body[own], stars.sigma_rad[own], self.found.star[own]),
                *(search.catalog_direction, search.velocity_c, search.sun_au),
                np.repeat(np.arange(len(places)), np.diff(offsets)),
                tuple(each.name for each in asked.trackers),
            )
        return ZoneResult(asked.prior, places, identifications, solved)
