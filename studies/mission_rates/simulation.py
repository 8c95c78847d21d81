"""The views of a sweep through the pipeline, zone by zone, on all cores.

Every setting sees the same zones, views, stars and draws, as every run of the paper did: the
difference between two settings is theirs, not that of the draw.  They depend on the seed and the
zone's number alone, not on how the work is shared out.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from service.acquire import BatchColumns, acquire_many
from service.advice.intervals import Interval, share_of
from service.missions.mission import Identifier
from service.simulate.motion import random_axis, tilted
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import open_catalog
from service.sky.model import SkyModel
from service.vectors import Vector, from_ra_dec, to_ra_dec
from studies.mission_rates.settings import Errors, Setting, sigobs_arcsec
from studies.paper_1994.printed import PrintedCounts, Reference, Run, World
from studies.paper_1994.tally import (
    AMBIGUOUS,
    CORRECT,
    MISIDENTIFIED,
    UNMATCHED,
    Integers,
    counts_of,
)
from studies.paper_1994.views import EPOCH, View, batch_of, draw_zone
from studies.workers import mapping, number_of

CACHE_BYTES = 64 << 20
LEAST_SIGMA_MAG = 1e-9
"""The sigma in place of no error at all, by which the bound could not be divided."""
OUTCOMES = {
    "unique_right": CORRECT,
    "ambiguous": AMBIGUOUS,
    "unmatched": UNMATCHED,
    "wrong": MISIDENTIFIED,
}


@dataclass(frozen=True)
class Plan:
    """The simulated cases: zones about axes drawn over the sky, or within an angle of a direction.

    `within_deg` is RCCAT; `tests` are those switched on or off.  Each zone has `views` fields
    of view with at most `most_stars` observed stars each.  All settings are of one tracker.
    """

    settings: tuple[Setting, ...]
    identifier: Identifier
    tests: Mapping[str, bool]
    direction_deg: tuple[float, float] | None
    within_deg: float
    zones: int
    views: int
    most_stars: int
    seed: int


@dataclass(frozen=True)
class Rates:
    """The shares of a setting's stars by outcome, with their 95 % intervals.

    The stars of a zone are not independent: the intervals count zones.
    """

    setting: Setting
    stars: int
    unique_right: Interval
    ambiguous: Interval
    unmatched: Interval
    wrong: Interval


def simulate(
    plan: Plan, catalog: Path | None = None, processes: int | None = None, quiet: bool = False
) -> list[Rates]:
    """The rates of every setting.

    `catalog` is the site's own star catalog.  `processes` is the number of workers, all cores
    where it is None; 1 works in this process.  Raises `BadInput` where a zone would hold too
    many pairs.
    """
    count = min(number_of(processes), plan.zones)
    task = partial(_zone_counts, plan, catalog)
    with (
        tqdm(total=plan.zones, unit="zone", disable=True if quiet else None) as bar,
        mapping(count) as mapped,
    ):
        found = []
        for counts in mapped(task, range(plan.zones)):
            found.append(counts)
            bar.update()
    by_setting = np.stack(found, axis=1)
    return [_rates(*each) for each in zip(plan.settings, by_setting, strict=True)]


def _rates(setting: Setting, counts: Integers) -> Rates:
    """The rates of counts (zones, 4)."""
    total = counts.sum(axis=1)
    zone = np.repeat(np.arange(len(total)), total)
    kind = np.concatenate([np.repeat(np.arange(4), row) for row in counts])
    shares = {name: share_of(kind == outcome, zone) for name, outcome in OUTCOMES.items()}
    return Rates(setting=setting, stars=int(total.sum()), **shares)


def zone_counts(plan: Plan, number: int, sky: SkyModel) -> Integers:
    """The outcome of one zone's stars: counts (settings, 4) in the order of `tally`."""
    counts = np.zeros((len(plan.settings), 4), np.int64)
    for off_axis_deg in {setting.errors.off_axis_deg for setting in plan.settings}:
        views = list(_views(plan, number, off_axis_deg, sky))
        for place, setting in enumerate(plan.settings):
            if setting.errors.off_axis_deg == off_axis_deg:
                run, mission = _run(setting.errors), setting.mission
                batches = [batch_of(view, run, mission, plan.identifier) for view in views]
                found = acquire_many(BatchColumns.of(batches), mission, sky)
                for row, view in enumerate(views):
                    identified = found.acquisition(row).trackers[0].identification
                    counts[place] += counts_of(identified, view.star)
    return counts


def _views(plan: Plan, number: int, off_axis_deg: float, sky: SkyModel) -> Iterator[View]:
    rng = np.random.default_rng([plan.seed, number])
    mission = plan.settings[0].mission
    ra_deg, dec_deg = to_ra_dec(_axis(plan, rng))
    world = World(
        name=mission.name,
        mission=mission.name,
        off_axis_deg=off_axis_deg,
        zones=1,
        views=plan.views,
        axis_deg=(float(ra_deg), float(dec_deg)),
    )
    run_catalog = sky.run_catalog(mission, EPOCH)
    drawn = draw_zone(world, number, mission, run_catalog, rng, plan.most_stars)
    return (view for view in drawn if len(view.star))


def _axis(plan: Plan, rng: np.random.Generator) -> Vector:
    if plan.direction_deg is None:
        return random_axis(rng)
    direction = from_ra_dec(*plan.direction_deg)
    half_sine = math.sin(math.radians(plan.within_deg) / 2.0) * math.sqrt(rng.uniform())
    return tilted(direction, 2.0 * math.asin(half_sine), rng)


def _run(errors: Errors) -> Run:
    """The errors as those of a run of which nothing is printed."""
    angles = (3600.0 * errors.phi_deg, 3600.0 * errors.theta_deg, 3600.0 * errors.psi_deg)
    return Run(
        table="",
        run="",
        world="",
        rotation_arcsec=angles,
        sigma_arcsec=sigobs_arcsec(errors),
        sigma_mag=max(errors.magnitude_error_mag, LEAST_SIGMA_MAG),
        bound_mag=errors.magnitude_bound_mag,
        geometry=True,
        printed=PrintedCounts(0, 0, 0, 0),
        reference=Reference(0, 0.0, 0.0, 0.0, 0.0, 0.0),
    )


def _zone_counts(plan: Plan, catalog: Path | None, number: int) -> Integers:
    return zone_counts(plan, number, _sky(catalog))


@cache
def _sky(catalog: Path | None) -> SkyModel:
    return SkyModel(open_catalog(catalog), LruCache(CACHE_BYTES))
