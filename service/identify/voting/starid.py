"""The identifier `starid`: pairs of stars vote, a unique maximum identifies.

A tie is ambiguous, no votes is unmatched, one vote is enough (Fink & Shoup
1994; the paper counts unmatched stars among its ambiguous ones).
"""

import math

import numpy as np

from service.errors import BadBatch, Fault, shown_value
from service.identify.budget import COMPARISONS_PER_UNIT, NODES_PER_UNIT
from service.identify.identification import Identification, not_known
from service.identify.sighting import RegionBounds, SightedArrays, Sighting
from service.identify.voting.match_groups import MAX_EDGES, keep_largest_groups
from service.identify.voting.pair_tests import (
    Ballots,
    Rulebook,
    Tallies,
    cast_votes,
    count_votes,
    name_rivals,
    polar_angles,
    tally,
)
from service.sky.zones import ZoneArrays
from service.vectors import angle_between_deg

MAX_RIVALS = 20
"""The most rivals listed for a star; the identifiers look for one more, to tell a cut list."""
MAX_COMPARISONS = 30_000_000
"""Observed with candidate pairs, for one tracker: a second or two."""
RELEASE_GIL_ABOVE = 10_000_000
"""Stars squared times candidate pairs: beyond it votes take a good part of a millisecond."""


def identify_by_votes(sighting: Sighting) -> Identification:
    """Identify the stars of one tracker by the votes of pairs, steps 1 to 10.

    Raises `BadBatch` where tolerances make more comparisons than are allowed.
    """
    n, pairs = len(sighting.direction), sighting.zone.pairs.count
    if n * (n - 1) // 2 * pairs > MAX_COMPARISONS:
        _refuse_endless(sighting)
    tallies = tallies_for(n)
    if sighting.rules.tests.match_groups or n * n * pairs > RELEASE_GIL_ABOVE:
        any_tie, bounded = _tally_in_steps(sighting, tallies)
    else:
        arrays = voting_arrays(sighting)
        any_tie, compared = tally(*arrays, sighting.zone.star, tallies)
        bounded = compared > arrays[-1].max_comparisons
        sighting.budget.spend(compared // COMPARISONS_PER_UNIT)
    return Identification(
        outcome=tallies.outcome,
        star=tallies.star,
        votes=tallies.highest,
        runner_up=tallies.second,
        rivals=_rivals(tallies) if any_tie else ((),) * n,
        probability=not_known(n),
        rivals_cut=int(np.count_nonzero(tallies.rivals[-1] >= 0)) if any_tie else 0,
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


def voting_arrays(sighting: Sighting) -> tuple[SightedArrays, ZoneArrays, RegionBounds, Rulebook]:
    """A sighting as `tally` and `cast_votes` take it."""
    max_comparisons = COMPARISONS_PER_UNIT * sighting.budget.left
    rulebook = Rulebook(sighting.rules.limits, sighting.rules.switches, max_comparisons)
    return sighting.arrays, sighting.zone.arrays, sighting.bounds, rulebook


def tallies_for(n: int) -> Tallies:
    """Room for the tallies of n stars, and one rival more than an answer lists."""
    found = np.empty((4 + MAX_RIVALS + 1, n), np.int64)
    return Tallies(
        outcome=found[0], star=found[1], highest=found[2], second=found[3], rivals=found[4:]
    )


def ballots_for(n: int, stars: int, edges: int = 0) -> Ballots:
    """Empty ballots of n observed stars for so many zone stars."""
    return Ballots(
        votes=np.zeros((n, stars), np.int32),
        voted=np.empty((n, stars), np.int32),
        counts=np.zeros(n, np.int32),
        edges=np.empty((edges, 4), np.int32),
    )


def _tally_in_steps(sighting: Sighting, tallies: Tallies) -> tuple[bool, bool]:
    """Whether any star is ambiguous, and whether the search was cut short.

    As `tally`, but without the interpreter's lock; with match groups, of the votes of the largest
    ones alone.
    """
    sighted, zone, bounds, rules = voting_arrays(sighting)
    n, stars = len(sighted.direction), len(zone.direction)
    polar = polar_angles(zone.polar, stars, bounds, rules)
    ballots = ballots_for(n, stars)
    budget, groups = sighting.budget, sighting.rules.tests.match_groups
    compared = cast_votes(sighted, zone, polar, bounds, rules, ballots)
    # For the edges of groups they are compared again.
    budget.spend((2 if groups else 1) * compared // COMPARISONS_PER_UNIT)
    bounded = compared > rules.max_comparisons
    if bounded:
        ballots = ballots_for(n, stars)
    elif groups and (cast := int(ballots.votes.sum()) // 2) > MAX_EDGES:
        bounded = True
    elif groups:
        again = ballots_for(n, stars, cast)
        cast_votes(sighted, zone, polar, bounds, rules, again)
        bounded, nodes = keep_largest_groups(
            ballots.votes, again.edges, NODES_PER_UNIT * budget.left
        )
        budget.spend(nodes // NODES_PER_UNIT)
    any_tie = count_votes(ballots, sighting.zone.star, tallies)
    name_rivals(ballots.votes, sighting.zone.star, tallies)
    return any_tie, bounded


def _rivals(tallies: Tallies) -> tuple[tuple[int, ...], ...]:
    """The stars that share the highest tally of each ambiguous star, brightest first."""
    return tuple(
        tuple(row for row in rivals if row >= 0) for rivals in tallies.rivals[:-1].T.tolist()
    )
