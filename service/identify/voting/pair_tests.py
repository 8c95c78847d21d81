"""Steps 1 to 10 of STARID: tests of candidate pairs, and the votes of those that survive.

Source: Fink & Shoup 1994, sections 2.1 and 2.2. Comments give the paper's names. `cast_votes`
allocates nothing, holds no state and releases the interpreter's lock.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from service.compiled.arrays import copy_rows
from service.compiled.jit import njit, njit_inlined, njit_no_refcount
from service.identify.budget import COMPARISONS_PER_UNIT
from service.identify.identification import Outcome
from service.identify.sighting import bounds_at, sighted_at
from service.identify.voting.fov_rotation import rotation_rad
from service.sky.geometry.directions import separation_rad

UNMATCHED, UNIQUE, AMBIGUOUS = (int(outcome) for outcome in Outcome)

# Error in radians of a difference of polar angles stored in single precision.
_SINGLE = 1e-6
# Tolerance at a right angle, where the order of a pair flips, so that rounding rejects neither.
_ROUNDING = 1e-14

REJECTED = 2
"""The value in place of a candidate pair's order if a test rejects the candidate."""


class Rulebook(NamedTuple):
    """The rules of an identification for kernels: the tests to be made, and their tolerances.

    No votes are cast if that takes more than `max_comparisons`.
    """

    limits: Any
    switches: Any
    max_comparisons: Any


class Ballots(NamedTuple):
    """The votes of n observed stars for m zone stars, with work arrays.

    `votes` (n, m) are counts; `voted` (n, m) lists the zone stars with votes, `counts` (n,) their
    number. `edges`, either empty (0, 4) or with half as many rows as votes, gets the observed star,
    zone row, other observed star and zone row of each pair.
    """

    votes: Any
    voted: Any
    counts: Any
    edges: Any


class Tallies(NamedTuple):
    """The result of vote counting for each of n observed stars.

    The `outcome`, the winner's `star` (-1: none) and the `highest` and `second` tally, all (n,);
    `rivals` (n, R) the zone stars that tie for an ambiguous star's highest tally, brightest first,
    then -1.
    """

    outcome: Any
    star: Any
    highest: Any
    second: Any
    rivals: Any


class ObservedPair(NamedTuple):
    """A pair of observed stars i and j, with the quantities that the pair tests use.

    `separation` in radians; the unit normal n0, n1, n2 to both, and `normal` the sine of their
    angle; the stars' angles `polar_i` and `polar_j` to the axis, zero without a pole test, and the
    absolute difference. `bright` and `dim` are the stars by magnitude; `ordered` is true if the
    magnitudes differ enough.
    """

    i: Any
    j: Any
    separation: Any
    n0: Any
    n1: Any
    n2: Any
    normal: Any
    polar_i: Any
    polar_j: Any
    polar_difference: Any
    bright: Any
    dim: Any
    ordered: Any


@njit_no_refcount
def cast_votes(sighted, zone, polar, bounds, rules, ballots):  # type: ignore[no-untyped-def]
    """Cast the votes of every observed pair's surviving candidate pairs; returns the number
    compared.

    If that number exceeds the limit, some pairs were not compared. `sighted`, `zone` and `bounds`
    are those of `Sighting`; `polar` (m,) caches a zone star's angle to the axis, -1 if not computed
    yet.
    """
    separation_tolerance, switches = rules.limits.separation, rules.switches
    pair_separation, pair_difference = zone.pair_separation, zone.polar_difference
    pair_brighter, pair_dimmer = zone.pair_rows[0], zone.pair_rows[1]
    kept = compared = 0
    n = len(sighted.direction)
    # A cheap filter that is never too strict: the exact test follows.
    look_at_difference = switches.pole and len(pair_difference) > 0
    difference_tolerance = rules.limits.pole_difference + 2.0 * bounds.off_axis + _SINGLE
    cross_square = 4.0 * math.sin(0.5 * rules.limits.cross_product) ** 2 + _ROUNDING
    last_bin = len(zone.bin_start) - 2
    for i in range(n - 1):
        for j in range(i + 1, n):
            pair = _observed_pair(sighted, i, j, bounds.axis, rules)
            separation = pair.separation
            high = separation + separation_tolerance
            first_bin = int((separation - separation_tolerance) * zone.bins_per_rad)
            if first_bin > last_bin:
                continue
            for k in range(zone.bin_start[max(first_bin, 0)], len(pair_separation)):
                if pair_separation[k] > high:
                    break
                compared += 1
                if abs(pair_separation[k] - separation) > separation_tolerance:
                    continue
                if (
                    look_at_difference
                    and abs(pair.polar_difference - abs(pair_difference[k])) > difference_tolerance
                ):
                    continue
                a, b = pair_brighter[k], pair_dimmer[k]
                order = _order_of(sighted, zone, polar, bounds, rules, pair, cross_square, a, b)
                if order == REJECTED:
                    continue
                if order >= 0:
                    kept = _vote(ballots, kept, i, a, j, b)
                if order <= 0:
                    kept = _vote(ballots, kept, i, b, j, a)
            if compared > rules.max_comparisons:
                return compared
    return compared


