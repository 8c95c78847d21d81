"""The identifier `starid`: pairs of stars vote, a unique maximum identifies.

A tie is ambiguous, no votes is unmatched, one vote is enough (Fink & Shoup
1994; the paper counts unmatched stars among its ambiguous ones).
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from service.errors import BadBatch, Fault, shown_value
from service.identify.identification import Identification, Integers, not_known
from service.identify.match_groups import MAX_EDGES, keep_largest_groups
from service.identify.pair_tests import (
    cast_votes,
    count_votes,
    name_rivals,
    polar_angles,
    tally,
    tally_aside,
)
from service.missions.mission import Rules
from service.sky.guide import Guide
from service.sky.zones import Aim, Zone
from service.vectors import Vector, angle_between_deg, separation_deg

Tallies = npt.NDArray[np.int32]
Rows = npt.NDArray[np.int32]

MAX_RIVALS = 20
"""The most rivals listed for a star; the identifiers look for one more, to tell a cut list."""
_RIVALS = 4
"""The row of what `tally` finds below which the rivals stand."""
MAX_COMPARISONS = 30_000_000
"""Observed with candidate pairs, for one tracker: a second or two."""

MUCH = 10_000_000
"""Stars squared times candidate pairs: beyond it votes take a good part of a millisecond."""


class Sighting(Struct, frozen=True, eq=False, gc=False):
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
    rules: Rules
    guide: Guide | None = None


def identify_by_votes(sighting: Sighting) -> Identification:
    """Identify the stars of one tracker by the votes of pairs, steps 1 to 10.

    Raises `BadBatch` where tolerances make more comparisons than are allowed.
    """
    zone = sighting.zone
    n, pairs = len(sighting.direction), zone.pairs.count
    if n * (n - 1) // 2 * pairs > MAX_COMPARISONS:
        _refuse_endless(sighting)
    given = votes_arguments(sighting)
    found = np.empty((_RIVALS + MAX_RIVALS + 1, n), np.int64)
    bounded = False
    if sighting.rules.tests.match_groups:
        any_tie, bounded = _tally_groups(given, zone.star, found)
    else:
        count = tally_aside if n * n * pairs > MUCH else tally
        # mypy takes what comes as a tuple for one argument.
        any_tie = count(*given, zone.star, found)  # type: ignore[call-arg]
    return Identification(
        outcome=found[0],
        star=found[1],
        votes=found[2],
        runner_up=found[3],
        rivals=_rivals(found) if any_tie else ((),) * n,
        probability=not_known(n),
        rivals_cut=int(np.count_nonzero(found[-1] >= 0)) if any_tie else 0,
        bounded=bounded,
    )


def _refuse_endless(sighting: Sighting) -> None:
    """Raise `BadBatch` where so many stars at so wide a tolerance would take seconds."""
    one, other = np.triu_indices(len(sighting.direction), 1)
    separation = np.radians(angle_between_deg(sighting.direction[one], sighting.direction[other]))
    tolerance_deg = sighting.rules.tolerances.separation_deg
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


def votes_arguments(sighting: Sighting) -> tuple[Any, ...]:
    """What `tally` is given before the stars' names and the place for what it finds, in its order.

    But for the angles to the axis, `polar`, `cast_votes` is given the same.
    """
    zone, aim, pairs, rules = sighting.zone, sighting.aim, sighting.zone.pairs, sighting.rules
    is_band = aim.kind == "band"
    all_inside = zone.serves_exactly(aim)
    # Polar angles are kept in bands alone.
    off_axis_deg = separation_deg(zone.aim.axis, aim.axis) if is_band and not all_inside else 0.0
    return (
        sighting.direction,
        sighting.magnitude_mag,
        sighting.boresight,
        zone.polar_rad,
        zone.vector_mag,
        pairs.separation_rad,
        pairs.rows,
        pairs.bin_start,
        pairs.bins_per_rad,
        zone.polar_difference_rad,
        aim.axis,
        math.radians(off_axis_deg),
        all_inside,
        math.radians(aim.least_deg),
        math.radians(aim.most_deg),
        is_band,
        rules.limits,
        rules.switches,
    )


def with_polar_angles(given: tuple[Any, ...]) -> tuple[Any, ...]:
    """The arguments of `tally` as `cast_votes` takes them."""
    zone_polar, stars, all_inside, switches = (given[place] for place in (3, 4, 12, 17))
    polar = polar_angles(zone_polar, len(stars), all_inside, switches)
    return *given[:3], polar, *given[4:]


def _tally_groups(given: tuple[Any, ...], star_of: Rows, found: Integers) -> tuple[bool, bool]:
    """`tally` of the votes of the largest match groups alone; whether that search was cut short."""
    given = with_polar_angles(given)
    shape = len(given[0]), len(star_of)
    votes, voted, counts, edges = _room_for_votes(shape, 0)
    cast_votes(*given, votes, voted, counts, edges)
    cast = int(votes.sum()) // 2
    bounded = cast > MAX_EDGES
    if not bounded:
        again = _room_for_votes(shape, cast)
        cast_votes(*given, *again)
        bounded = keep_largest_groups(votes, again[-1])
    any_tie = count_votes(votes, voted, counts, star_of, *found[:_RIVALS])
    name_rivals(votes, star_of, found[0], found[2], found[_RIVALS:])
    return any_tie, bounded


def _room_for_votes(shape: tuple[int, int], edges: int) -> tuple[Tallies, ...]:
    return (
        np.zeros(shape, np.int32),
        np.empty(shape, np.int32),
        np.zeros(shape[0], np.int32),
        np.empty((edges, 4), np.int32),
    )


def _rivals(found: Integers) -> tuple[tuple[int, ...], ...]:
    """The stars that share the highest tally of each ambiguous star, brightest first."""
    return tuple(
        tuple(row for row in rivals if row >= 0) for rivals in found[_RIVALS:-1].T.tolist()
    )
