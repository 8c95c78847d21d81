"""Verified identification without prior knowledge: the zone is the whole sky.

python -m benchmarks whole_sky
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from msgspec import structs
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, at_most
from benchmarks.record import CORE, SIMULATOR
from benchmarks.report import Report
from benchmarks.sections import Section, Written
from service.acquire import acquire
from service.missions.mission import Mission
from service.observations.batch import QuaternionPrior
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from studies.paper_1994.printed import the_paper
from studies.paper_1994.views import EPOCH, batch_of, draw_zone, paper_mission

VIEWS, QUICK_VIEWS = 10_000, 100
STARS = 5
LEAST_RIGHT, MOST_WRONG_VIEWS = 0.999, 1e-4


@dataclass(frozen=True)
class Found:
    """Numbers of stars and views, and of their results."""

    views: int
    stars: int
    right: int
    wrong: int
    wrong_views: int


def whole_sky_mission() -> Mission:
    """Mission with SOHO's tracker and run catalog, and a cap of 180 degrees."""
    settings = paper_mission("SOHO").model_dump()
    settings["name"] = "WHOLE-SKY"
    settings["zone"] = {"kind": "cap", "axis_body": [0.0, 0.0, 1.0], "radius_deg": 180.0}
    settings["tests"]["pole"] = False
    return Mission.model_validate(settings)


def measured(views: int, seed: int, step: Callable[[int], object] = int) -> Found:
    """Results of views of random attitudes, with a constant, meaningless a priori attitude."""
    sky, mission = SkyModel(load_embedded(), LruCache(512 << 20)), whole_sky_mission()
    catalog = sky.run_catalog(mission, EPOCH)
    world = replace(the_paper().worlds["cap"], views=1)
    run = replace(the_paper().runs[0], rotation_arcsec=(0.0, 0.0, 0.0))
    rng = np.random.default_rng(seed)
    nothing = QuaternionPrior(np.array([0.0, 0.0, 0.0, 1.0]))
    seen = right = wrong = wrong_views = 0
    for number in count():
        (view,) = draw_zone(world, number, mission, catalog, rng)
        if len(view.star) < STARS:
            continue
        batch = structs.replace(batch_of(view, run, mission, "verified"), a_priori=nothing)
        found = acquire(batch, mission, sky).trackers[0].identification
        same = found.star == view.star
        right += int((found.unique & same).sum())
        amiss = int((found.unique & ~same).sum())
        wrong, wrong_views, seen = wrong + amiss, wrong_views + (amiss > 0), seen + 1
        step(1)
        if seen == views:
            break
    return Found(seen, STARS * seen, right, wrong, wrong_views)


def _measured(quick: bool, seed: int) -> tuple[Found, list[Bound]]:
    views = QUICK_VIEWS if quick else VIEWS
    with tqdm(total=views, desc="whole sky", unit="view") as bar:
        found = measured(views, seed, bar.update)
    allowed = max(1, int(MOST_WRONG_VIEWS * found.views))
    return found, [
        at_least("share of the stars named rightly", found.right / found.stars, LEAST_RIGHT),
        at_most("views with a star named wrongly", found.wrong_views, allowed),
        at_most("stars named wrongly", found.wrong, STARS * allowed),
    ]


def _figures(found: Found) -> dict[str, object]:
    share = found.right / found.stars
    return {
        "views": found.views,
        "stars named rightly": f"{found.right:,} of {found.stars:,}, {share:.3%}",
        "stars named wrongly": found.wrong,
        "views with a wrong star": found.wrong_views,
    }


def run(quick: bool, seed: int) -> Report:
    """Benchmark of the whole sky: shares right and wrong."""
    found, bounds = _measured(quick, seed)
    return Report("whole_sky", _figures(found), bounds)


def write(quick: bool, seed: int) -> Written:
    """Section of the verification about the whole sky."""
    found, bounds = _measured(quick, seed)
    text = f"""
The same identifier where nothing is known of the attitude: the zone is a cap of 180°, which a
mission file may ask for, with all stars to V 8 and their pairs to 4°; a field of 2° radius, five
stars, 3 arcsec, 0.1 mag. The heavy-tailed prior has a uniform share, which then is all there is.

Of {found.views:,} views {found.right:,} of {found.stars:,} stars are named rightly, and
{found.wrong:,} wrongly.
"""
    return Written(text, bounds)


SECTION = Section("Nothing known beforehand", write, (*CORE, *SIMULATOR, "studies/paper_1994"))
