"""Simulated star measurements of the trackers on a rotating, moving spacecraft.

Each star is at its apparent place for the moving spacecraft while the body turns with constant
rates, measured at its own time: carried to the batch's epoch, it lies where the attitude at the
epoch puts it.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from erfa import ufunc

from service.missions.mission import Band, Mission, RunCatalogSettings, Tracker
from service.missions.scan import CrossScan, Sweep
from service.observations.batch import Aberration
from service.observations.calibrate import measured_magnitudes
from service.observations.focal_plane import measured_angles_deg
from service.simulate.motion import across, random_axis, turned_by
from service.simulate.stretches import Stretch
from service.sky.catalog.run_catalog import (
    J2000_YEAR,
    Rows,
    RunCatalog,
    instrument_magnitude,
    merged_into,
)
from service.sky.catalog.star_catalog import Catalog, moved
from service.sky.ephemeris import KM_PER_AU, apparent
from service.times import Utc
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector, rotate_about, unit

TIME_OFFSET_S = 0.5
MAGNITUDE_CUT_SIGMA = 6.0
"""Sigmas at which magnitude errors are cut: 0.6 mag for a sigma of 0.1, the paper's RCMAG."""


@dataclass(frozen=True)
class Seen:
    """Stars in one tracker's field: true directions in tracker axes, each at its own time."""

    tracker: Tracker
    direction: Vector
    offset_s: Vector
    magnitude: Vector
    star: npt.NDArray[np.intp]
    """Row of the run catalog for each star (n,), -1 for a false star."""


# The sky as it is at one time and place, whatever a run catalog says of it.
#
# The service identifies with a catalog that serves a whole step of years, as
# seen from the solar system's barycentre.  The stars themselves have moved by
# then, and shift with the year; samples are drawn from these, so that what the
# service leaves out is in the errors that its answers are judged by.
#
# Light is not bent by the Sun here (4 mas at right angles to it), and stars
# that the run catalog rejects are never among those that a tracker picks.


@dataclass(frozen=True, eq=False)
class RealSky:
    """Stars of a run catalog with the catalog stars that each consists of, one or a blend.

    A tracker cannot separate stars that the mission merges: it sees one star, at the components'
    centre of light and with their total brightness.
    """

    catalog: Catalog
    run: RunCatalog
    component: Rows
    """Catalog rows of the components, grouped by star in the order of the run catalog."""
    first: Rows
    """Index of each star's first component, and the end of the last star's."""
    light: Vector
    """Light of each component in the mission's instrument."""
    magnitude_mag: Vector
    """Total magnitude of each star's components."""

    def directions(self, star: Rows, time: Utc, position_km: Vector) -> Vector:
        """Unit vectors (n, 3), ICRS, from a spacecraft at a geocentric position to given stars.

        Includes proper motion up to the given time, and parallax, but no aberration.
        """
        count = self.first[star + 1] - self.first[star]
        start = np.cumsum(count) - count
        place = np.arange(count.sum()) + np.repeat(self.first[star] - start, count)
        row, known = self.component[place], self.catalog
        geometric = moved(
            known.ra_deg[row],
            known.dec_deg[row],
            known.pm_ra_mas_per_year[row],
            known.pm_dec_mas_per_year[row],
            time.julian_year - J2000_YEAR,
        )
        # A star whose parallax is unknown, or was measured below zero, counts as infinitely far.
        parallax = np.fmax(known.parallax_mas[row], 0.0) / (1000.0 * ARCSEC_PER_RADIAN)
        seen = unit(geometric - parallax[:, None] * observer_position_au(time, position_km))
        return unit(np.add.reduceat(self.light[place, None] * seen, start) if len(star) else seen)


