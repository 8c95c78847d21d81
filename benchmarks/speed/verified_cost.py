"""Cost of verified identification against votes: five stars, warm, in batches.

    python -m benchmarks verified_cost

The kernels run over many views in one compiled loop and one thread, the zone
at hand; the identities are checked against the truth.  Where a machine is slow
or busy, the ratios to the votes in the same run count.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, at_most
from benchmarks.report import Report
from service.acquire import Acquisition, acquire
from service.compiled.jit import njit
from service.identify.budget import MAX_WORK
from service.identify.hypotheses.ledger import marginals
from service.identify.hypotheses.scene import ObservedStars, ledger_for, scratch_for
from service.identify.hypotheses.search import search
from service.identify.hypotheses.verified import UNIQUE_PROBABILITY
from service.identify.identification import room_for_identities
from service.identify.prior_attitude import prior_attitude
from service.identify.sighting import SightedArrays, Sighting
from service.identify.voting.pair_tests import (
    Rulebook,
    cast_votes,
    count_votes,
    polar_angles,
    tallies_of,
)
from service.identify.voting.starid import ballots_for
from service.sky.model import SkyModel
from service.vectors import ARCSEC_PER_RADIAN
from studies.paper_1994.experiments import open_sky
from studies.paper_1994.printed import the_paper
from studies.paper_1994.views import EPOCH, batch_of, draw_zone, paper_mission
from tests.reference.compare import zone_searched
from tests.reference.sightings import arrays_of, posterior_for, scene_of

Rows = npt.NDArray[np.int64]

STARS = 5
VIEWS, QUICK_VIEWS = 2000, 100
VIEWS_PER_ZONE = 100
"""Number of views in one kernel call, so that the overhead of a call is negligible."""
REPEATS = 9
VOTES, EXHAUSTIVE, EARLY = "votes", "exhaustive", "early stop"
LEAST_NAMED = {VOTES: 0.95, EXHAUSTIVE: 0.998, EARLY: 0.998}


@dataclass(frozen=True)
class Place:
    """Run of the paper with a time limit in microseconds, or as a multiple of the votes' time."""

    table: str
    run: str
    most: dict[str, tuple[float, float]]

    @property
    def prior_error(self) -> str:
        """Error of the a priori attitude about body Z, Y and X, as text."""
        run = next(r for r in the_paper().runs if (r.table, r.run) == (self.table, self.run))
        return ", ".join(
            f"{each / 3600.0:g}°" if each >= 3600.0 else f'{each:g}"'
            for each in run.rotation_arcsec
        )


PLACES = {
    "random cap": Place("2", 'psi60"', {EXHAUSTIVE: (8.0, 4.0), EARLY: (6.0, 5.0)}),
    "random band": Place("3", "0.1,0.1,0.1", {EXHAUSTIVE: (40.0, 4.0), EARLY: (12.0, 1.5)}),
    "band forest": Place("10F", "nominal", {EXHAUSTIVE: (120.0, 4.0), EARLY: (25.0, 1.0)}),
}


@dataclass(frozen=True)
class Cost:
    """Microseconds per view by kernel, and shares of stars named rightly and wrongly."""

    views: int
    least_us: dict[str, float]
    named: dict[str, float]
    wrong: int


def sightings(
    place: Place, views: int, seed: int, sky: SkyModel
) -> Iterator[list[tuple[Sighting, Rows]]]:
    """Views of five stars by zone, with their true zone rows."""
    run = next(r for r in the_paper().runs if (r.table, r.run) == (place.table, place.run))
    world = replace(the_paper().worlds[run.world], views=VIEWS_PER_ZONE)
    mission = paper_mission(world.mission)
    catalog = sky.run_catalog(mission, EPOCH)
    rng = np.random.default_rng(seed)
    drawn = number = 0
    while drawn < views:
        several = []
        for view in draw_zone(world, number, mission, catalog, rng):
            if len(view.star) == STARS:
                batch = batch_of(view, run, mission, "verified")
                sighting = _sighting(acquire(batch, mission, sky), sky)
                several.append((sighting, np.searchsorted(sighting.zone.star, view.star)))
        drawn, number = drawn + len(several), number + 1
        if several:
            yield several


def _sighting(acquired: Acquisition, sky: SkyModel) -> Sighting:
    """Input of the identifier, restored from the stored results of the pipeline."""
    batch, mission, tracker = acquired.batch, acquired.mission, acquired.trackers[0]
    assert batch.a_priori is not None
    assert tracker.region is not None
    presumed = prior_attitude(batch.a_priori, batch.time, mission)
    return Sighting(
        direction=tracker.corrected.direction_body @ presumed.attitude,
        magnitude_mag=tracker.corrected.magnitude_mag,
        sigma_rad=tracker.corrected.sigma_arcsec / ARCSEC_PER_RADIAN,
        known_axis=presumed.known_axis,
        velocity_c=np.zeros(3),
        boresight=mission.trackers[0].body_from_tracker[:, 2] @ presumed.attitude,
        region=tracker.region,
        zone=zone_searched(acquired, sky),
        rules=acquired.choices.rules,
    )


@njit(nogil=True)
def many_verified(  # type: ignore[no-untyped-def]
    direction, magnitude, like, stars, pairs, exhaustive, star, probability, posterior
):
    """Identify many views of one zone; `like` has the inputs that they share."""
    n = direction.shape[1]
    scratch, ledger = scratch_for(n), ledger_for(n)
    for k in range(len(direction)):
        observed = ObservedStars(
            direction=direction[k],
            magnitude=magnitude[k],
            sigma_rad=like.sigma_rad,
            weight=like.weight,
            reference_sigma=like.reference_sigma,
            velocity=like.velocity,
            prior_kind=like.prior_kind,
            prior_axis=like.prior_axis,
        )
        progress, _ = search(observed, stars, pairs, exhaustive, MAX_WORK, scratch, ledger)
        marginals(ledger, progress.count, progress.unexplored_weight, posterior)
        star[k], probability[k] = posterior.star, posterior.probability


