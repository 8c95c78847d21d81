"""Removal of fill values and duplicate stars from batches, reported in remarks.

Fill values, which senders write for missing data, are treated as missing. Values in a wrong unit
are refused.
"""

import math
from typing import TYPE_CHECKING, Any

from service.errors import BadBatch, Fault, shown_value

if TYPE_CHECKING:
    from service.observations.schema import BatchIn, StarIn, TrackerIn

MOST_REMARKS = 40
EARTH_RADIUS_KM = 6_350.0
"""A radius in km a little below Earth's polar radius, within which no spacecraft can be."""
EARTH_GM_KM3_PER_S2 = 398_600.4418
BRIGHTEST_MAG, FAINTEST_MAG = -0.5, 12.5
"""Magnitudes beyond which no field has several stars that a tracker sees."""
LEAST_ALIKE = 3
"""Least number of stars with one impossible magnitude, which is then no measurement."""
_VECTORS = ("velocity_km_per_s", "position_km")


def without_fill_values(batch: "BatchIn") -> "BatchIn":
    """The batch with fill values and repeated stars removed, which its `remarks` then report.

    Raises `BadBatch` for a position inside the Earth, and for a position and velocity that would be
    an Earth orbit if the position were in metres.
    """
    changes: dict[str, Any] = {}
    remarks = []
    for name in _VECTORS:
        vector = getattr(batch, name)
        if vector is not None and len(set(vector)) == 1:
            changes[name] = None
            shown = f"{vector[0]:g} three times" if vector[0] else "zero"
            remarks.append(f"{name}_not_given: {name} is {shown}, and was taken as not given")
    if "position_km" not in changes:
        velocity = changes.get("velocity_km_per_s", batch.velocity_km_per_s)
        _require_outside_earth(batch.position_km, velocity)
    observations = [_of_tracker(each, remarks) for each in batch.observations]
    if remarks:
        changes["observations"] = observations
        changes["remarks"] = (*batch.remarks, *remarks)[:MOST_REMARKS]
    return batch.model_copy(update=changes) if changes else batch


def _of_tracker(tracker: "TrackerIn", remarks: list[str]) -> "TrackerIn":
    stars = tracker.stars
    if len(stars) < 2:
        return tracker
    once = {_key(star): star for star in stars}
    if len(once) < len(stars):
        words = f"{len(stars) - len(once)} of {len(stars)} stars of {tracker.tracker}"
        remarks.append(f"repeated_stars: {words} are exact repeats, and were counted once")
        stars = list(once.values())
    filled = _fill_magnitude([star.magnitude for star in stars])
    if filled is not None:
        count = sum(star.magnitude == filled for star in stars)
        words = f"{count} stars of {tracker.tracker} have the magnitude {filled:g}"
        remarks.append(f"magnitudes_not_given: {words}, which was taken as not given")
        stars = [
            star.model_copy(update={"magnitude": None}) if star.magnitude == filled else star
            for star in stars
        ]
    return tracker if stars is tracker.stars else tracker.model_copy(update={"stars": stars})


def _fill_magnitude(magnitudes: list[float | None]) -> float | None:
    """The magnitude that stands for none: 0 of several stars, or an impossible one of all."""
    if magnitudes.count(0.0) > 1:
        return 0.0
    first = magnitudes[0]
    is_fill = first is not None and not BRIGHTEST_MAG <= first <= FAINTEST_MAG
    is_of_all = len(magnitudes) >= LEAST_ALIKE and magnitudes.count(first) == len(magnitudes)
    return first if is_fill and is_of_all else None


def _key(star: "StarIn") -> tuple[Any, ...]:
    key = star.vector, star.h_deg, star.v_deg, star.magnitude, star.time_offset_s, star.sigma_arcsec
    lists = star.h_counts, star.v_counts, star.h_times, star.v_times
    if lists == (None, None, None, None):
        return key
    return (*key, *(None if each is None else tuple(each) for each in lists))


def _require_outside_earth(
    position_km: tuple[float, ...] | None, velocity_km_per_s: tuple[float, ...] | None
) -> None:
    if position_km is None:
        return
    distance_km = math.hypot(*position_km)
    message = None
    if distance_km < EARTH_RADIUS_KM:
        message = f"is {distance_km:.6g} km from the centre of the Earth, inside it"
    elif velocity_km_per_s is not None:
        speed = math.hypot(*velocity_km_per_s)
        in_metres_km = distance_km / 1e3
        circular = math.sqrt(EARTH_GM_KM3_PER_S2 / in_metres_km)
        along = sum(p * v for p, v in zip(position_km, velocity_km_per_s, strict=True))
        # Distant spacecraft rarely have this speed perpendicular to their position.
        is_orbit = 0.8 * circular < speed < 1.25 * circular
        if in_metres_km > EARTH_RADIUS_KM and is_orbit and abs(along) < 0.3 * distance_km * speed:
            message = (
                f"is {distance_km:.6g} km from the Earth at {speed:.3g} km/s: that is an orbit "
                "about the Earth if it is in metres; give kilometres"
            )
    if message is not None:
        raise BadBatch(Fault("position_km", message, shown_value(position_km)))