@lru_cache(maxsize=4)
def real_sky(catalog: Catalog, settings: RunCatalogSettings, run: RunCatalog) -> RealSky:
    """Group the catalog stars behind each star of a run catalog made with these settings."""
    alone = instrument_magnitude(catalog, settings.color_polynomial_mag)
    then = moved(
        catalog.ra_deg,
        catalog.dec_deg,
        catalog.pm_ra_mas_per_year,
        catalog.pm_dec_mas_per_year,
        run.epoch_year - J2000_YEAR,
    )
    leader = merged_into(then, alone, catalog.light_elsewhere, settings.merge_within_arcsec)
    star_of = np.full(len(catalog), -1)
    star_of[run.catalog_row] = np.arange(len(run))
    star = star_of[leader]
    itself = leader == np.arange(len(catalog))
    component = np.flatnonzero((star >= 0) & (itself | ~catalog.light_elsewhere))
    component = component[np.argsort(star[component], kind="stable")]
    first = np.searchsorted(star[component], np.arange(len(run) + 1))
    light = 10.0 ** (-0.4 * alone[component])
    magnitude = -2.5 * np.log10(np.add.reduceat(light, first[:-1]))
    return RealSky(catalog, run, component, first, light, magnitude)


def observer_position_au(time: Utc, position_km: Vector) -> Vector:
    """Barycentric position (3,) in au of a spacecraft at a geocentric position."""
    _, barycentric, _ = ufunc.epv00(*time.tt)
    return np.asarray(barycentric["p"] + position_km / KM_PER_AU)


@dataclass(frozen=True)
class BatchScene:
    """Conditions of one simulated batch: sky, time, motion, noise and errors."""

    mission: Mission
    sky: RealSky
    time: Utc
    position_km: Vector
    velocity_c: Vector
    aberration: Aberration
    rates_deg_per_s: Vector
    stretch: Stretch
    rng: np.random.Generator
    noise_arcsec: float | None = None
    false_stars: int = 0
    missing_share: float = 0.0

    def look(self, attitude: Matrix, most: int) -> tuple[Matrix, list[Seen]]:
        """An attitude, moved until a tracker sees a star, and the stars seen, at most `most` each.

        A spacecraft with a fixed pole only rolls for that.
        """
        keeps_pole = isinstance(self.mission.zone, Band)
        while True:
            seen = [self._visible(tracker, attitude, most) for tracker in self.mission.trackers]
            if any(len(each.star) for each in seen):
                return attitude, seen
            axis = self.mission.axis_body if keeps_pole else random_axis(self.rng)
            attitude = turned_by(attitude, axis * math.radians(3.0))

    def _visible(self, tracker: Tracker, attitude: Matrix, most: int) -> Seen:
        alignment = tracker.body_from_tracker
        radius = math.radians(tracker.field_of_view_radius_deg)
        # Use a wider radius: proper motion, aberration or rotation of the body may bring a star in.
        near = math.cos(min(radius + math.radians(0.2), math.pi))
        row = np.flatnonzero(self.sky.run.direction @ (attitude.T @ alignment[:, 2]) >= near)
        direction = self.sky.directions(row, self.time, self.position_km)
        if self.aberration != "applied_upstream":
            direction = apparent(direction, self.velocity_c, self.time)
        offset_s = np.round(self.rng.uniform(-TIME_OFFSET_S, TIME_OFFSET_S, len(row)), 3)
        turn = -np.radians(self.rates_deg_per_s) * offset_s[:, None]
        direction = rotate_about(turn, direction @ attitude.T) @ alignment
        inside = np.flatnonzero(in_field(tracker, direction) & self._bright_enough(tracker, row))
        chosen = self.rng.permutation(inside)
        if self.missing_share:
            chosen = chosen[self.rng.random(len(chosen)) >= self.missing_share]
        chosen = chosen[:most]
        star, direction = row[chosen], direction[chosen]
        magnitude = self.sky.magnitude_mag[star]
        is_spurious = self.stretch.kind == "spurious"
        if count := max(self.false_stars, int(self.stretch.size) if is_spurious else 0):
            false = self.rng.permutation(len(star))[:count]
            star[false] = -1
            direction[false] = anywhere_in_field(tracker, len(false), self.rng)
            magnitude[false] = self.rng.choice(self.sky.magnitude_mag, len(false))
        return Seen(tracker, direction, offset_s[chosen], magnitude, star)

    def _bright_enough(self, tracker: Tracker, row: Rows) -> npt.NDArray[np.bool_]:
        if tracker.limit_mag is None:
            return np.ones(len(row), dtype=bool)
        return np.asarray(self.sky.magnitude_mag[row] <= tracker.limit_mag)

    def measured(self, seen: Seen, as_angles: bool) -> list[dict[str, Any]]:
        """Noisy star measurements as sent to the service: vectors, angles or readings of a scan."""
        kind, size = self.stretch.kind, self.stretch.size
        own_arcsec = seen.tracker.sigma_arcsec if self.noise_arcsec is None else self.noise_arcsec
        sigma_arcsec = size if kind == "position_error" else own_arcsec
        sigma_mag = size if kind == "magnitude_error" else seen.tracker.magnitude_sigma_mag
        direction = shaken(seen.direction, sigma_arcsec / ARCSEC_PER_RADIAN, self.rng)
        error = self.rng.normal(size=len(seen.star))
        while (beyond := np.abs(error) > MAGNITUDE_CUT_SIGMA).any():
            error[beyond] = self.rng.normal(size=int(beyond.sum()))
        true_mag = seen.magnitude + sigma_mag * error
        sent_mag = measured_magnitudes(true_mag, seen.tracker.magnitudes)
        magnitudes = np.round(sent_mag, 3).tolist()
        if as_angles:
            angles = np.round(measured_angles_deg(direction, seen.tracker.calibration), 9).tolist()
            where = [{"h_deg": h, "v_deg": v} for h, v in angles]
        else:
            where = [{"vector": vector} for vector in np.round(direction, 10).tolist()]
        if seen.tracker.scan is not None:
            exact = direction if kind == "position_error" else seen.direction
            rates = seen.tracker.body_from_tracker.T @ np.radians(self.rates_deg_per_s)
            for k, magnitude_mag in enumerate(seen.magnitude.tolist()):
                reading = readings(seen.tracker, exact[k], rates, magnitude_mag, self.rng)
                where[k] = where[k] if reading is None else reading
        return [
            {**place, "magnitude": magnitude, "time_offset_s": offset_s}
            for place, magnitude, offset_s in zip(
                where, magnitudes, seen.offset_s.tolist(), strict=True
            )
        ]


