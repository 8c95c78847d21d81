"""Checks of a mission file for settings that are valid but unlikely to be intended.

A file that cannot be parsed is refused by `read_mission`.  The limits here are wide around the
shipped missions, which pass.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from service.acquire.choices import idle_reason
from service.mission_checks import zone_census
from service.missions.mission import Band, Mission, Tracker
from service.missions.scan import Raster, Sweep
from service.sky.catalog.run_catalog import RunCatalog
from service.vectors import separation_deg

Level = Literal["wrong", "unusual"]

LEAST_SIGMAS, MOST_SIGMAS = 3.0, 30.0
"""Range of a tolerance in sigmas: below it true stars are lost, above it chance ones pass."""
FEW_STARS = 3
"""Number of stars in the field of view below which an identification is seldom reliable."""
FEW_SHARE = 0.05
MANY_STARS = 100
MANY_PAIRS = 300_000
"""Number of pairs in a zone above which a check reports it: 5 MB, searched for each batch."""
SIGMAS_ARCSEC = 0.1, 120.0
SAME_BORESIGHT_DEG = 0.1
COELEVATION_DEG = 0.5
OTHER_SIGMA = 3.0
"""Ratio of the sigmas of a scan and its tracker, either way, above which they disagree."""


@dataclass(frozen=True)
class Finding:
    """A wrong or unusual mission setting, named by its key."""

    level: Level
    key: str
    text: str


@dataclass(frozen=True)
class TrackerView:
    """Number of catalog stars in a tracker's field of view, over the whole sky."""

    tracker: str
    stars: zone_census.Spread
    few_share: float
    """Share of the sky with fewer than `FEW_STARS` stars in the field of view."""


def tracker_views(mission: Mission, run_catalog: RunCatalog) -> list[TrackerView]:
    """Star counts in the field of view of every tracker of a mission."""
    found = []
    for tracker in mission.trackers:
        view = run_catalog.direction, 0.0, _round_field_deg(tracker)
        counts = zone_census.star_counts(*view)
        stars = zone_census.star_spread(zone_census.Extremes(*view), counts)
        found.append(TrackerView(tracker.name, stars, zone_census.share_below(counts, FEW_STARS)))
    return found


def _round_field_deg(tracker: Tracker) -> float:
    """Radius of the circular field of view with the same area as a tracker's."""
    if tracker.field_of_view_deg is None:
        return tracker.field_of_view_radius_deg
    half = [math.radians(0.5 * each) for each in tracker.field_of_view_deg]
    area_sr = 4.0 * math.asin(
        math.sin(math.atan(math.tan(half[0]) * math.cos(half[1]))) * math.sin(half[1])
    )
    return math.degrees(math.acos(1.0 - area_sr / math.tau))


def findings(
    mission: Mission,
    faintest_mag: float,
    views: list[TrackerView],
    zones: list[zone_census.ZoneCensus],
) -> list[Finding]:
    """All wrong or unusual settings of a mission, the wrong ones first.

    `faintest_mag` is the magnitude of the star catalog's faintest stars.
    """
    found = [
        *_zone(mission),
        *_tolerances(mission),
        *_trackers(mission),
        *_stars(mission, faintest_mag, views, zones),
    ]
    return sorted(found, key=lambda each: each.level != "wrong")