@njit_inlined
def _observed_pair(sighted, i, j, axis, rules):  # type: ignore[no-untyped-def]
    direction, magnitude = sighted.direction, sighted.magnitude
    n0 = direction[i, 1] * direction[j, 2] - direction[i, 2] * direction[j, 1]
    n1 = direction[i, 2] * direction[j, 0] - direction[i, 0] * direction[j, 2]
    n2 = direction[i, 0] * direction[j, 1] - direction[i, 1] * direction[j, 0]
    normal = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if normal > 0.0:
        n0, n1, n2 = n0 / normal, n1 / normal, n2 / normal
    polar_i = polar_j = 0.0
    if rules.switches.pole:
        polar_i = separation_rad(direction[i], axis)
        polar_j = separation_rad(direction[j], axis)
    # Steps 1 and 2: do the magnitudes give the order of the observed pair? (LMAGT)
    bright, dim = i, j
    if magnitude[j] < magnitude[i]:
        bright, dim = j, i
    ordered = (
        rules.switches.magnitude
        and magnitude[dim] - magnitude[bright] >= rules.limits.magnitude_order
    )
    return ObservedPair(
        *(i, j, separation_rad(direction[i], direction[j]), n0, n1, n2, normal),
        *(polar_i, polar_j, abs(polar_i - polar_j), bright, dim, ordered),
    )


@njit_inlined
def _order_of(sighted, zone, polar, bounds, rules, pair, cross_square, a, b):  # type: ignore[no-untyped-def]
    """The order (LORD) of a candidate pair: 1 if i matches a and j matches b, -1 for the reverse.

    0 if both orders are possible, and `REJECTED` if a test excludes both.
    """
    star, switches = zone.vector_mag, rules.switches
    order = 0
    # Steps 2 and 3: brighter to brighter, dimmer to dimmer within XMTOL.
    if pair.ordered:
        magnitude, tolerance = sighted.magnitude, rules.limits.magnitude
        if abs(magnitude[pair.bright] - star[a, 3]) > tolerance:
            return REJECTED
        if abs(magnitude[pair.dim] - star[b, 3]) > tolerance:
            return REJECTED
        order = 1 if pair.bright == pair.i else -1

    # The cached zone may be wider than the requested one.
    if switches.pole or not bounds.all_inside:
        if polar[a] < 0.0:
            polar[a] = separation_rad(star[a], bounds.axis)
        if polar[b] < 0.0:
            polar[b] = separation_rad(star[b], bounds.axis)
    if not bounds.all_inside and (
        polar[a] < bounds.least
        or polar[a] > bounds.most
        or polar[b] < bounds.least
        or polar[b] > bounds.most
    ):
        return REJECTED

    by_pole = False
    if switches.pole:
        # Step 6: GTODIF and GTRDIF.
        candidate_difference, tolerance = abs(polar[a] - polar[b]), rules.limits.pole_difference
        if abs(pair.polar_difference - candidate_difference) > tolerance:
            return REJECTED
        by_pole = pair.polar_difference > tolerance and candidate_difference > tolerance
    if by_pole:
        order = _order_by_pole(pair, polar[a], polar[b], rules.limits.pole_angle, order)
    elif switches.cross_product:
        order = _order_by_cross_product(pair, star[a], star[b], cross_square, order)
    if switches.fov_rotation and order != REJECTED:
        order = _order_by_rotation(
            sighted, bounds, rules.limits.fov_rotation, pair, star, a, b, order
        )
    return order