def in_field(tracker: Tracker, direction: Vector) -> npt.NDArray[np.bool_]:
    """Mask of directions (n, 3), in tracker axes, within the tracker's field of view."""
    inside = direction[:, 2] >= tracker.least_cosine
    if tracker.field_of_view_deg is not None:
        tangent = np.tan(np.radians(tracker.field_of_view_deg) / 2.0)
        inside &= (np.abs(direction[:, :2]) <= tangent * direction[:, 2:]).all(axis=1)
    return np.asarray(inside)


def anywhere_in_field(tracker: Tracker, count: int, rng: np.random.Generator) -> Vector:
    """Random directions (count, 3), uniform over a tracker's field of view, in its axes."""
    radius_rad = math.radians(tracker.field_of_view_radius_deg)
    direction = anywhere(radius_rad, count, rng)
    while (outside := ~in_field(tracker, direction)).any():
        direction[outside] = anywhere(radius_rad, int(outside.sum()), rng)
    return direction


def anywhere(radius_rad: float, count: int, rng: np.random.Generator) -> Vector:
    """Random directions (count, 3), uniform over a circle about +Z."""
    z = rng.uniform(math.cos(radius_rad), 1.0, count)
    angle = rng.uniform(0.0, math.tau, count)
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def shaken(direction: Vector, sigma_rad: float, rng: np.random.Generator) -> Vector:
    """Add Gaussian noise of one sigma per tangent axis to directions (n, 3)."""
    aside, above = across(direction)
    noise = rng.normal(0.0, sigma_rad, (len(direction), 2))
    return unit(direction + noise[:, :1] * aside + noise[:, 1:] * above)


