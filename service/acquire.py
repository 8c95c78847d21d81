"""THE STAIRCASE: batch, corrected, identified, solved.

One way down for every door: single posts, bulk, replay, simulator and what-if.
Pure: an answer depends on the batch, the mission and the catalog alone.  Not
finding a star is a result; only bad input raises.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from time import perf_counter_ns as clock_ns

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from service import __version__
from service.attitude.solution import AttitudeSolution, NoAttitude
from service.attitude.solve import taste_bound
from service.identify.groups import (
    Mask,
    log_weight_of_group,
    may_be_a_group,
    of_all,
    part_of,
    share_of,
    shared,
)
from service.identify.identification import (
    Identification,
    Integers,
    Outcome,
    not_known,
    nothing_known,
)
from service.identify.lost_in_space.finder import find_attitude
from service.identify.lost_in_space.solver import FEWEST_POINTS
from service.identify.matched import attitude_of
from service.identify.presumed import Presumed, aim_of, presumed_attitude
from service.identify.ptp import identify_ptp
from service.identify.starid import MAX_RIVALS, Sighting, identify_by_votes
from service.identify.verify import identify_verified
from service.missions.mission import (
    TESTS_OF_ROLL,
    Band,
    Identifier,
    Mission,
    Rules,
    Solver,
    Tests,
    Tolerances,
    rules_of,
)
from service.observe.batch import (
    BoresightPrior,
    ObservationBatch,
    QuaternionPrior,
)
from service.observe.correct import CorrectedObservations, correct
from service.sky.ephemeris import observer_velocity, sun_distance_au
from service.sky.guide import Guide
from service.sky.run_catalog import RunCatalog
from service.sky.view import Sky
from service.sky.zones import Aim, Zone, counts_within
from service.vectors import (
    Vector,
    attitude_error_arcsec,
    quaternion_from_matrix,
    read_only,
    separation_deg,
)

IDENTIFIERS: Mapping[Identifier, Callable[[Sighting], Identification]] = {
    "starid": identify_by_votes,
    "verified": identify_verified,
    "ptp": identify_ptp,
    # About the attitude that was found in the whole sky.
    "lost_in_space": identify_verified,
}
LEAST_APART = 30.0
"""Of chi-square with three degrees of freedom: two attitudes of noise alone pass it in 1e-6."""
WITH_HYPOTHESES: frozenset[Identifier] = frozenset({"verified", "lost_in_space"})
"""Identifiers that weigh hypotheses, so that two groups of stars can be told apart and weighed."""
WITHOUT_PRIOR: frozenset[Identifier] = frozenset({"ptp"})
"""Identifiers that look in the whole sky, and are given its guide database."""


_COUNTED = [
    (int(each), each.word) for each in (Outcome.UNIQUE, Outcome.AMBIGUOUS, Outcome.UNMATCHED)
]


class Choices(Struct, frozen=True, eq=False, gc=False):
    """What holds for one batch: its mission's settings with its own options in their place."""

    identifier: Identifier
    solver: Solver
    rules: Rules
    zone_grid_deg: float

    @property
    def tolerances(self) -> Tolerances:
        """The tolerances of the identification."""
        return self.rules.tolerances

    @property
    def tests(self) -> Tests:
        """The tests that are made."""
        return self.rules.tests


class TrackerResult(Struct, frozen=True, eq=False, gc=False):
    """One tracker's part: where its stars were looked for, and what was found.

    `stars` and `pairs` are those within the aim, the paper's NCAP and NTOT;
    `zone`, from the shelf, may hold more.  Aim and zone are None where the
    whole sky gave no attitude to look about.  `residual_arcsec` is NaN for
    stars that are not unique and where there is no attitude.
    """

    corrected: CorrectedObservations
    aim: Aim | None
    zone: Zone | None
    zone_cached: bool
    stars: int
    pairs: int
    identification: Identification
    residual_arcsec: Vector


class Path(StrEnum):
    """Which way an answer came."""

    ZONE = "zone"
    LOST_IN_SPACE = "lost_in_space"
    """No a priori attitude was given, or it was not to be used."""
    ZONE_THEN_LOST_IN_SPACE = "zone_then_lost_in_space"
    """About the a priori attitude nothing good was found, and the whole sky was looked at."""