@njit_inlined
def _order_by_pole(pair, polar_a, polar_b, tolerance, order):  # type: ignore[no-untyped-def]
    """The order of a pair by polar angles, larger with larger, within BANTOL2 (STARID's step 7)."""
    greater = max(pair.polar_i, pair.polar_j) - max(polar_a, polar_b)
    lesser = min(pair.polar_i, pair.polar_j) - min(polar_a, polar_b)
    if abs(greater) > tolerance or abs(lesser) > tolerance:
        return REJECTED
    same = (pair.polar_i > pair.polar_j) == (polar_a > polar_b)
    pole_order = 1 if same else -1
    # Steps 8 and 9: an order given by the magnitudes must agree.
    return REJECTED if order != 0 and order != pole_order else pole_order


@njit_inlined
def _order_by_cross_product(pair, a, b, cross_square, order):  # type: ignore[no-untyped-def]
    """The order of a pair by the angle between cross products, CRSSEP, or its supplement CRSSEN."""
    c0 = a[1] * b[2] - a[2] * b[1]
    c1 = a[2] * b[0] - a[0] * b[2]
    c2 = a[0] * b[1] - a[1] * b[0]
    square = c0 * c0 + c1 * c1 + c2 * c2
    if pair.normal == 0.0 or square == 0.0:
        return REJECTED
    # Chords need no arc sine.
    norm = math.sqrt(square)
    d0, d1, d2 = pair.n0 * norm - c0, pair.n1 * norm - c1, pair.n2 * norm - c2
    along = d0 * d0 + d1 * d1 + d2 * d2 <= cross_square * square
    d0, d1, d2 = pair.n0 * norm + c0, pair.n1 * norm + c1, pair.n2 * norm + c2
    against = d0 * d0 + d1 * d1 + d2 * d2 <= cross_square * square
    if order != 0:
        return order if (along if order == 1 else against) else REJECTED
    if not (along or against):
        return REJECTED
    # Beyond 90 deg both orders may pass: the order stays open, and both pairings vote.
    return 0 if along == against else 1 if along else -1


@njit_inlined
def _order_by_rotation(sighted, bounds, tolerance, pair, star, a, b, order):  # type: ignore[no-untyped-def]
    """The order of a pair of stars, if the field's rotation is within tolerance; else rejected."""
    first, second = sighted.direction[pair.i], sighted.direction[pair.j]
    boresight, axis, is_band = sighted.boresight, bounds.axis, bounds.is_band
    along, against = order >= 0, order <= 0
    if along:
        turn = rotation_rad(first, second, star[a], star[b], boresight, axis, is_band)
        along = turn <= tolerance
    if against:
        turn = rotation_rad(first, second, star[b], star[a], boresight, axis, is_band)
        against = turn <= tolerance
    if not (along or against):
        return REJECTED
    return order if along and against else 1 if along else -1


@njit_inlined
def _vote(ballots, kept, i, a, j, b):  # type: ignore[no-untyped-def]
    """Count a vote for star i being a, and one for j being b; returns the number of edges kept."""
    _count_up(ballots, i, a)
    _count_up(ballots, j, b)
    edges = ballots.edges
    if len(edges):
        edges[kept, 0], edges[kept, 1] = i, a
        edges[kept, 2], edges[kept, 3] = j, b
        kept += 1
    return kept


@njit_inlined
def _count_up(ballots, i, row):  # type: ignore[no-untyped-def]
    if ballots.votes[i, row] == 0:
        ballots.voted[i, ballots.counts[i]] = row
        ballots.counts[i] += 1
    ballots.votes[i, row] += 1


@njit(nogil=True)
def tallies_of(found, first, last):  # type: ignore[no-untyped-def]
    """Vote results of the stars from `first` to before `last`, as views of `IdentifiedColumns`."""
    return Tallies(
        outcome=found.outcome[first:last],
        star=found.star[first:last],
        highest=found.votes[first:last],
        second=found.runner_up[first:last],
        rivals=found.rivals[first:last],
    )