def _zone(mission: Mission) -> Iterator[Finding]:
    zone = mission.zone
    length = math.hypot(*zone.axis_body)
    if abs(length - 1.0) > 1e-3:
        text = f"has the length {length:g}; it is used as a direction, so check its components"
        yield Finding("unusual", "zone.axis_body", text)
    widest_deg = max(each.field_of_view_radius_deg for each in mission.trackers)
    if not isinstance(zone, Band):
        if zone.radius_deg <= widest_deg:
            yield Finding(
                "unusual",
                "zone.radius_deg",
                f"{zone.radius_deg:g} is no more than the radius of the field of view, "
                f"{widest_deg:g} deg: it leaves no room for an error of the a priori attitude; it "
                "should be that radius and that error together",
            )
        off_deg = [separation_deg(t.boresight_body, mission.axis_body) for t in mission.trackers]
        if min(off_deg) > SAME_BORESIGHT_DEG:
            yield Finding(
                "unusual",
                "zone.axis_body",
                f"no tracker looks along it, the nearest is {min(off_deg):.2f} deg away: an a "
                "priori boresight without roll will be refused",
            )
        return
    if zone.half_width_deg < widest_deg:
        yield Finding(
            "unusual",
            "zone.half_width_deg",
            f"{zone.half_width_deg:g} is less than the radius of the field of view, "
            f"{widest_deg:g} deg: stars at its edge are not in the zone",
        )
    for place, tracker in enumerate(mission.trackers):
        file_deg = tracker.coelevation_deg or zone.coelevation_deg
        true_deg = separation_deg(tracker.boresight_body, mission.axis_body)
        off = abs(file_deg - true_deg)
        if off <= COELEVATION_DEG:
            continue
        never = off > zone.half_width_deg + tracker.field_of_view_radius_deg
        yield Finding(
            "wrong" if never else "unusual",
            f"trackers.{place}.coelevation_deg" if tracker.coelevation_deg else "zone",
            f"{tracker.name} looks {true_deg:.2f} deg from the pole by its axes, and at the "
            f"coelevation of {file_deg:g} deg by the file"
            + (": its stars are never in the band" if never else ""),
        )


def _tolerances(mission: Mission) -> Iterator[Finding]:
    tolerances = mission.tolerances
    widest_deg = 2.0 * max(each.field_of_view_radius_deg for each in mission.trackers)
    limit_deg = tolerances.pair_separation_max_deg
    if limit_deg > 1.05 * widest_deg:
        yield Finding(
            "unusual",
            "tolerances.pair_separation_max_deg",
            f"{limit_deg:g}: no two stars of a field of {widest_deg:g} deg are so far apart; the "
            "pair index is larger for nothing",
        )
    # A camera sends so many stars that enough of them are near each other.
    elif limit_deg < 0.5 * widest_deg and not _sends_frames(mission):
        yield Finding(
            "unusual",
            "tolerances.pair_separation_max_deg",
            f"{limit_deg:g} is less than half of the field of {widest_deg:g} deg: most pairs of "
            "a field are not in the index",
        )
    checked = [
        ("separation_deg", tolerances.separation_deg, "sigma_arcsec", math.sqrt(2.0) / 3600.0),
        ("magnitude_mag", tolerances.magnitude_mag, "magnitude_sigma_mag", 1.0),
    ]
    for name, tolerance, sigma_name, factor in checked:
        if idle_reason(name, mission.identifier, mission.tests, mission.zone) is not None:
            continue
        sigmas = [tolerance / (factor * getattr(each, sigma_name)) for each in mission.trackers]
        if min(sigmas) < LEAST_SIGMAS:
            end = "true stars will fail the test"
            yield _of_sigmas(name, tolerance, min(sigmas), end)
        elif max(sigmas) > MOST_SIGMAS:
            end = "stars that fit by chance will pass the test"
            yield _of_sigmas(name, tolerance, max(sigmas), end)


def _sends_frames(mission: Mission) -> bool:
    return any(each.camera is not None for each in mission.trackers)


def _of_sigmas(name: str, tolerance: float, sigmas: float, end: str) -> Finding:
    text = f"{tolerance:g} is {sigmas:.1f} times the error that the tracker's sigma predicts: {end}"
    return Finding("unusual", f"tolerances.{name}", text)


def _trackers(mission: Mission) -> Iterator[Finding]:
    least, most = SIGMAS_ARCSEC
    for place, tracker in enumerate(mission.trackers):
        key = f"trackers.{place}"
        if not least <= tracker.sigma_arcsec <= most:
            text = f"{tracker.sigma_arcsec:g} arcsec per axis is unusual for a star tracker"
            yield Finding("unusual", f"{key}.sigma_arcsec", text)
        if tracker.magnitude_sigma_mag > 1.0:
            text = f"{tracker.magnitude_sigma_mag:g} mag hardly tells stars apart"
            yield Finding("unusual", f"{key}.magnitude_sigma_mag", text)
        if abs(tracker.calibration.scale - 1.0) > 0.1:
            text = f"{tracker.calibration.scale:g} changes angles by more than a tenth"
            yield Finding("unusual", f"{key}.calibration.scale", text)
        yield from _camera(key, tracker)
        yield from _scan(key, tracker)
        for other in mission.trackers[:place]:
            if separation_deg(other.boresight_body, tracker.boresight_body) < SAME_BORESIGHT_DEG:
                text = f"looks where {other.name} looks: are its axes those of the other?"
                yield Finding("unusual", f"{key}.z_axis_body", f"{tracker.name} {text}")


