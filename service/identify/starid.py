"""The identifier `starid`: pairs of stars vote, a unique maximum identifies.

A tie is ambiguous, no votes is unmatched, one vote is enough (Fink & Shoup
1994; the paper counts unmatched stars among its ambiguous ones).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.errors import BadBatch, Fault, shown_value
from service.identify.identification import Identification, Integers, Outcome
from service.identify.match_groups import MAX_EDGES, keep_largest_groups
from service.identify.pair_tests import cast_votes, count_votes, tally, tally_aside
from service.missions.mission import Tests, Tolerances
from service.sky.guide import Guide
from service.sky.zones import Aim, Zone
from service.vectors import Vector, angle_between_deg, separation_deg

Tallies = npt.NDArray[np.int32]

MAX_RIVALS = 20
MAX_COMPARISONS = 30_000_000
"""Observed with candidate pairs, for one tracker: a second or two."""

MUCH = 10_000_000
"""Stars squared times candidate pairs: beyond it votes take a good part of a millisecond."""


@dataclass(frozen=True)
class Sighting:
    """What an identifier is given: one tracker's stars and where to look for them.

    `direction` (n, 3) is inertial through the presumed attitude; magnitudes may
    be NaN; sigma is one standard deviation per tangent axis.  `zone` holds at
    least the stars within `aim`.  Of the presumed attitude the whole rotation
    is known, or only how it points `known_axis` (inertial).  `velocity_c` of the
    observer is zero where aberration is not to be corrected.  `boresight` is the
    presumed one, inertial.  `guide` is there for identifiers that ask for no
    prior, and None for the others.
    """

    direction: Vector
    magnitude_mag: Vector
    sigma_rad: Vector
    known_axis: Vector | None
    velocity_c: Vector
    boresight: Vector
    aim: Aim
    zone: Zone
    tolerances: Tolerances
    tests: Tests
    guide: Guide | None = None


def identify_by_votes(sighting: Sighting) -> Identification:
    """Identify the stars of one tracker by the votes of pairs, steps 1 to 10.

    Raises `BadBatch` where tolerances make more comparisons than are allowed.
    """
    zone, tests = sighting.zone, sighting.tests
    n = len(sighting.direction)
    if n * (n - 1) // 2 * zone.pairs.count > MAX_COMPARISONS:
        _refuse_endless(sighting)
    given = sighting.direction, sighting.magnitude_mag, *votes_arguments(sighting)
    count = tally_aside if n * n * zone.pairs.count > MUCH else tally
    votes, voted, counts, found, any_tie = count(zone.star, *given)
    bounded = False
    if tests.match_groups:
        bounded = _keep_groups(given, votes)
        any_tie = count_votes(votes, voted, counts, zone.star, *found)
    outcome, star, highest, second = found
    return Identification(
        outcome=outcome,
        star=star,
        votes=highest,
        runner_up=second,
        rivals=_tied(votes, outcome, highest, zone) if any_tie else ((),) * n,
        probability=np.full(n, np.nan),
        bounded=bounded,
    )


def _refuse_endless(sighting: Sighting) -> None:
    """Raise `BadBatch` where so many stars at so wide a tolerance would take seconds."""
    one, other = np.triu_indices(len(sighting.direction), 1)
    separation = np.radians(angle_between_deg(sighting.direction[one], sighting.direction[other]))
    tolerance_deg = sighting.tolerances.separation_deg
    pairs, tolerance = sighting.zone.pairs.separation_rad, math.radians(tolerance_deg)
    found = np.searchsorted(pairs, separation + tolerance, "right")
    comparisons = int((found - np.searchsorted(pairs, separation - tolerance)).sum())
    if comparisons > MAX_COMPARISONS:
        raise BadBatch(
            Fault(
                "options.tolerances.separation_deg",
                f"with {len(sighting.direction)} stars asks for {comparisons:,} comparisons "
                f"of pairs; at most {MAX_COMPARISONS:,} are made",
                shown_value(tolerance_deg),
            )
        )


def polar_of(zone: Zone, aim: Aim) -> tuple[Vector, float, bool]:
    """The zone stars' angles to the aim's axis, -1 where they are not known; see `cast_votes`.

    With them how far off the zone's own axis lies, in radians, and whether every
    star of the zone lies within the aim.
    """
    if zone.serves_exactly(aim):
        polar = zone.polar_rad.copy() if len(zone.polar_rad) else np.empty(len(zone.star))
        return polar, 0.0, True
    off_axis = math.radians(separation_deg(zone.aim.axis, aim.axis))
    return np.full(len(zone.star), -1.0), off_axis, False


def votes_arguments(sighting: Sighting) -> tuple[Any, ...]:
    """What `cast_votes` is given between the observed stars and the tallies, in its order."""
    zone, aim, limits, tests = sighting.zone, sighting.aim, sighting.tolerances, sighting.tests
    polar, off_axis, all_inside = polar_of(zone, aim)
    return (
        zone.direction,
        zone.magnitude_mag,
        zone.pairs.separation_rad,
        zone.pairs.brighter,
        zone.pairs.dimmer,
        zone.pairs.bin_start,
        zone.pairs.bins_per_rad,
        polar,
        zone.polar_difference_rad,
        aim.axis,
        off_axis,
        all_inside,
        math.radians(aim.least_deg),
        math.radians(aim.most_deg),
        math.radians(limits.separation_deg),
        limits.magnitude_mag,
        limits.magnitude_order_mag,
        math.radians(limits.cross_product_deg),
        math.radians(limits.pole_difference_deg),
        math.radians(limits.pole_angle_deg),
        math.radians(limits.fov_rotation_deg),
        sighting.boresight,
        aim.kind == "band",
        tests.magnitude,
        tests.cross_product,
        tests.pole,
        tests.fov_rotation,
    )


def _keep_groups(given: tuple[Any, ...], votes: Tallies) -> bool:
    """Leave only the votes of the largest match groups; whether that search was cut short."""
    count = int(votes.sum()) // 2
    if count > MAX_EDGES:
        return True
    edges, n = np.empty((count, 4), np.int32), len(votes)
    tallies = np.zeros_like(votes), np.empty_like(votes), np.zeros(n, np.int32)
    # mypy takes what comes as a tuple for one argument.
    cast_votes(*given, *tallies, edges)  # type: ignore[call-arg]
    return keep_largest_groups(votes, edges)


def _tied(
    votes: Tallies, outcome: Integers, highest: Integers, zone: Zone
) -> tuple[tuple[int, ...], ...]:
    """The stars that share the highest tally of each ambiguous star, brightest first."""
    return tuple(
        tuple(zone.star[np.flatnonzero(row == most)[:MAX_RIVALS]].tolist())
        if what == Outcome.AMBIGUOUS
        else ()
        for row, what, most in zip(votes, outcome, highest, strict=True)
    )
