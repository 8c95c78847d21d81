"""STARID, steps 1 to 10: which candidate pairs survive, and the votes that they cast.

Source: Fink & Shoup 1994, sections 2.1 and 2.2.  The names of the paper stand
in the comments.  The kernel allocates nothing, holds no state and releases the
interpreter's lock.
"""

import math

import numpy as np
from numba import njit

from service.identify.fov_rotation import rotation_rad
from service.identify.identification import Outcome
from service.sky.pairs import separation_rad
from service.uncounted import borrowing

UNMATCHED, UNIQUE, AMBIGUOUS = (int(outcome) for outcome in Outcome)


# What a difference of polar angles that is kept in single precision may be off, in radians.
_SINGLE = 1e-6
# On a right angle, where the order of a pair turns, rounding shall reject neither.
_ROUNDING = 1e-14


@borrowing
def cast_votes(  # type: ignore[no-untyped-def]
    observed,  # (n, 3) unit vectors, inertial through the a priori attitude
    observed_magnitude,  # (n,) NaN: the magnitude tests pass the star by
    boresight,  # (3,) inertial through the a priori attitude
    polar,  # (m,) a zone star's angle to the axis; -1: not worked out yet
    star,  # (m, 4) zone stars, brightest first: unit vector and magnitude
    pair_separation,  # (NTOT,) radians, ascending
    pair_rows,  # (2, NTOT) of the brighter stars and of the dimmer
    bin_start,
    bins_per_rad,
    pair_difference,  # (NTOT,) of the polar angles, about the zone's own axis; (0,) in a cap
    axis,  # (3,) the exact zone axis; in a band the catalog generation vector
    off_axis,  # how far the zone's own axis lies from it, radians
    all_inside,  # whether every zone star lies between the bounds
    least,  # bounds on a zone star's angle to the axis, radians
    most,
    is_band,
    limits,  # (7,) as `Rules` has them, radians and magnitudes
    switches,  # (4,) likewise
    votes,  # (n, m) counted up
    voted,  # (n, m) the zone stars that got votes, `counts` (n,) of them
    counts,
    edges,  # (0, 4), or as many rows as half the votes: each vote's i, a, j, b
):
    """Cast the votes of every observed pair's surviving candidate pairs."""
    # SEPTOL, XMTOL, TMAGMX, CAPMAX or BANMAX, BANTOL1, BANTOL2 and the field of view's own.
    separation_tolerance, magnitude_tolerance, order_tolerance = limits[0], limits[1], limits[2]
    cross_tolerance, pole_tolerance, angle_tolerance = limits[3], limits[4], limits[5]
    rotation_tolerance = limits[6]
    test_magnitude, test_cross, test_pole = switches[0], switches[1], switches[2]
    test_rotation = switches[3]
    pair_brighter, pair_dimmer = pair_rows[0], pair_rows[1]
    kept = 0
    n = len(observed)
    # Cheap, and never too strict: the test itself follows.
    look_at_difference = test_pole and len(pair_difference) > 0
    difference_tolerance = pole_tolerance + 2.0 * off_axis + _SINGLE
    cross_square = 4.0 * math.sin(0.5 * cross_tolerance) ** 2 + _ROUNDING
    last_bin = len(bin_start) - 2
    for i in range(n - 1):
        for j in range(i + 1, n):
            separation = separation_rad(observed[i], observed[j])
            low = separation - separation_tolerance
            high = separation + separation_tolerance
            first_bin = int(low * bins_per_rad)
            if first_bin > last_bin:
                continue
            n0 = observed[i, 1] * observed[j, 2] - observed[i, 2] * observed[j, 1]
            n1 = observed[i, 2] * observed[j, 0] - observed[i, 0] * observed[j, 2]
            n2 = observed[i, 0] * observed[j, 1] - observed[i, 1] * observed[j, 0]
            normal = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            if normal > 0.0:
                n0, n1, n2 = n0 / normal, n1 / normal, n2 / normal
            polar_i = polar_j = observed_difference = 0.0
            if test_pole:
                polar_i = separation_rad(observed[i], axis)
                polar_j = separation_rad(observed[j], axis)
                observed_difference = abs(polar_i - polar_j)

            # Steps 1 and 2: is the order of the observed pair told by the magnitudes? (LMAGT)
            bright, dim = i, j
            if observed_magnitude[j] < observed_magnitude[i]:
                bright, dim = j, i
            ordered = (
                test_magnitude
                and observed_magnitude[dim] - observed_magnitude[bright] >= order_tolerance
            )

            for k in range(bin_start[max(first_bin, 0)], len(pair_separation)):
                if pair_separation[k] > high:
                    break
                if abs(pair_separation[k] - separation) > separation_tolerance:
                    continue
                if (
                    look_at_difference
                    and abs(observed_difference - abs(pair_difference[k])) > difference_tolerance
                ):
                    continue
                a, b = pair_brighter[k], pair_dimmer[k]
                order = 0  # LORD: +1 when i goes with a and j with b, -1 the other way round

                # Steps 2 and 3: brighter to brighter, dimmer to dimmer within XMTOL.
                if ordered:
                    if abs(observed_magnitude[bright] - star[a, 3]) > magnitude_tolerance:
                        continue
                    if abs(observed_magnitude[dim] - star[b, 3]) > magnitude_tolerance:
                        continue
                    order = 1 if bright == i else -1

                # The zone on the shelf may be wider than the one that was asked for.
                if test_pole or not all_inside:
                    if polar[a] < 0.0:
                        polar[a] = separation_rad(star[a], axis)
                    if polar[b] < 0.0:
                        polar[b] = separation_rad(star[b], axis)
                if not all_inside and (
                    polar[a] < least or polar[a] > most or polar[b] < least or polar[b] > most
                ):
                    continue

                by_pole = False
                if test_pole:
                    # Step 6: GTODIF and GTRDIF.
                    candidate_difference = abs(polar[a] - polar[b])
                    if abs(observed_difference - candidate_difference) > pole_tolerance:
                        continue
                    by_pole = (
                        observed_difference > pole_tolerance
                        and candidate_difference > pole_tolerance
                    )
                if by_pole:
                    # Step 7: greater angle with greater, lesser with lesser, within BANTOL2.
                    greater = max(polar_i, polar_j) - max(polar[a], polar[b])
                    lesser = min(polar_i, polar_j) - min(polar[a], polar[b])
                    if abs(greater) > angle_tolerance or abs(lesser) > angle_tolerance:
                        continue
                    same = (polar_i > polar_j) == (polar[a] > polar[b])
                    pole_order = 1 if same else -1
                    # Steps 8 and 9: the magnitudes, where they told an order, must agree.
                    if order != 0 and order != pole_order:
                        continue
                    order = pole_order
                elif test_cross:
                    # Steps 4, 5 and 10: CRSSEP, or its supplement CRSSEN for the other order.
                    c0 = star[a, 1] * star[b, 2] - star[a, 2] * star[b, 1]
                    c1 = star[a, 2] * star[b, 0] - star[a, 0] * star[b, 2]
                    c2 = star[a, 0] * star[b, 1] - star[a, 1] * star[b, 0]
                    square = c0 * c0 + c1 * c1 + c2 * c2
                    if normal == 0.0 or square == 0.0:
                        continue
                    # By chords, which need no arc sine.
                    norm = math.sqrt(square)
                    d0, d1, d2 = n0 * norm - c0, n1 * norm - c1, n2 * norm - c2
                    along = d0 * d0 + d1 * d1 + d2 * d2 <= cross_square * square
                    d0, d1, d2 = n0 * norm + c0, n1 * norm + c1, n2 * norm + c2
                    against = d0 * d0 + d1 * d1 + d2 * d2 <= cross_square * square
                    if order == 0:
                        if not (along or against):
                            continue
                        # Beyond 90 deg both may pass: the order stays open, both pairings vote.
                        if along != against:
                            order = 1 if along else -1
                    elif not (along if order == 1 else against):
                        continue

                if test_rotation:
                    # Of both orders, where nothing told one, that which turns little stays.
                    along, against = order >= 0, order <= 0
                    if along:
                        turn = rotation_rad(
                            observed[i], observed[j], star[a], star[b], boresight, axis, is_band
                        )
                        along = turn <= rotation_tolerance
                    if against:
                        turn = rotation_rad(
                            observed[i], observed[j], star[b], star[a], boresight, axis, is_band
                        )
                        against = turn <= rotation_tolerance
                    if not (along or against):
                        continue
                    if not (along and against):
                        order = 1 if along else -1

                if order >= 0:
                    _vote(i, a, votes, voted, counts)
                    _vote(j, b, votes, voted, counts)
                    if len(edges):
                        edges[kept, 0], edges[kept, 1] = i, a
                        edges[kept, 2], edges[kept, 3] = j, b
                        kept += 1
                if order <= 0:
                    _vote(i, b, votes, voted, counts)
                    _vote(j, a, votes, voted, counts)
                    if len(edges):
                        edges[kept, 0], edges[kept, 1] = i, b
                        edges[kept, 2], edges[kept, 3] = j, a
                        kept += 1


