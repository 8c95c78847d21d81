"""Search for tracks: links points, and classifies each track.

Points that keep their place on a detector while the sky moves are linked first and removed; the
rest is linked on the sky.  Planets are recognised by their ephemeris.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from service.features.tracks.kernels import GATE
from service.features.tracks.linking import Batches, Indices, Link, Motion, Points, fit_motion, link
from service.sky.ephemeris import PLANETS, Planet, planet_place
from service.vectors import ARCSEC_PER_RADIAN, Vector, from_ra_dec, to_ra_dec

TrackKind = Literal["moving", "planet", "fixed_on_sky", "fixed_on_detector", "fixed"]
SIGMAS = 4.0
DAY_S = 86_400.0


@dataclass(frozen=True, eq=False)
class Track:
    """A track: its kind, its motion on the sky, and the indices (n,) of its points.

    `planet` is a planet's name and `planet_offset_arcsec` its distance from the ephemeris; None for
    other kinds.  `log10_expected` is the expected number of equally good tracks of random points.
    """

    kind: TrackKind
    motion: Motion
    own: Indices
    log10_expected: float
    planet: str | None = None
    planet_offset_arcsec: float | None = None


def find_tracks(points: Points, batches: Batches) -> list[Track]:
    """Search for tracks of at least four points; the track with the most points is first.

    Raises `BadInput` for too many points.
    """
    found = [_resting(points, each, batches) for each in _on_detectors(points, len(batches.time))]
    set_aside = {k for each in found for k in each.own.tolist()}
    rest = np.array([k for k in range(len(points)) if k not in set_aside], dtype=np.int64)
    left = points.taken(rest)
    for each in link(left, len(batches.time)):
        own = rest[each.own]
        found.append(_moving(points, replace(each, own=own), batches))
    return sorted(found, key=lambda each: -len(each.own))


def _on_detectors(points: Points, batches: int) -> list[Link]:
    """Links of points that keep their place on a tracker's detector."""
    found = []
    for tracker in range(len(points.trackers)):
        own = np.flatnonzero(points.tracker == tracker)
        seen = points.taken(own)
        square = seen.sigma_rad[:, None, None] ** 2 * np.eye(3)
        seen = replace(seen, direction=seen.place, covariance=square)
        for each in link(seen, batches, rests=True):
            moved = fit_motion(
                *(seen.time_s[each.own], seen.direction[each.own], square[each.own]), moves=True
            )
            if moved.rate_chi_square < GATE:
                found.append(replace(each, own=own[each.own]))
    return found


def _on_sky(points: Points, own: Indices, *, moves: bool) -> Motion:
    return fit_motion(
        points.time_s[own], points.direction[own], points.covariance[own], moves=moves
    )


def _resting(points: Points, found: Link, batches: Batches) -> Track:
    """Classify points at rest on the detector: fixed there, a planet, or also fixed on the sky."""
    own = found.own
    motion = _on_sky(points, own, moves=True)
    on_detector = Track("fixed_on_detector", motion, own, found.log10_expected)
    if not _is_good(motion):
        return on_detector
    planet = _planet(motion, points, own, batches)
    if planet is not None:
        name, off_arcsec = planet
        return replace(on_detector, kind="planet", planet=name, planet_offset_arcsec=off_arcsec)
    if motion.rate_chi_square < GATE:
        return replace(on_detector, kind="fixed")
    return on_detector


def _moving(points: Points, found: Link, batches: Batches) -> Track:
    own = found.own
    track = Track("moving", found.motion, own, found.log10_expected)
    planet = _planet(found.motion, points, own, batches)
    if planet is not None:
        name, off_arcsec = planet
        return replace(track, kind="planet", planet=name, planet_offset_arcsec=off_arcsec)
    if found.motion.rate_chi_square < GATE:
        return replace(track, kind="fixed_on_sky")
    return track


def _is_good(motion: Motion) -> bool:
    """True if the points fit one motion: chi-square is at most four sigmas above its mean."""
    degrees = motion.degrees_of_freedom
    return motion.chi_square < degrees + SIGMAS * math.sqrt(2.0 * degrees)