@njit(nogil=True)
def tally(which, seen, zone, star_of, limits, switches, found):  # type: ignore[no-untyped-def]
    """Cast and count the votes of all sightings that one zone serves.

    `which` are the sightings' rows in the columns `seen` and `found`.
    """
    stars, most = len(zone.direction), 0
    for s in which:
        most = max(most, seen.offsets[s + 1] - seen.offsets[s])
    votes, voted = np.zeros((most, stars), np.int32), np.empty((most, stars), np.int32)
    counts, edges = np.zeros(most, np.int32), np.empty((0, 4), np.int32)
    for s in which:
        first, last = seen.offsets[s], seen.offsets[s + 1]
        n = last - first
        bounds = bounds_at(seen, s)
        rules = Rulebook(limits, switches, COMPARISONS_PER_UNIT * max(seen.left[s], 0))
        ballots = Ballots(votes=votes[:n], voted=voted[:n], counts=counts[:n], edges=edges)
        tallies = tallies_of(found, first, last)
        polar = polar_angles(zone.polar, stars, bounds, rules)
        compared = cast_votes(sighted_at(seen, s), zone, polar, bounds, rules, ballots)
        seen.left[s] -= compared // COMPARISONS_PER_UNIT
        found.bounded[s] = compared > rules.max_comparisons
        if found.bounded[s]:
            discard_votes(ballots)
        if count_votes(ballots, star_of, tallies):
            name_rivals(ballots.votes, star_of, tallies)
        else:
            tallies.rivals[:, 0] = -1
        for k in range(n):
            if tallies.rivals[k, 0] >= 0:
                found.rivals_cut[s] += tallies.rivals[k, tallies.rivals.shape[1] - 1] >= 0
            for place in range(counts[k]):
                votes[k, voted[k, place]] = 0
            counts[k] = 0


@njit(nogil=True)
def polar_angles(zone_polar, stars, bounds, rules):  # type: ignore[no-untyped-def]
    """Zone stars' angles to the axis for `cast_votes`: known ones, or -1; (0,) if not needed."""
    if bounds.all_inside and not rules.switches.pole:
        return np.empty(0)
    polar = np.full(stars, -1.0)
    if bounds.all_inside and len(zone_polar):
        copy_rows(zone_polar, polar)
    return polar


@njit_no_refcount
def discard_votes(ballots):  # type: ignore[no-untyped-def]
    """Discard all votes of a sighting, since an incomplete count may have the wrong winner."""
    ballots.votes[:] = 0
    ballots.counts[:] = 0


@njit_no_refcount
def count_votes(ballots, star_of, tallies):  # type: ignore[no-untyped-def]
    """Fill in each star's winner and tallies from the votes; returns true if any is ambiguous.

    Returns true if any star is ambiguous.
    """
    votes = ballots.votes
    any_tie = False
    for i in range(votes.shape[0]):
        best = runner = 0
        row = -1
        share = 0
        for place in range(ballots.counts[i]):
            k = ballots.voted[i, place]
            count = votes[i, k]
            if count > best:
                runner, best, row, share = best, count, k, 1
            elif count == best and count > 0:
                runner = best
                share += 1
            elif count > runner:
                runner = count
        tallies.highest[i], tallies.second[i] = best, runner
        tallies.star[i] = star_of[row] if share == 1 else -1
        tallies.outcome[i] = UNMATCHED if share == 0 else UNIQUE if share == 1 else AMBIGUOUS
        any_tie = any_tie or share > 1
    return any_tie


@njit_no_refcount
def name_rivals(votes, star_of, tallies):  # type: ignore[no-untyped-def]
    """Fill in the rivals of ambiguous stars: the catalog rows that tie for the highest tally."""
    rivals = tallies.rivals
    rivals[:] = -1
    for i in range(votes.shape[0]):
        if tallies.outcome[i] != AMBIGUOUS:
            continue
        place = 0
        for row in range(votes.shape[1]):
            if place == rivals.shape[1]:
                break
            if votes[i, row] == tallies.highest[i]:
                rivals[i, place] = star_of[row]
                place += 1
