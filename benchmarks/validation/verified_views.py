"""Views with known truth for the benchmarks of verified identification.

The views come from the paper's simulator, with the errors of a condition, and go through the whole
pipeline.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import count

import numpy as np
import numpy.typing as npt
from scipy.stats import beta

from service.acquire import acquire
from service.identify.identification import Identification
from service.missions.mission import Band, Identifier, Mission
from service.simulate.motion import random_axis, tilted
from service.sky.cache import LruCache
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.times import Utc
from service.vectors import Vector, read_only
from studies.paper_1994.printed import Run, World, the_paper
from studies.paper_1994.views import EPOCH, View, batch_of, draw_zone, paper_mission

Rows = npt.NDArray[np.intp]

SHELF_BYTES = 128 << 20
VIEWS_PER_BAND = 50
"""Views per band, whose pairs take longer to list than many views to identify; a cap has ten.

Fifty fields anywhere along a band hardly share a star.
"""
# phi, theta, psi in arcsec; radial position error in arcsec; magnitude error and its bound.
ERRORS = {
    ("nominal", "XTE"): ((42.0, 42.0, 60.0), 3.0, 0.1, 0.6),
    ("nominal", "SOHO"): ((360.0, 360.0, 648000.0), 3.0, 0.1, 0.6),
    ("serious", "XTE"): ((360000.0, 40.0, 60.0), 12.0, 0.3, 6.0),
    ("serious", "SOHO"): ((10800.0, 10800.0, 10800.0), 12.0, 0.3, 6.0),
}


PRIOR_ERRORS = {
    ("nominal", "XTE"): '42", 42", 60"',
    ("nominal", "SOHO"): "6', 6', 180°",
    ("serious", "XTE"): '100°, 40", 60"',
    ("serious", "SOHO"): "3°, 3°, 3°",
}
"""Texts of the rotations of `ERRORS` for a table."""


@dataclass(frozen=True)
class Condition:
    """Condition of views: worlds of the paper, numbers of stars, and errors.

    A view has `stars` stars, or any number from `stars` to `most_stars`; `spurious` of them are
    anywhere in the field.  With `prior_off_deg` the a priori attitude is off about a random axis by
    an angle drawn evenly up to `prior_off_deg`, instead of by the fixed angles of `errors`.  The
    share `missing` of the run catalog is withheld from the identifier.  Unless `merged`, the
    catalog and the sky have every component of a double separately.
    """

    worlds: tuple[str, ...]
    errors: str = "nominal"
    stars: int = 5
    most_stars: int | None = None
    spurious: int = 0
    missing: float = 0.0
    offset_mag: float = 0.0
    merged: bool = True
    prior_off_deg: float | None = None

    @property
    def prior_error(self) -> str:
        """Text of the error of the a priori attitude for a table."""
        if self.prior_off_deg is not None:
            return f"0 to {self.prior_off_deg:g}° about any axis"
        missions = dict.fromkeys(the_paper().worlds[world].mission for world in self.worlds)
        return "; ".join(PRIOR_ERRORS[self.errors, mission] for mission in missions)


@dataclass(frozen=True)
class Judged:
    """View with the results for its stars, and each star's true run catalog row, or -1."""

    found: Identification
    truth: Rows

    def first(self) -> tuple[Rows, Vector]:
        """Likeliest row of every star, named or first rival, and its probability.

        -1 and 0 without one.
        """
        star = self.found.star.copy()
        probability = np.where(self.found.unique, self.found.probability, 0.0)
        for k, rivals in enumerate(self.found.rivals):
            if rivals:
                star[k], probability[k] = rivals[0], self.found.rival_probability[k][0]
        return star, probability


@dataclass(frozen=True)
class ThinnedSky(SkyModel):
    """Sky whose run catalogs lack some stars, the same ones for every batch."""

    kept: float
    seed: int

    def run_catalog(self, mission: Mission, time: Utc) -> RunCatalog:
        """Run catalog without the missing stars."""
        return thinned(super().run_catalog(mission, time), self.kept, self.seed)


@lru_cache(maxsize=8)
def thinned(catalog: RunCatalog, kept: float, seed: int) -> RunCatalog:
    """Run catalog with a random share of its stars."""
    rows = kept_rows(catalog, kept, seed)
    return replace(
        catalog,
        ra_deg=read_only(catalog.ra_deg[rows]),
        dec_deg=read_only(catalog.dec_deg[rows]),
        magnitude_mag=read_only(catalog.magnitude_mag[rows]),
        catalog_row=read_only(catalog.catalog_row[rows]),
        star_id=tuple(catalog.star_id[row] for row in rows),
        digest=f"{catalog.digest} thinned to {kept} by {seed}",
    )