def _planet(
    motion: Motion, points: Points, own: Indices, batches: Batches
) -> tuple[str, float] | None:
    """Planet that moves like a track, with its offset in arcsec; None if no planet does.

    The planet's directions at the first, middle and last batch must agree with the track, within
    the errors of ephemeris and track, and so must its rate.
    """
    places = points.batch[own[[0, len(own) // 2, len(own) - 1]]].tolist()
    time_s = points.time_s[own[[0, len(own) // 2, len(own) - 1]]]
    seen, _ = motion.at(time_s)
    sigma_rad = np.sqrt(np.trace(motion.spread(time_s), axis1=1, axis2=2))
    for planet in PLANETS:
        offs = _offsets_rad(planet, places, seen, sigma_rad, batches)
        if offs is not None:
            # The ephemeris's error is that of days: over a stretch it is one and the same.
            slack = SIGMAS * np.hypot(sigma_rad[0], sigma_rad[-1])
            drift = np.sqrt(np.sum((offs[-1] - offs[0]) ** 2))
            if drift <= slack + abs(time_s[-1] - time_s[0]) / DAY_S * np.sqrt(offs[1] @ offs[1]):
                return planet.name, float(np.sqrt(offs[1] @ offs[1]) * ARCSEC_PER_RADIAN)
    return None


def _offsets_rad(
    planet: Planet, places: list[int], seen: Vector, sigma_rad: Vector, batches: Batches
) -> Vector | None:
    """Observed minus computed directions (3, 3) in rad; None if one is beyond the errors."""
    offs = []
    for place, direction, sigma in zip(places, seen, sigma_rad.tolist(), strict=True):
        position = batches.position_km[place]
        known = None if np.isnan(position[0]) else position
        computed = planet_place(planet, batches.time[place], known)
        off = direction - computed.direction
        allowed = computed.error_arcsec / ARCSEC_PER_RADIAN + SIGMAS * sigma
        if off @ off > allowed**2:
            return None
        offs.append(off)
    return np.array(offs)


@dataclass(frozen=True)
class TrackFigures:
    """Numbers of a track at the middle of its time: directions in degrees, errors in arcsec.

    `rate_ra_arcsec_per_s` is along right ascension, with the cosine of declination.
    `chi_square` over `degrees_of_freedom` is about 1 where the sigmas are right.
    """

    time_s: float
    ra_deg: float
    dec_deg: float
    sigma_ra_arcsec: float
    sigma_dec_arcsec: float
    rate_ra_arcsec_per_s: float
    rate_dec_arcsec_per_s: float
    sigma_rate_ra_arcsec_per_s: float
    sigma_rate_dec_arcsec_per_s: float
    rate_arcsec_per_s: float
    sigma_rate_arcsec_per_s: float
    chi_square: float
    degrees_of_freedom: int
    magnitude_mag: float | None
    sigma_magnitude_mag: float | None


def figures(track: Track, points: Points) -> TrackFigures:
    """Compute the published numbers of a track: direction, rate, magnitude and their sigmas."""
    motion = track.motion
    ra, dec = (float(each) for each in to_ra_dec(motion.direction))
    east = from_ra_dec(ra + 90.0, 0.0)
    local = np.stack([east, np.cross(motion.direction, east)])
    turn = local @ motion.axes.T
    both = np.kron(np.eye(2), turn)
    sigma = np.sqrt(np.diagonal(both @ motion.covariance @ both.T)) * ARCSEC_PER_RADIAN
    sigma_ra, sigma_dec, sigma_rate_ra, sigma_rate_dec = sigma.tolist()
    rate_ra, rate_dec = (local @ motion.rate * ARCSEC_PER_RADIAN).tolist()
    magnitude = points.magnitude_mag[track.own]
    magnitude = magnitude[np.isfinite(magnitude)]
    count = len(magnitude)
    return TrackFigures(
        time_s=motion.time_s,
        ra_deg=ra,
        dec_deg=dec,
        sigma_ra_arcsec=sigma_ra,
        sigma_dec_arcsec=sigma_dec,
        rate_ra_arcsec_per_s=rate_ra,
        rate_dec_arcsec_per_s=rate_dec,
        sigma_rate_ra_arcsec_per_s=sigma_rate_ra,
        sigma_rate_dec_arcsec_per_s=sigma_rate_dec,
        rate_arcsec_per_s=math.hypot(rate_ra, rate_dec),
        # The first axis is along the rate.
        sigma_rate_arcsec_per_s=math.sqrt(motion.covariance[2, 2]) * ARCSEC_PER_RADIAN,
        chi_square=motion.chi_square,
        degrees_of_freedom=motion.degrees_of_freedom,
        magnitude_mag=float(magnitude.mean()) if count else None,
        sigma_magnitude_mag=(
            float(np.std(magnitude, ddof=1)) / math.sqrt(count) if count > 1 else None
        ),
    )