@borrowing
def _vote(i, row, votes, voted, counts):  # type: ignore[no-untyped-def]
    if votes[i, row] == 0:
        voted[i, counts[i]] = row
        counts[i] += 1
    votes[i, row] += 1


@njit(cache=True)
def tally(  # type: ignore[no-untyped-def]
    observed,
    observed_magnitude,
    boresight,
    zone_polar,  # (m,) of an exact zone in a band; `polar` of `cast_votes` is made of it
    star,
    pair_separation,
    pair_rows,
    bin_start,
    bins_per_rad,
    pair_difference,
    axis,
    off_axis,
    all_inside,
    least,
    most,
    is_band,
    limits,
    switches,
    star_of,
    found,
):
    """`cast_votes`, `count_votes` and, where a star is ambiguous, `name_rivals` in one call.

    `found` (4 + R, n) gets the rows of outcome, star, highest and second, and
    below them those of up to R rivals.  Whether any star is ambiguous.  It keeps
    the interpreter's lock: where others wait for that, it takes longer to get it
    back than to count a few votes.
    """
    n, stars = len(observed), len(star)
    polar = polar_angles(zone_polar, stars, all_inside, switches)
    votes, voted = np.zeros((n, stars), np.int32), np.empty((n, stars), np.int32)
    counts, edges = np.zeros(n, np.int32), np.empty((0, 4), np.int32)
    cast_votes(
        observed,
        observed_magnitude,
        boresight,
        polar,
        star,
        pair_separation,
        pair_rows,
        bin_start,
        bins_per_rad,
        pair_difference,
        axis,
        off_axis,
        all_inside,
        least,
        most,
        is_band,
        limits,
        switches,
        votes,
        voted,
        counts,
        edges,
    )
    any_tie = count_votes(votes, voted, counts, star_of, found[0], found[1], found[2], found[3])
    if any_tie:
        name_rivals(votes, star_of, found[0], found[2], found[4:])
    return any_tie