def kept_rows(catalog: RunCatalog, kept: float, seed: int) -> Rows:
    """The rows of a run catalog that thinning leaves."""
    return np.flatnonzero(np.random.default_rng(seed).uniform(size=len(catalog)) < kept)


def judged_views(
    condition: Condition, views: int, seed: int, identifier: Identifier = "verified"
) -> Iterator[Judged]:
    """Identified views of a condition, in its worlds by turns."""
    catalog, cache = load_embedded(), LruCache(SHELF_BYTES)
    whole = SkyModel(catalog, cache)
    kept = 1.0 - condition.missing
    sky = ThinnedSky(catalog, cache, kept, seed) if condition.missing else whole
    worlds = [the_paper().worlds[name] for name in condition.worlds]
    drawn = [
        _drawn(condition, world, whole, np.random.default_rng([seed, place]))
        for place, world in enumerate(worlds)
    ]
    for number in range(views):
        place = number % len(worlds)
        view, run, mission = next(drawn[place])
        truth = view.star
        if condition.missing:
            run_catalog = whole.run_catalog(mission, EPOCH)
            position = np.full(len(run_catalog) + 1, -1)
            rows = kept_rows(run_catalog, kept, seed)
            position[rows] = np.arange(len(rows))
            truth = position[truth]
        acquired = acquire(batch_of(view, run, mission, identifier), mission, sky)
        yield Judged(acquired.trackers[0].identification, truth)


def _drawn(
    condition: Condition, world: World, sky: SkyModel, rng: np.random.Generator
) -> Iterator[tuple[View, Run, Mission]]:
    mission = _mission(world.mission, condition.merged)
    catalog = sky.run_catalog(mission, EPOCH)
    if isinstance(mission.zone, Band):
        world = replace(world, views=VIEWS_PER_BAND)
    rotation, sigma_arcsec, sigma_mag, bound_mag = ERRORS[condition.errors, world.mission]
    run = replace(
        the_paper().runs[0],
        world=world.name,
        rotation_arcsec=rotation,
        sigma_arcsec=sigma_arcsec,
        sigma_mag=sigma_mag,
        bound_mag=bound_mag,
        geometry=True,
    )
    most = condition.most_stars or condition.stars
    for zone in count():
        for view in draw_zone(world, zone, mission, catalog, rng, most):
            stars = int(rng.integers(condition.stars, most + 1))
            if len(view.star) >= stars:
                spoilt = _spoilt(_cut(view, stars), condition, mission, rng)
                if condition.prior_off_deg is None:
                    yield spoilt, run, mission
                else:
                    off_arcsec = rng.uniform(0.0, 3600.0 * condition.prior_off_deg)
                    phi, theta, psi = (off_arcsec * random_axis(rng)).tolist()
                    yield spoilt, replace(run, rotation_arcsec=(phi, theta, psi)), mission


def _mission(name: str, merged: bool) -> Mission:
    mission = paper_mission(name)
    if merged:
        return mission
    settings = mission.model_dump()
    settings["catalog"]["merge_within_arcsec"] = 0.0
    return Mission.model_validate(settings)


def _cut(view: View, stars: int) -> View:
    names = ("star", "direction", "magnitude_mag", "radius", "bearing_rad", "share")
    return replace(view, **{name: getattr(view, name)[:stars] for name in names})


def _spoilt(view: View, condition: Condition, mission: Mission, rng: np.random.Generator) -> View:
    """View with spurious stars anywhere in its field, and wrong magnitudes."""
    star, direction = view.star.copy(), view.direction.copy()
    tracker = mission.trackers[0]
    boresight = view.attitude.T @ tracker.body_from_tracker[:, 2]
    radius = np.radians(tracker.field_of_view_radius_deg)
    for k in rng.choice(len(star), condition.spurious, replace=False):
        star[k], direction[k] = -1, tilted(boresight, radius * np.sqrt(rng.uniform()), rng)
    magnitude = view.magnitude_mag + condition.offset_mag
    return replace(view, star=star, direction=direction, magnitude_mag=magnitude)


def interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Clopper-Pearson confidence interval of a share."""
    tail = (1.0 - confidence) / 2.0
    low = float(beta.ppf(tail, successes, trials - successes + 1)) if successes else 0.0
    high = float(beta.ppf(1.0 - tail, successes + 1, trials - successes))
    return low, high if successes < trials else 1.0
