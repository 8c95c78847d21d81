"""The identifier `starid`: pairs of stars vote for identities, and a unique maximum wins.

A tie is ambiguous, no votes is unmatched, and one vote is enough (Fink & Shoup 1994; the paper
counts unmatched stars as ambiguous).
"""

import math

import numpy as np

from service.errors import BadBatch, Fault, shown_value
from service.identify.budget import COMPARISONS_PER_UNIT, NODES_PER_UNIT
from service.identify.identification import IdentifiedColumns, Integers
from service.identify.sighting import SightingColumns, bounds_at, sighted_at
from service.identify.voting.match_groups import MAX_EDGES, keep_largest_groups
from service.identify.voting.pair_tests import (
    Ballots,
    Rulebook,
    cast_votes,
    count_votes,
    name_rivals,
    polar_angles,
    tallies_of,
    tally,
)
from service.missions.mission import Rules
from service.sky.zones import Zone
from service.vectors import Vector, angle_between_deg

MAX_COMPARISONS = 30_000_000
"""Largest number of comparisons of observed with candidate pairs for one tracker: 1 to 2 s."""


def identify_by_votes(
    which: Integers, seen: SightingColumns, zone: Zone, rules: Rules, found: IdentifiedColumns
) -> None:
    """Identify stars by the votes of pairs, steps 1 to 10 of STARID.

    `which` has the row numbers of the sightings that the zone serves.
    """
    if rules.tests.match_groups:
        for s in which.tolist():
            _tally_groups(s, seen, zone, rules, found)
    else:
        tally(which, seen, zone.arrays, zone.star, rules.limits, rules.switches, found)


def refuse_endless(direction: Vector, zone: Zone, rules: Rules) -> None:
    """Raise `BadBatch` if as many stars (n, 3) at this separation tolerance would take seconds."""
    n = len(direction)
    if n * (n - 1) // 2 * zone.pairs.count <= MAX_COMPARISONS:
        return
    one, other = np.triu_indices(n, 1)
    separation = np.radians(angle_between_deg(direction[one], direction[other]))
    tolerance_deg = rules.tolerances.separation_deg
    pairs, tolerance = zone.pairs.separation_rad, math.radians(tolerance_deg)
    found = np.searchsorted(pairs, separation + tolerance, "right")
    comparisons = int((found - np.searchsorted(pairs, separation - tolerance)).sum())
    if comparisons > MAX_COMPARISONS:
        raise BadBatch(
            Fault(
                "options.tolerances.separation_deg",
                f"with {n} stars asks for {comparisons:,} comparisons "
                f"of pairs; at most {MAX_COMPARISONS:,} are made",
                shown_value(tolerance_deg),
            )
        )


def ballots_for(n: int, stars: int, edges: int = 0) -> Ballots:
    """Empty vote arrays for n observed stars and `stars` zone stars."""
    return Ballots(
        votes=np.zeros((n, stars), np.int32),
        voted=np.empty((n, stars), np.int32),
        counts=np.zeros(n, np.int32),
        edges=np.empty((edges, 4), np.int32),
    )


def _tally_groups(
    s: int, seen: SightingColumns, zone: Zone, rules: Rules, found: IdentifiedColumns
) -> None:
    """Count the votes of the largest match groups of one sighting, in place of `tally`."""
    first, last = seen.offsets[s : s + 2].tolist()
    n, stars, left = last - first, len(zone.star), int(seen.left[s])
    sighted, bounds = sighted_at(seen, s), bounds_at(seen, s)
    rulebook = Rulebook(rules.limits, rules.switches, COMPARISONS_PER_UNIT * left)
    polar = polar_angles(zone.arrays.polar, stars, bounds, rulebook)
    comparison = sighted, zone.arrays, polar, bounds, rulebook
    ballots = ballots_for(n, stars)
    compared = cast_votes(*comparison, ballots)
    # The comparisons are repeated to record the edges of groups.
    left = max(0, left - 2 * compared // COMPARISONS_PER_UNIT)
    bounded = compared > rulebook.max_comparisons
    if bounded:
        ballots = ballots_for(n, stars)
    elif (cast := int(ballots.votes.sum()) // 2) > MAX_EDGES:
        bounded = True
    else:
        again = ballots_for(n, stars, cast)
        cast_votes(*comparison, again)
        bounded, nodes = keep_largest_groups(ballots.votes, again.edges, NODES_PER_UNIT * left)
        left -= nodes // NODES_PER_UNIT
    tallies = tallies_of(found, first, last)
    count_votes(ballots, zone.star, tallies)
    name_rivals(ballots.votes, zone.star, tallies)
    seen.left[s], found.bounded[s] = left, bounded
    found.rivals_cut[s] = np.count_nonzero(tallies.rivals[:, -1] >= 0)
