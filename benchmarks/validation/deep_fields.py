"""Verified identification in fields of many stars, most of them outside the zone.

python -m benchmarks deep_fields
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, at_most
from benchmarks.record import CORE, SIMULATOR
from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.acquire import acquire
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.vectors import unit
from studies.paper_1994.printed import the_paper
from studies.paper_1994.views import EPOCH, batch_of, draw_zone, paper_mission

FIELDS, QUICK_FIELDS = 30, 4
STARS = (10, 30, 100, 250)
FAINTEST_MAG = 7.5
"""Magnitude of the faintest drawn stars: the catalog may lack fainter ones."""
LEAST_RIGHT, LEAST_FIELDS = 0.97, 0.98


@dataclass(frozen=True)
class Found:
    """Fields with one number of stars, and their stars within the zone.

    `fields_named` counts the fields with more than half of these stars named.
    """

    stars: int
    fields: int
    fields_named: int
    inside: int
    right: int
    wrong: int


def measured(stars: int, fields: int, seed: int, step: Callable[[int], object] = int) -> Found:
    """Fields along the band of SOHO, each of the stars nearest to its boresight."""
    sky, mission = SkyModel(load_embedded(), LruCache(512 << 20)), paper_mission("SOHO")
    catalog = sky.run_catalog(mission, EPOCH)
    run = the_paper().runs_of([3])[0]
    world = replace(the_paper().worlds["band_forest"], views=fields)
    rng = np.random.default_rng(seed)
    seen = named = inside = right = wrong = 0
    for view in draw_zone(world, 0, mission, catalog, rng, 12):
        middle = unit(view.direction.mean(axis=0))
        star = np.argsort(-(catalog.direction @ middle), kind="stable")[:stars]
        field = replace(
            view,
            star=star,
            direction=catalog.direction[star],
            magnitude_mag=catalog.magnitude_mag[star],
            radius=rng.normal(size=stars),
            bearing_rad=rng.uniform(0.0, math.tau, stars),
            share=rng.uniform(size=stars),
        )
        acquisition = acquire(batch_of(field, run, mission, "verified"), mission, sky)
        (tracker,) = acquisition.trackers
        found, region = tracker.identification, tracker.region
        assert region is not None
        polar_deg = np.degrees(np.arccos(np.clip(field.direction @ region.axis, -1.0, 1.0)))
        there = np.asarray(
            (polar_deg >= region.least_deg)
            & (polar_deg <= region.most_deg)
            & (field.magnitude_mag < FAINTEST_MAG)
        )
        same = found.star == star
        seen, inside = seen + 1, inside + int(there.sum())
        right += int((same & there).sum())
        wrong += int((found.unique & ~same).sum())
        named += int(2 * (same & there).sum() > there.sum())
        step(1)
    return Found(stars, seen, named, inside, right, wrong)


def _measured(quick: bool, seed: int) -> tuple[list[Found], list[Bound]]:
    fields = QUICK_FIELDS if quick else FIELDS
    with tqdm(total=fields * len(STARS), desc="deep fields", unit="field") as bar:
        found = [measured(stars, fields, seed, bar.update) for stars in STARS]
    bounds = []
    for each in found:
        of = f"of {each.stars} stars in the field"
        bounds += [
            at_least(f"share named rightly, {of}", each.right / each.inside, LEAST_RIGHT),
            at_least(f"fields named, {of}", each.fields_named / each.fields, LEAST_FIELDS),
            at_most(f"stars named wrongly, {of}", each.wrong, 0),
        ]
    return found, bounds


def run(quick: bool, seed: int) -> Report:
    """Benchmark of deep fields: shares named rightly and wrongly."""
    found, bounds = _measured(quick, seed)
    figures: dict[str, object] = {
        f"{each.stars} stars": f"{each.right:,} of {each.inside:,} rightly, {each.wrong} wrongly"
        for each in found
    }
    return Report("deep_fields", figures, bounds)


def write(quick: bool, seed: int) -> Written:
    """Section of the verification about deep fields."""
    found, bounds = _measured(quick, seed)
    rows = [
        [
            f"{each.stars}",
            f"{each.fields:,}",
            f"{each.inside:,}",
            f"{100.0 * each.right / each.inside:.2f}",
            f"{each.fields - each.fields_named:,}",
            f"{each.wrong:,}",
        ]
        for each in found
    ]
    head = ["stars", "fields", "in the zone", "right %", "fields of which half or less", "wrong"]
    text = f"""
Fields of one tracker anywhere along the band of SOHO, of all stars nearest to the boresight: the
more there are, the fewer of the brightest lie in the band. The search for hypotheses begins with
pairs of the twelve brightest that the presumed attitude puts into the zone. Counted are the
stars of the zone that are brighter than V {FAINTEST_MAG}.

{table(head, rows, 6)}
"""
    return Written(text, bounds)


SECTION = Section("Deep fields", write, (*CORE, *SIMULATOR, "studies/paper_1994"))