class Provenance(Struct, frozen=True, eq=False, gc=False):
    """What an answer was made of."""

    catalog: str
    run_catalog: str
    epoch_year: float
    mission: str
    version: str


class RivalAttitude(Struct, frozen=True, eq=False, gc=False):
    """A second attitude, which explains a group of stars that the first one leaves unexplained.

    `star` (n,) of every tracker are rows of the run catalog, -1 for stars that are
    not in its group.  `probability` is its share of the two; `angle_deg` the
    rotation between them.
    """

    solution: AttitudeSolution
    star: tuple[Integers, ...]
    probability: float
    angle_deg: float


class Acquisition(Struct, frozen=True, eq=False, gc=False):
    """Everything that came of one batch.

    `solution` is None where `reason` says why; never an older attitude.  Where a
    `rival` is named, the stars that the solution leaves unexplained have an
    attitude of their own, and the solution is suspect.
    `presumed` is what the batch's a priori knowledge says, None without any.
    `counts` are of the stars observed, and of them unique, ambiguous and unmatched.
    """

    batch: ObservationBatch
    mission: Mission
    choices: Choices
    presumed: Presumed | None
    path: Path
    run_catalog: RunCatalog
    trackers: tuple[TrackerResult, ...]
    counts: dict[str, int]
    solution: AttitudeSolution | None
    rival: RivalAttitude | None
    reason: NoAttitude | None
    warnings: tuple[str, ...]
    timings_us: Mapping[str, int]
    provenance: Provenance


class _Look(Struct, frozen=True, eq=False, gc=False):
    """What came of looking about one presumed attitude."""

    presumed: Presumed
    places: list[tuple[Aim, Zone, bool]]
    identifications: list[Identification]
    solved: AttitudeSolution | NoAttitude

    @property
    def good(self) -> bool:
        """Whether there is an attitude that its own residuals do not speak against."""
        return isinstance(self.solved, AttitudeSolution) and not self.solved.suspect


class _Found(Struct, frozen=True, eq=False, gc=False):
    """What was found for some stars of a batch: which way, the look about it, or why there is none.

    `explained` (n,) of every tracker marks the stars of the likeliest hypothesis.
    """

    path: Path
    looked: _Look | None
    refusal: NoAttitude | None
    warnings: list[str]
    explained: tuple[Mask, ...]

    @property
    def good(self) -> bool:
        """Whether there is an attitude that its own residuals do not speak against."""
        return self.looked is not None and self.looked.good

    @property
    def unique(self) -> list[Mask]:
        """The stars (n,) of every tracker that are named for certain."""
        assert self.looked is not None
        return [each.unique for each in self.looked.identifications]


class _Clock:
    """Time spent in each step, also where a step is taken again."""

    def __init__(self) -> None:
        self.ns = dict.fromkeys(("zone", "identify", "solve"), 0)
        self._last = clock_ns()

    def end(self, step: str) -> None:
        """Count the time since the last call to a step."""
        now = clock_ns()
        self.ns[step] += now - self._last
        self._last = now