def _camera(key: str, tracker: Tracker) -> Iterator[Finding]:
    if tracker.camera is None:
        return
    if tracker.camera.psf != "gaussian" and tracker.camera.band_nm is None:
        yield Finding(
            "unusual",
            f"{key}.camera.psf",
            f"{tracker.camera.psf} is an image in light of one colour: without a narrow filter, or "
            "band_nm of the detector, stars leave light that it does not explain, and errors of "
            "places exceed their sigmas by amounts that are not known",
        )
    corner_deg, file_deg = tracker.camera.corner_radius_deg, tracker.field_of_view_radius_deg
    if not math.isclose(corner_deg, file_deg, rel_tol=0.05):
        yield Finding(
            "unusual",
            f"{key}.field_of_view_radius_deg",
            f"{file_deg:g}, but the corner of the camera's frame is {corner_deg:.2f} deg from the "
            "boresight",
        )


def _scan(key: str, tracker: Tracker) -> Iterator[Finding]:
    scan, radius_deg = tracker.scan, tracker.field_of_view_radius_deg
    if isinstance(scan, Sweep):
        reach_deg = min(-scan.start_deg, scan.end_deg - scan.wires_deg[-1])
        sigma_arcsec = 3600.0 * scan.rate_deg_per_s * scan.time_sigma_s
        sigma_arcsec /= math.sqrt(len(scan.wires_deg))
        times = sigma_arcsec / tracker.sigma_arcsec
        if not 1.0 / OTHER_SIGMA <= times <= OTHER_SIGMA:
            yield Finding(
                "unusual",
                f"{key}.sigma_arcsec",
                f"{tracker.sigma_arcsec:g}, but rate and time_sigma_s of the scan give stars "
                f"{sigma_arcsec:.3g} arcsec: tolerances are judged by the first",
            )
    elif isinstance(scan, Raster):
        reach_deg = min(scan.middle("h"), scan.middle("v")) * scan.step_deg
    else:
        return
    if reach_deg < radius_deg:
        yield Finding(
            "unusual",
            f"{key}.scan",
            f"reaches {reach_deg:.2f} deg from the boresight, less than the radius of the "
            f"field of view, {radius_deg:g} deg: stars at its edge are not seen",
        )


def _stars(
    mission: Mission,
    faintest_mag: float,
    views: list[TrackerView],
    zones: list[zone_census.ZoneCensus],
) -> Iterator[Finding]:
    limit_mag = mission.catalog.magnitude_limit_mag
    if limit_mag > faintest_mag:
        text = f"{limit_mag:g}: the star catalog ends at about {faintest_mag:.1f} mag"
        yield Finding("unusual", "catalog.magnitude_limit_mag", text)
    for view in views:
        if view.few_share > FEW_SHARE:
            yield Finding(
                "unusual",
                "catalog.magnitude_limit_mag",
                f"{limit_mag:g}: {view.tracker} sees fewer than {FEW_STARS} stars in "
                f"{100.0 * view.few_share:.0f} % of the sky",
            )
        elif view.stars.median > MANY_STARS and not _sends_frames(mission):
            yield Finding(
                "unusual",
                "catalog.magnitude_limit_mag",
                f"{limit_mag:g}: {view.tracker} sees {view.stars.median} stars of the run catalog "
                "in a usual field; fewer are enough, and faster",
            )
    for each in zones:
        most = each.spread["pairs"].most
        if most > MANY_PAIRS:
            text = f"a {each.of} holds up to {most:,} pairs: slow and large"
            yield Finding("unusual", "zone", text)