IMAGE_SIGMA_SAMPLES = 1.2
LIGHT_OVER_NOISE = 300.0
"""Ratio of a star's summed samples at magnitude `LIGHT_AT_MAG` to the noise of one sample."""
LIGHT_AT_MAG, FAINTEST_MAG = 5.0, 7.5
FULL_SHARE = 0.8
MOST_STEPS_OFF = 2.0
_ROUNDS = 20


def readings(
    tracker: Tracker,
    direction: Vector,
    rates_rad_per_s: Vector,
    magnitude_mag: float,
    rng: np.random.Generator,
) -> dict[str, Any] | None:
    """Simulated noisy readings of a scanning tracker for one star; None if the scan gives none.

    `direction` (3,) is in tracker axes, at the star's time; a sweep begins then, and the body turns
    on with `rates_rad_per_s` (3,), about the tracker's axes.  None if the scan does not reach the
    star, and for a raster, which does not report single stars.
    """
    if isinstance(tracker.scan, CrossScan):
        return _counts(tracker, tracker.scan, direction, magnitude_mag, rng)
    if isinstance(tracker.scan, Sweep):
        return _times(tracker, tracker.scan, direction, rates_rad_per_s, rng)
    return None


def _counts(
    tracker: Tracker,
    scan: CrossScan,
    direction: Vector,
    magnitude_mag: float,
    rng: np.random.Generator,
) -> dict[str, Any]:
    angles = measured_angles_deg(direction[None], tracker.calibration)[0]
    step_deg = scan.step_arcsec / 3600.0
    nominal = np.round(angles + rng.uniform(-MOST_STEPS_OFF, MOST_STEPS_OFF, 2) * step_deg, 6)
    brightness = 10.0 ** (0.4 * (LIGHT_AT_MAG - min(magnitude_mag, FAINTEST_MAG)))
    light = LIGHT_OVER_NOISE * scan.noise_counts * brightness
    if scan.saturation_counts is not None:
        room = FULL_SHARE * (scan.saturation_counts - scan.background_counts)
        light = min(light, room * IMAGE_SIGMA_SAMPLES * math.sqrt(math.tau))
    samples = np.arange(scan.samples) - scan.samples // 2
    star: dict[str, Any] = {"h_deg": float(nominal[0]), "v_deg": float(nominal[1])}
    for axis, off in zip("hv", (angles - nominal) / step_deg, strict=True):
        image = np.exp(-0.5 * ((samples - off) / IMAGE_SIGMA_SAMPLES) ** 2)
        counts = scan.background_counts + light * image / image.sum()
        variance = np.full(scan.samples, scan.noise_counts**2)
        if scan.gain_e_per_count is not None:
            variance += counts / scan.gain_e_per_count
        noisy = counts + rng.normal(0.0, np.sqrt(variance))
        star[f"{axis}_counts"] = np.maximum(np.round(noisy, 1), 0.0).tolist()
    return star


def _times(
    tracker: Tracker, scan: Sweep, direction: Vector, rates: Vector, rng: np.random.Generator
) -> dict[str, Any] | None:
    star: dict[str, Any] = {}
    for axis, after_s in ((0, 0.0), (1, scan.v_after_s)):
        seconds = []
        for wire_deg in scan.wires_deg:
            passed_s = 0.0
            # The star moves much slower than the sweep: a fixed point is reached in a few rounds.
            for _ in range(_ROUNDS):
                turned = rotate_about(-rates * (after_s + passed_s), direction[None])
                angle_deg = measured_angles_deg(turned, tracker.calibration)[0, axis]
                passed_s = (angle_deg + wire_deg - scan.start_deg) / scan.rate_deg_per_s
            seconds.append(passed_s + rng.normal(0.0, scan.time_sigma_s))
        if not 0.0 <= min(seconds) <= max(seconds) <= scan.duration_s:
            return None
        star[f"{'hv'[axis]}_times"] = [round(each / scan.time_unit_s, 6) for each in seconds]
    return star