@njit(cache=True, nogil=True)
def tally_aside(*given):  # type: ignore[no-untyped-def]
    """`tally` of much, others working meanwhile."""
    return tally(*given)


@njit(cache=True, nogil=True)
def polar_angles(zone_polar, stars, all_inside, switches):  # type: ignore[no-untyped-def]
    """The zone stars' angles to the axis for `cast_votes`: known ones, or -1; (0,) if not asked."""
    if all_inside and not switches[2]:
        return np.empty(0)
    polar = np.full(stars, -1.0)
    if all_inside and len(zone_polar):
        polar[:] = zone_polar
    return polar


@borrowing
def count_votes(votes, voted, counts, star_of, outcome, star, highest, second):  # type: ignore[no-untyped-def]
    """Per observed star: outcome, the winner's `star_of` (-1: none) and the two highest tallies.

    True where any star is ambiguous.
    """
    any_tie = False
    for i in range(votes.shape[0]):
        best = runner = 0
        row = -1
        share = 0
        for place in range(counts[i]):
            k = voted[i, place]
            count = votes[i, k]
            if count > best:
                runner, best, row, share = best, count, k, 1
            elif count == best and count > 0:
                runner = best
                share += 1
            elif count > runner:
                runner = count
        highest[i], second[i] = best, runner
        star[i] = star_of[row] if share == 1 else -1
        outcome[i] = UNMATCHED if share == 0 else UNIQUE if share == 1 else AMBIGUOUS
        any_tie = any_tie or share > 1
    return any_tie


@borrowing
def name_rivals(votes, star_of, outcome, highest, rivals):  # type: ignore[no-untyped-def]
    """Into `rivals` (R, n) the `star_of` of who share an ambiguous star's highest tally, then -1.

    The brightest come first, and at most R of them.
    """
    rivals[:] = -1
    for i in range(votes.shape[0]):
        if outcome[i] != AMBIGUOUS:
            continue
        place = 0
        for row in range(votes.shape[1]):
            if place == len(rivals):
                break
            if votes[i, row] == highest[i]:
                rivals[place, i] = star_of[row]
                place += 1
