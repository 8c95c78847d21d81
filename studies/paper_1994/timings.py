"""Tables 11 to 14: how long zones and identifications take, how many pairs a zone holds."""

import time
from dataclasses import dataclass

import numpy as np

from service.acquire import acquire
from service.acquire.prewarm import prewarm_kernels
from service.identify.prior_attitude import prior_attitude, search_region
from service.missions.mission import Identifier
from service.sky.geometry.pairs import build_pairs
from service.sky.model import SkyModel
from service.sky.zones import build_zone
from studies.paper_1994.experiments import open_sky
from studies.paper_1994.printed import Times, World, the_paper
from studies.paper_1994.views import EPOCH, View, batch_of, draw_zone, paper_mission

# A zone with no pairs worth mentioning: its time is that of choosing the stars.
_NO_PAIRS_DEG = 1e-9


@dataclass(frozen=True)
class ZoneTime:
    """One zone and the identifications of its views, in seconds.

    `first_s` is the pair index and the first identification, `later_s` the
    identifications after it, `batch_s` those with all that the pipeline does
    to a batch.
    """

    stars: int
    pairs: int
    pairs_bytes: int
    generate_s: float
    first_s: float
    later_s: tuple[float, ...]
    batch_s: tuple[float, ...]


def measure(case: Times, seed: int, identifier: Identifier = "starid") -> list[ZoneTime]:
    """The times of a row's zones, ten views each, nominal errors, in this process."""
    world = the_paper().worlds[case.world]
    sky = open_sky()
    mission = paper_mission(world.mission)
    prewarm_kernels(sky, {mission.name: mission}, [identifier])
    catalog = sky.run_catalog(mission, EPOCH)
    rng = np.random.default_rng([seed, int(case.table)])
    return [
        _measure_zone(world, list(draw_zone(world, number, mission, catalog, rng)), sky, identifier)
        for number in range(case.zones)
    ]


def _measure_zone(
    world: World, views: list[View], sky: SkyModel, identifier: Identifier
) -> ZoneTime:
    mission = paper_mission(world.mission)
    catalog = sky.run_catalog(mission, EPOCH)
    nominal = next(run for run in the_paper().runs if run.world == world.name)
    batches = [batch_of(view, nominal, mission, identifier) for view in views if len(view.star)]
    prior = batches[0].a_priori
    assert prior is not None
    presumed = prior_attitude(prior, EPOCH, mission)
    region = search_region(mission.trackers[0], presumed, mission, "a_priori")

    clock = [time.perf_counter()]
    zone = build_zone(mission.name, catalog, region, _NO_PAIRS_DEG)
    clock.append(time.perf_counter())
    pairs = build_pairs(zone.direction, mission.tolerances.pair_separation_max_deg)
    clock.append(time.perf_counter())

    # The pipeline builds the zone for itself once; only its identification counts here.
    first, *later = [
        acquire(batch, mission, sky).timings_us["identify"] * 1e-6 for batch in batches
    ]
    whole = []
    for batch in batches[1:]:
        started = time.perf_counter()
        acquire(batch, mission, sky)
        whole.append(time.perf_counter() - started)
    return ZoneTime(
        stars=len(zone.star),
        pairs=pairs.count,
        pairs_bytes=pairs.nbytes,
        generate_s=clock[1] - clock[0],
        first_s=clock[2] - clock[1] + first,
        later_s=tuple(later),
        batch_s=tuple(whole),
    )


def proportion(stars: int, pairs: int) -> float:
    """k_g: the share of all pairs of a zone's stars that are near enough to be seen together."""
    return pairs / (stars * (stars - 1) / 2.0)