@njit(nogil=True)
def many_votes(  # type: ignore[no-untyped-def]
    direction, magnitude, like, zone, polar, bounds, rules, ballots, star_of, tallies, star
):
    """Count the votes of many views of one zone; `like` has the inputs that they share."""
    for k in range(len(direction)):
        ballots.votes[:] = 0
        ballots.counts[:] = 0
        sighted = SightedArrays(
            direction=direction[k],
            magnitude=magnitude[k],
            sigma_rad=like.sigma_rad,
            boresight=like.boresight,
            velocity=like.velocity,
            prior_kind=like.prior_kind,
            prior_axis=like.prior_axis,
        )
        cast_votes(sighted, zone, polar, bounds, rules, ballots)
        count_votes(ballots, star_of, tallies)
        star[k] = tallies.star


def _kernels(several: list[Sighting], named: dict[str, Rows]) -> dict[str, Callable[[], object]]:
    """Calls of three kernels for the views of one zone; each writes its rows to `named`."""
    like, stars, pairs = scene_of(several[0])
    direction = np.array([each.direction for each in several])
    magnitude = np.array([each.magnitude_mag for each in several])
    shape = (len(several), STARS)
    star, probability = np.full(shape, -1), np.zeros(shape)
    posterior = posterior_for(STARS)
    sighted, zone, bounds = arrays_of(several[0])
    rules = Rulebook(several[0].rules.limits, several[0].rules.switches, MAX_WORK)
    count = len(several[0].zone.star)
    polar = polar_angles(zone.polar, count, bounds, rules)
    ballots, rows = ballots_for(STARS, count), np.arange(count)
    tallies = tallies_of(room_for_identities(1, STARS), 0, STARS)

    def verified(name: str, exhaustive: bool) -> Callable[[], object]:
        def call() -> None:
            many_verified(
                *(direction, magnitude, like, stars, pairs, exhaustive),
                *(star, probability, posterior),
            )
            named[name] = np.where(probability >= UNIQUE_PROBABILITY, star, -1)

        return call

    def by_votes() -> None:
        many_votes(
            *(direction, magnitude, sighted, zone, polar, bounds, rules),
            *(ballots, rows, tallies, star),
        )
        named[VOTES] = star.copy()

    return {
        VOTES: by_votes,
        EXHAUSTIVE: verified(EXHAUSTIVE, True),
        EARLY: verified(EARLY, False),
    }


def measured(place: Place, views: int, seed: int, sky: SkyModel) -> Cost:
    """Least time of several, with kernels in rotation under equal load."""
    total = dict.fromkeys((VOTES, EXHAUSTIVE, EARLY), 0.0)
    right = dict.fromkeys(total, 0)
    wrong = seen = 0
    for several in sightings(place, views, seed, sky):
        named: dict[str, Rows] = {}
        kernels = _kernels([each for each, _ in several], named)
        least = dict.fromkeys(kernels, math.inf)
        for _ in range(REPEATS):
            for name, kernel in kernels.items():
                started = time.process_time_ns()
                kernel()
                least[name] = min(least[name], (time.process_time_ns() - started) / 1000)
        truth = np.array([rows for _, rows in several])
        seen += len(several)
        for name in kernels:
            total[name] += least[name]
            right[name] += int((named[name] == truth).sum())
        wrong += sum(
            int(((named[name] >= 0) & (named[name] != truth)).sum()) for name in (EXHAUSTIVE, EARLY)
        )
    return Cost(
        seen,
        {name: time_us / seen for name, time_us in total.items()},
        {name: count / (STARS * seen) for name, count in right.items()},
        wrong,
    )


def everywhere(quick: bool, seed: int) -> dict[str, Cost]:
    """Costs of all places."""
    sky, views = open_sky(), QUICK_VIEWS if quick else VIEWS
    return {
        name: measured(place, views, seed, sky)
        for name, place in tqdm(PLACES.items(), desc="verified cost", unit="place")
    }


def bounds_of(costs: dict[str, Cost]) -> list[Bound]:
    """Bounds of time, absolute or relative to votes, and of stars named rightly and wrongly."""
    bounds = []
    for name, cost in costs.items():
        bounds.append(at_most(f"{name}: stars named wrongly", cost.wrong, 0))
        bounds += [
            at_least(f"{name}, {kernel}: share named rightly", share, LEAST_NAMED[kernel])
            for kernel, share in cost.named.items()
        ]
    for name, place in PLACES.items():
        for kernel, (most_us, most_times) in place.most.items():
            spent, votes = costs[name].least_us[kernel], costs[name].least_us[VOTES]
            bounds.append(
                Bound(
                    f"{name}, {kernel}",
                    f"{spent:.1f} µs, {spent / votes:.2f} times the votes",
                    f"at most {most_us:g} µs, or {most_times:g} times the votes",
                    spent <= most_us or spent <= most_times * votes,
                )
            )
    return bounds


def run(quick: bool, seed: int) -> Report:
    """Benchmark of verified identification: microseconds and ratios."""
    costs = everywhere(quick, seed)
    figures = {
        f"{name}, {kernel}": (
            f"{spent:.1f} us, {spent / cost.least_us[VOTES]:.2f} votes; "
            f"{cost.named[kernel]:.2%} of {STARS * cost.views:,} stars named rightly"
        )
        for name, cost in costs.items()
        for kernel, spent in cost.least_us.items()
    }
    return Report("verified_cost", figures, bounds_of(costs))
