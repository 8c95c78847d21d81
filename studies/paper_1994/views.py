"""Simulator of the paper: random zones, fields of view within them, stars, and errors.

All runs of a world see the same zones, views, stars and random draws, as the paper began every run
with the same seed; only the sizes of the errors differ.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri

from service import vectors
from service.missions.mission import Band, Identifier, Mission, load_missions
from service.observations.batch import ObservationBatch, Options, QuaternionPrior, TrackerStars
from service.simulate.motion import across, pointed, random_axis
from service.simulate.sightings import in_field
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import sun_direction
from service.times import parse_utc
from studies.paper_1994.printed import Run, World

MOST_STARS = 5
EPOCH = parse_utc("2000-01-01T12:00:00Z")
"""Time of all views, which use run catalogs of 2000, even with the Sun's place of 1995."""


@cache
def paper_mission(name: str) -> Mission:
    """Shipped mission with the catalog of the paper's prototype.

    The prototype read "all stars down to" a magnitude from a catalog of stars: a fainter star was
    missing, and its light brightened no other star.
    """
    settings = load_missions()[name].model_dump()
    settings["catalog"]["merge_limit_mag"] = settings["catalog"]["magnitude_limit_mag"]
    return Mission.model_validate(settings)


@dataclass(frozen=True)
class View:
    """One field of view with its stars, and the random draws for their errors.

    `axis` is the zone's; `attitude` the true one, inertial to body; `star` the
    rows in the run catalog.  `radius` is a normal deviate, `bearing_rad` and
    `share` are uniform over the circle and over the unit interval.
    """

    axis: vectors.Vector
    attitude: vectors.Matrix
    star: npt.NDArray[np.intp]
    direction: vectors.Vector
    magnitude_mag: vectors.Vector
    radius: vectors.Vector
    bearing_rad: vectors.Vector
    share: vectors.Vector

    def seen(self, run: Run) -> tuple[vectors.Vector, vectors.Vector]:
        """Directions (n, 3), inertial by the erroneous attitude, and magnitudes, with noise."""
        radius = run.sigma_arcsec / vectors.ARCSEC_PER_RADIAN * self.radius[:, None]
        aside, above = across(self.direction)
        bearing = self.bearing_rad[:, None]
        sideways = np.cos(bearing) * aside + np.sin(bearing) * above
        moved = np.cos(radius) * self.direction + np.sin(radius) * sideways
        # v' = A^T R A v
        return moved @ self.attitude.T @ rotation(run).T @ self.attitude, self._magnitudes(run)

    def _magnitudes(self, run: Run) -> vectors.Vector:
        # A Gaussian error drawn again while it lies beyond the bound is one cut off there.
        tail = ndtr(-run.bound_mag / run.sigma_mag)
        error = ndtri(tail + (1.0 - 2.0 * tail) * self.share)
        return np.asarray(self.magnitude_mag + run.sigma_mag * error)


def rotation(run: Run) -> vectors.Matrix:
    """Attitude error R1(psi) R2(theta) R3(phi): phi about Z first, psi about X last."""
    phi, theta, psi = (arcsec / 3600.0 for arcsec in run.rotation_arcsec)
    return (
        vectors.coordinate_rotation(0, psi)
        @ vectors.coordinate_rotation(1, theta)
        @ vectors.coordinate_rotation(2, phi)
    )


def draw_zone(
    world: World,
    number: int,
    mission: Mission,
    catalog: RunCatalog,
    rng: np.random.Generator,
    most_stars: int = MOST_STARS,
) -> Iterator[View]:
    """Draw the views of one zone; `number` selects the Sun's date if the world has several."""
    axis = _axis(world, number, rng)
    for _ in range(world.views):
        yield _view(world, axis, mission, catalog, rng, most_stars)


def _axis(world: World, number: int, rng: np.random.Generator) -> vectors.Vector:
    if world.axis_deg is not None:
        return vectors.from_ra_dec(*world.axis_deg)
    if world.sun_dates:
        date = world.sun_dates[number % len(world.sun_dates)]
        return sun_direction(parse_utc(f"{date}T00:00:00Z"), None)
    return random_axis(rng)


def _view(
    world: World,
    axis: vectors.Vector,
    mission: Mission,
    catalog: RunCatalog,
    rng: np.random.Generator,
    most_stars: int,
) -> View:
    tracker = mission.trackers[0]
    near = _within(axis, math.radians(world.off_axis_deg), rng)
    # Body X lies near the zone's axis; the rest of the attitude is random.
    attitude = pointed(mission.axis_body, near, rng.uniform(0.0, math.tau))
    boresight = attitude.T @ tracker.body_from_tracker[:, 2]
    edge = math.cos(math.radians(tracker.field_of_view_radius_deg))
    inside = np.flatnonzero(catalog.direction @ boresight >= edge)
    if tracker.field_of_view_deg is not None:
        tracker_from_inertial = tracker.body_from_tracker.T @ attitude
        inside = inside[in_field(tracker, catalog.direction[inside] @ tracker_from_inertial.T)]
    star = rng.permutation(inside)[:most_stars]
    count = len(star)
    return View(
        axis=axis,
        attitude=attitude,
        star=star,
        direction=catalog.direction[star],
        magnitude_mag=catalog.magnitude_mag[star],
        radius=rng.normal(size=count),
        bearing_rad=rng.uniform(0.0, math.tau, count),
        share=rng.uniform(size=count),
    )


def _within(axis: vectors.Vector, radius_rad: float, rng: np.random.Generator) -> vectors.Vector:
    """Random direction, uniform over the cap about an axis."""
    # 1 - cos, so that small caps lose no digits.
    height = rng.uniform(0.0, 2.0 * math.sin(radius_rad / 2.0) ** 2)
    sine = math.sqrt(height * (2.0 - height))
    bearing = rng.uniform(0.0, math.tau)
    aside, above = across(axis)
    sideways = math.cos(bearing) * aside + math.sin(bearing) * above
    return vectors.unit((1.0 - height) * axis + sine * sideways)


def batch_of(view: View, run: Run, mission: Mission, identifier: Identifier) -> ObservationBatch:
    """Observation batch of a view, as sent to the service.

    The a priori attitude has body X on the zone's axis, and the sensor vectors are rotated by it to
    the paper's inertial ones.
    """
    tracker = mission.trackers[0]
    direction, magnitude = view.seen(run)
    prior = pointed(mission.axis_body, view.axis, 0.0)
    count = len(view.star)
    tests = {} if run.geometry else {"cross_product": False}
    if not run.geometry and isinstance(mission.zone, Band):
        tests["pole"] = False
    none = np.full(count, np.nan)
    return ObservationBatch(
        spacecraft=mission.name,
        batch=f"{run.table} {run.run}",
        run="paper",
        time=EPOCH,
        a_priori=QuaternionPrior(vectors.quaternion_from_matrix(prior)),
        body_rates_deg_per_s=np.zeros(3),
        velocity_km_per_s=None,
        aberration="ignore",
        observations=(
            TrackerStars(
                tracker=tracker.name,
                vector=direction @ prior.T @ tracker.body_from_tracker,
                angles_deg=np.full((count, 2), np.nan),
                magnitude_mag=magnitude,
                time_offset_s=np.zeros(count),
                sigma_arcsec=none,
            ),
        ),
        options=Options(identifier=identifier, tests=tests, zone_grid_deg=0.0),
    )