def acquire(batch: ObservationBatch, mission: Mission, sky: Sky) -> Acquisition:
    """Identify a batch's stars and solve for the attitude.

    Without a priori knowledge, or where it leads to nothing good, the whole sky
    gives the attitude to look about.  Raises `BadInput` for what does not fit
    the mission: a tracker it has not, a kind of a priori knowledge that its
    zone cannot use.
    """
    choices = choices_of(batch, mission)
    corrected = correct(batch, mission)
    given = batch.a_priori
    presumed = (
        None if given is None else presumed_attitude(given, batch.time, mission, batch.position_km)
    )
    velocity_c = velocity_to_correct(batch)
    sun_au = sun_distance_au(batch.time)

    clock = _Clock()
    run_catalog = sky.run_catalog(mission, batch.time)
    search = _Search(batch, mission, choices, presumed, velocity_c, sun_au, run_catalog, sky, clock)
    found, rival = search.find_groups(corrected)
    path, looked, refusal, warnings = found.path, found.looked, found.refusal, found.warnings

    solved = looked.solved if looked is not None else refusal
    solution = solved if isinstance(solved, AttitudeSolution) else None
    trackers = _tracker_results(corrected, looked, solution)
    warnings += _warnings(
        batch,
        mission,
        trackers,
        presumed,
        None if looked is None else looked.presumed,
        solution,
        rival,
    )
    return Acquisition(
        batch=batch,
        mission=mission,
        choices=choices,
        presumed=presumed,
        path=path,
        run_catalog=run_catalog,
        trackers=trackers,
        counts=_counts(trackers),
        solution=solution,
        rival=rival,
        reason=solved if isinstance(solved, NoAttitude) else None,
        warnings=tuple(warnings),
        timings_us={step: ns // 1000 for step, ns in clock.ns.items()},
        provenance=Provenance(
            sky.catalog.digest,
            run_catalog.digest,
            run_catalog.epoch_year,
            mission.digest,
            __version__,
        ),
    )


@dataclass(frozen=True)
class _Search:
    """The search for what the stars of one batch are, all of them or a part."""

    batch: ObservationBatch
    mission: Mission
    choices: Choices
    presumed: Presumed | None
    velocity_c: Vector
    sun_au: float
    run_catalog: RunCatalog
    sky: Sky
    clock: _Clock

    def find_groups(
        self, corrected: tuple[CorrectedObservations, ...]
    ) -> tuple[_Found, RivalAttitude | None]:
        """What the stars are; where two groups have each an attitude, the other one as the rival.

        The stars that the answer leaves unexplained are acquired by themselves, the
        same way.  Where nothing good was found for all, so are those of the
        likeliest hypothesis: two groups of like weight leave every star ambiguous.
        """
        found = self.find(corrected)
        if self.choices.identifier not in WITH_HYPOTHESES or not any(
            mask.any() for mask in found.explained
        ):
            return found, None
        left = [~mask for mask in found.explained]
        other = self._group(corrected, left)
        if other is None:
            return found, None
        first = found
        if not found.good:
            explained = self._group(corrected, found.explained)
            if explained is None:
                return found, None
            first = explained
        elif not _is_apart(_solution_of(found), _solution_of(other)):
            # Another tracker decided for this group: then it is the hypothesis that is left over.
            left = [mask & ~each for mask, each in zip(found.explained, found.unique, strict=True)]
            other = self._group(corrected, left)
        if other is None or not _is_apart(_solution_of(first), _solution_of(other)):
            # The same attitude twice: every star was sent twice, say.
            return found, None
        return self._weighed(corrected, first, other)

    def _group(
        self, corrected: tuple[CorrectedObservations, ...], masks: Sequence[Mask]
    ) -> _Found | None:
        """What these stars are by themselves, as of all; None where three have no attitude.

        Also one that its residuals speak against: one sound group in a thousand is such.
        """
        if not may_be_a_group(masks):
            return None
        found = self.find(part_of(corrected, masks))
        if found.looked is None or not isinstance(found.looked.solved, AttitudeSolution):
            return None
        return _of_all(found, masks) if may_be_a_group(found.unique) else None

    def _weighed(
        self, corrected: tuple[CorrectedObservations, ...], one: _Found, other: _Found
    ) -> tuple[_Found, RivalAttitude]:
        """The heavier of two groups as the answer, the lighter as its rival."""
        weights = self._log_weight(corrected, one), self._log_weight(corrected, other)
        if weights[0] < weights[1]:
            one, other, weights = other, one, weights[::-1]
        first, second = one.looked, other.looked
        assert first is not None
        assert second is not None
        solution, rival = _solution_of(one), _solution_of(other)
        stars = tuple(each.star for each in second.identifications)
        share = share_of(*weights, sum(int((rows >= 0).sum()) for rows in stars))
        apart_arcsec = attitude_error_arcsec(rival.matrix, solution.matrix)
        identifications = [
            shared(mine, its, share)
            for mine, its in zip(first.identifications, second.identifications, strict=True)
        ]
        looked = replace(
            first, identifications=identifications, solved=replace(solution, suspect=True)
        )
        angle_deg = math.hypot(*apart_arcsec) / 3600.0
        return replace(one, looked=looked), RivalAttitude(rival, stars, 1.0 - share, angle_deg)

    def _log_weight(self, corrected: tuple[CorrectedObservations, ...], found: _Found) -> float:
        """How much all stars weigh under the attitude of one group, up to a common constant.

        Beside an a priori attitude; without one, about the attitude that was found.
        """
        looked = found.looked
        assert looked is not None
        presumed = looked.presumed if self.presumed is None else self.presumed
        return sum(
            log_weight_of_group(
                self._sighting(each, presumed, aim, zone), identification.star, self.run_catalog
            )
            for each, (aim, zone, _), identification in zip(
                corrected, looked.places, looked.identifications, strict=True
            )
        )

    def find(self, corrected: tuple[CorrectedObservations, ...]) -> _Found:
        """What these stars are: about the a priori attitude, else in the whole sky."""
        presumed, path = self.presumed, Path.LOST_IN_SPACE
        looked = refusal = None
        warnings: list[str] = []
        explained: tuple[Mask, ...] | None = None
        if presumed is not None and self.choices.identifier != "lost_in_space":
            path, looked = Path.ZONE, self.look(corrected, presumed)
            warnings += presumed.warnings
            if self._falls_back(corrected, looked):
                path = Path.ZONE_THEN_LOST_IN_SPACE
        if path is not Path.ZONE:
            found = find_attitude(
                corrected, self.velocity_c, self.run_catalog, self.mission, self.sky
            )
            self.clock.end("identify")
            refusal, explained = found.refusal, found.explained
            if found.attitude is not None:
                quaternion = QuaternionPrior(read_only(quaternion_from_matrix(found.attitude)))
                again = self.look(
                    found.corrected,
                    presumed_attitude(
                        quaternion, self.batch.time, self.mission, self.batch.position_km
                    ),
                )
                # What the zone gave stands unless the whole sky gives better.
                if looked is None or again.good:
                    looked = again
                    warnings = [*again.presumed.warnings, *found.warnings]
            elif looked is not None:
                warnings.append(f"lost_in_space_refused: {refusal}")
            if found.bounded:
                warnings.append("work_bound_hit: the search in the whole sky ended at its bound")
        if looked is not None:
            explained = tuple(each.explained for each in looked.identifications)
        assert explained is not None
        return _Found(path, looked, refusal, warnings, explained)

    def look(self, corrected: Sequence[CorrectedObservations], about: Presumed) -> _Look:
        """Zones about a presumed attitude, identities, and the attitude that they give."""
        places = [
            _place(each, index, about, self.mission, self.choices, self.run_catalog, self.sky)
            for index, each in enumerate(corrected)
        ]
        sightings = [
            self._sighting(each, about, aim, zone)
            for each, (aim, zone, _) in zip(corrected, places, strict=True)
        ]
        self.clock.end("zone")
        identify = IDENTIFIERS[self.choices.identifier]
        identifications = [identify(sighting) for sighting in sightings]
        self.clock.end("identify")
        solved = _solve(
            self.choices,
            corrected,
            identifications,
            self.run_catalog,
            self.velocity_c,
            self.sun_au,
        )
        self.clock.end("solve")
        return _Look(about, places, identifications, solved)

    def _sighting(
        self, corrected: CorrectedObservations, about: Presumed, aim: Aim, zone: Zone
    ) -> Sighting:
        guide = None
        if self.choices.identifier in WITHOUT_PRIOR:
            guide = self.sky.guide(self.run_catalog, corrected.tracker.field_of_view_radius_deg)
        return _sighting(corrected, about, self.velocity_c, aim, zone, self.choices.rules, guide)

    def _falls_back(self, corrected: Sequence[CorrectedObservations], looked: _Look) -> bool:
        """Whether an answer about the a priori attitude is so poor that the whole sky is asked."""
        return (
            not looked.good
            and self.choices.identifier == "verified"
            and self.mission.lost_in_space_fallback
            and any(len(each.magnitude_mag) >= FEWEST_POINTS for each in corrected)
        )


def _solution_of(found: _Found) -> AttitudeSolution:
    """The attitude of what is good."""
    assert found.looked is not None
    assert isinstance(found.looked.solved, AttitudeSolution)
    return found.looked.solved


def _is_apart(one: AttitudeSolution, other: AttitudeSolution) -> bool:
    """Whether two attitudes of different stars differ by more than their noise explains."""
    apart_arcsec = attitude_error_arcsec(other.matrix, one.matrix)
    covariance_arcsec2 = one.covariance_arcsec2 + other.covariance_arcsec2
    weighted = float(apart_arcsec @ np.linalg.solve(covariance_arcsec2, apart_arcsec))
    return weighted > LEAST_APART


def _of_all(found: _Found, masks: Sequence[Mask]) -> _Found:
    """What was found for a part of the stars, as of all, the others unmatched."""
    looked, solution = found.looked, _solution_of(found)
    assert looked is not None
    every = np.concatenate(masks)
    residual = np.full(len(every), np.nan)
    residual[every] = solution.residual_arcsec
    return replace(
        found,
        looked=replace(
            looked,
            identifications=[
                of_all(each, mask) for each, mask in zip(looked.identifications, masks, strict=True)
            ],
            solved=replace(solution, residual_arcsec=read_only(residual)),
        ),
        explained=tuple(masks),
    )


def _tracker_results(
    corrected: Sequence[CorrectedObservations],
    looked: _Look | None,
    solution: AttitudeSolution | None,
) -> tuple[TrackerResult, ...]:
    """The parts of the answer, every star unmatched where there was nowhere to look."""
    if looked is None:
        return tuple(
            TrackerResult(each, None, None, False, 0, 0, nothing_known(n), not_known(n))
            for each, n in zip(
                corrected, [len(each.magnitude_mag) for each in corrected], strict=True
            )
        )
    results = []
    first = 0
    for each, (aim, zone, cached), identification in zip(
        corrected, looked.places, looked.identifications, strict=True
    ):
        n = len(each.magnitude_mag)
        residual = not_known(n) if solution is None else solution.residual_arcsec[first : first + n]
        first += n
        stars, pairs = counts_within(zone, aim)
        results.append(
            TrackerResult(each, aim, zone, cached, stars, pairs, identification, residual)
        )
    return tuple(results)


def _counts(trackers: tuple[TrackerResult, ...]) -> dict[str, int]:
    found = [outcome for each in trackers for outcome in each.identification.outcome.tolist()]
    counts = {"observed": len(found)}
    for number, word in _COUNTED:
        counts[word] = found.count(number)
    return counts


def velocity_to_correct(batch: ObservationBatch) -> Vector:
    """The velocity (3,), in units of c, whose aberration the catalog is given for a batch.

    At rest, where nothing is to be corrected, directions stay geometric.
    """
    if batch.aberration != "to_correct":
        return np.zeros(3)
    return observer_velocity(batch.time, batch.velocity_km_per_s)


def choices_of(batch: ObservationBatch, mission: Mission) -> Choices:
    """The settings that hold for a batch.

    A test that cannot be made is off: that of the pole in a cap, and what
    compares with the presumed roll where an a priori boresight leaves it open.
    """
    options = batch.options
    grid_deg = options.zone_grid_deg
    return Choices(
        options.identifier or mission.identifier,
        options.solver or mission.solver,
        _rules(batch, mission),
        mission.zone.grid_deg if grid_deg is None else grid_deg,
    )


def _rules(batch: ObservationBatch, mission: Mission) -> Rules:
    options, roll_open = batch.options, isinstance(batch.a_priori, BoresightPrior)
    if not (options.tests or options.tolerances):
        return mission.rules_without_roll if roll_open else mission.rules
    tests = {**options.tests, **dict.fromkeys(_impossible_tests(batch, mission), False)}
    return rules_of(
        mission.tolerances.model_copy(update=options.tolerances),
        mission.tests.model_copy(update=tests),
    )


def _impossible_tests(batch: ObservationBatch, mission: Mission) -> tuple[str, ...]:
    pole = () if isinstance(mission.zone, Band) else ("pole",)
    return pole + (TESTS_OF_ROLL if isinstance(batch.a_priori, BoresightPrior) else ())


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


def _sighting(
    corrected: CorrectedObservations,
    presumed: Presumed,
    velocity_c: Vector,
    aim: Aim,
    zone: Zone,
    rules: Rules,
    guide: Guide | None,
) -> Sighting:
    return Sighting(
        np.dot(corrected.direction_body, presumed.attitude),
        corrected.magnitude_mag,
        corrected.sigma_rad,
        # Kernels are compiled anew for an array that cannot be written to, as the client's own is.
        None if presumed.known_axis is None else presumed.known_axis.copy(),
        velocity_c,
        # A cap is looked for about the boresight itself.
        aim.axis
        if aim.kind == "cap"
        else np.dot(corrected.tracker.boresight_body, presumed.attitude),
        aim,
        zone,
        rules,
        guide,
    )


def _solve(
    choices: Choices,
    corrected: Sequence[CorrectedObservations],
    identifications: Sequence[Identification],
    run_catalog: RunCatalog,
    velocity_c: Vector,
    sun_au: float,
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
        run_catalog.direction,
        velocity_c,
        sun_au,
        choices.solver,
    )


def _warnings(
    batch: ObservationBatch,
    mission: Mission,
    trackers: tuple[TrackerResult, ...],
    presumed: Presumed | None,
    looked_about: Presumed | None,
    solution: AttitudeSolution | None,
    rival: RivalAttitude | None,
) -> list[str]:
    warnings = []
    if batch.options.tests:
        warnings += [
            f"test_off: {name} was asked for and cannot be made of this a priori knowledge"
            for name in _impossible_tests(batch, mission)
            if batch.options.tests.get(name)
        ]
    if batch.aberration == "to_correct" and batch.velocity_km_per_s is None:
        warnings.append(
            "velocity_of_earth_alone: no velocity_km_per_s was given; "
            "aberration was corrected for Earth's motion only"
        )
    if looked_about is None:
        return warnings
    attitude = looked_about.attitude if solution is None else solution.matrix
    if solution is not None:
        warnings += _doubts(solution, mission, presumed)
    if rival is not None:
        others = sum(int((star >= 0).sum()) for star in rival.star)
        warnings.append(
            f"rival_attitude: {others} stars that this attitude leaves unexplained have one of "
            f"their own, {rival.angle_deg:.3f} deg away, with probability {rival.probability:.3g}"
        )
    for each in trackers:
        tracker, aim = each.corrected.tracker, each.aim
        if aim is not None and aim.reaches_past(
            np.dot(tracker.boresight_body, attitude), tracker.field_of_view_radius_deg
        ):
            warnings.append(
                f"field_of_view_past_zone_edge: the field of view of {tracker.name} reaches past "
                "the edge of its zone; stars beyond it cannot be identified"
            )
        if each.identification.mirrored:
            warnings.append(
                f"mirrored_field: the stars of {tracker.name} fit better in a mirror: one of its "
                "axes may have the wrong sign, or two are exchanged"
            )
        if each.identification.bounded:
            warnings.append(
                f"work_bound_hit: the search for the stars of {tracker.name} ended at its bound"
            )
        if each.identification.rivals_cut:
            warnings.append(
                f"rivals_cut: lists of rivals of {tracker.name} end at {MAX_RIVALS}; "
                f"stars with more rivals: {each.identification.rivals_cut}"
            )
        stars = [row for row in each.identification.star.tolist() if row >= 0]
        if len(set(stars)) < len(stars):
            warnings.append(f"same_star_twice: two stars of {tracker.name} have one identity")
    return warnings


def _doubts(solution: AttitudeSolution, mission: Mission, presumed: Presumed | None) -> list[str]:
    """What speaks against an attitude: its own residuals, and the a priori knowledge."""
    doubts = []
    if solution.taste > taste_bound(solution.degrees_of_freedom):
        doubts.append(
            f"attitude_suspect: residuals of {solution.residual_rms_arcsec:.1f} arcsec rms "
            f"where {solution.predicted_rms_arcsec:.1f} are expected: a star is misidentified "
            "or noisier than its sigma"
        )
    if presumed is None:
        return doubts
    zone = mission.zone
    off_deg = separation_deg(np.dot(mission.axis_body, solution.matrix), presumed.axis)
    if off_deg > (zone.half_width_deg if isinstance(zone, Band) else zone.radius_deg):
        doubts.append(
            f"attitude_off_a_priori: its {'pole' if isinstance(zone, Band) else 'boresight'} lies "
            f"{off_deg:.1f} deg from where the a priori knowledge has it"
        )
    return doubts
