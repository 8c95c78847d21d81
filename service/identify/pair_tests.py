"""STARID, steps 1 to 10: which candidate pairs survive, and the votes that they cast.

Source: Fink & Shoup 1994, sections 2.1 and 2.2.  The names of the paper stand
in the comments.  The kernel allocates little, holds no state and releases the
interpreter's lock.
"""

import math

import numpy as np
from numba import njit

from service.identify.fov_rotation import rotation_rad
from service.identify.identification import Outcome
from service.sky.pairs import separation_rad

UNMATCHED, UNIQUE, AMBIGUOUS = (int(outcome) for outcome in Outcome)


@njit(cache=True, nogil=True, error_model="numpy")
def cast_votes(  # type: ignore[no-untyped-def]
    observed,  # (n, 3) unit vectors, inertial through the a priori attitude
    observed_magnitude,  # (n,) NaN: the magnitude tests pass the star by
    direction,  # (m, 3) zone stars, brightest first
    magnitude,  # (m,)
    pair_separation,  # (NTOT,) radians, ascending
    pair_brighter,
    pair_dimmer,
    bin_start,
    bins_per_rad,
    axis,  # (3,) the exact zone axis; in a band the catalog generation vector
    least,  # bounds on a zone star's angle to the axis, radians
    most,
    separation_tolerance,  # SEPTOL, radians
    magnitude_tolerance,  # XMTOL
    order_tolerance,  # TMAGMX
    cross_tolerance,  # CAPMAX or BANMAX, radians
    pole_tolerance,  # BANTOL1, radians
    angle_tolerance,  # BANTOL2, radians
    rotation_tolerance,  # of the field of view, radians
    boresight,  # (3,) inertial through the a priori attitude
    is_band,
    test_magnitude,
    test_cross,
    test_pole,
    test_rotation,
    votes,  # (n, m) counted up
    edges,  # (0, 4), or as many rows as half the votes: each vote's i, a, j, b
):
    """Cast the votes of every observed pair's surviving candidate pairs."""
    kept = 0
    n, m = len(observed), len(direction)
    # A zone star's angle to the axis is worked out when first asked for; -1: not yet.
    polar = np.full(m, -1.0)
    observed_polar = np.empty(n)
    for i in range(n):
        observed_polar[i] = separation_rad(observed[i], axis)
    last_bin = len(bin_start) - 2
    normal = np.empty(3)
    candidate_normal = np.empty(3)
    for i in range(n - 1):
        for j in range(i + 1, n):
            separation = separation_rad(observed[i], observed[j])
            low = separation - separation_tolerance
            high = separation + separation_tolerance
            first_bin = int(low * bins_per_rad)
            if first_bin > last_bin:
                continue
            has_normal = _unit_cross(observed[i], observed[j], normal)

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
                a, b = pair_brighter[k], pair_dimmer[k]
                order = 0  # LORD: +1 when i goes with a and j with b, -1 the other way round

                # Steps 2 and 3: brighter to brighter, dimmer to dimmer within XMTOL.
                if ordered:
                    if abs(observed_magnitude[bright] - magnitude[a]) > magnitude_tolerance:
                        continue
                    if abs(observed_magnitude[dim] - magnitude[b]) > magnitude_tolerance:
                        continue
                    order = 1 if bright == i else -1

                # The zone on the shelf may be wider than the one that was asked for.
                if polar[a] < 0.0:
                    polar[a] = separation_rad(direction[a], axis)
                if polar[b] < 0.0:
                    polar[b] = separation_rad(direction[b], axis)
                if polar[a] < least or polar[a] > most or polar[b] < least or polar[b] > most:
                    continue

                by_pole = False
                if test_pole:
                    # Step 6: GTODIF and GTRDIF.
                    observed_difference = abs(observed_polar[i] - observed_polar[j])
                    candidate_difference = abs(polar[a] - polar[b])
                    if abs(observed_difference - candidate_difference) > pole_tolerance:
                        continue
                    by_pole = (
                        observed_difference > pole_tolerance
                        and candidate_difference > pole_tolerance
                    )
                if by_pole:
                    # Step 7: greater angle with greater, lesser with lesser, within BANTOL2.
                    greater = max(observed_polar[i], observed_polar[j]) - max(polar[a], polar[b])
                    lesser = min(observed_polar[i], observed_polar[j]) - min(polar[a], polar[b])
                    if abs(greater) > angle_tolerance or abs(lesser) > angle_tolerance:
                        continue
                    same = (observed_polar[i] > observed_polar[j]) == (polar[a] > polar[b])
                    pole_order = 1 if same else -1
                    # Steps 8 and 9: the magnitudes, where they told an order, must agree.
                    if order != 0 and order != pole_order:
                        continue
                    order = pole_order
                elif test_cross:
                    # Steps 4, 5 and 10: CRSSEP, or its supplement CRSSEN for the other order.
                    if not has_normal or not _unit_cross(
                        direction[a], direction[b], candidate_normal
                    ):
                        continue
                    crossing = separation_rad(normal, candidate_normal)
                    along = crossing <= cross_tolerance
                    against = math.pi - crossing <= cross_tolerance
                    if order == 0:
                        if along:
                            order = 1
                        elif against:
                            order = -1
                        else:
                            continue
                    elif not (along if order == 1 else against):
                        continue

                if test_rotation:
                    # Of both orders, where nothing told one, that which turns little stays.
                    along, against = order >= 0, order <= 0
                    if along:
                        turn = rotation_rad(
                            observed[i],
                            observed[j],
                            direction[a],
                            direction[b],
                            boresight,
                            axis,
                            is_band,
                        )
                        along = turn <= rotation_tolerance
                    if against:
                        turn = rotation_rad(
                            observed[i],
                            observed[j],
                            direction[b],
                            direction[a],
                            boresight,
                            axis,
                            is_band,
                        )
                        against = turn <= rotation_tolerance
                    if not (along or against):
                        continue
                    if not (along and against):
                        order = 1 if along else -1

                if order >= 0:
                    votes[i, a] += 1
                    votes[j, b] += 1
                    if len(edges):
                        edges[kept, 0], edges[kept, 1] = i, a
                        edges[kept, 2], edges[kept, 3] = j, b
                        kept += 1
                if order <= 0:
                    votes[i, b] += 1
                    votes[j, a] += 1
                    if len(edges):
                        edges[kept, 0], edges[kept, 1] = i, b
                        edges[kept, 2], edges[kept, 3] = j, a
                        kept += 1


@njit(cache=True, nogil=True, inline="always")
def _unit_cross(a, b, out):  # type: ignore[no-untyped-def]
    """The unit cross product of two vectors; False where they are parallel."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    z = a[0] * b[1] - a[1] * b[0]
    norm = math.sqrt(x * x + y * y + z * z)
    if norm == 0.0:
        return False
    out[0], out[1], out[2] = x / norm, y / norm, z / norm
    return True


@njit(cache=True, nogil=True)
def count_votes(votes, star_of, outcome, star, highest, second):  # type: ignore[no-untyped-def]
    """Per observed star: outcome, the winner's `star_of` (-1: none) and the two highest tallies.

    True where any star is ambiguous.
    """
    any_tie = False
    for i in range(votes.shape[0]):
        best = runner = 0
        row = -1
        share = 0
        for k in range(votes.shape[1]):
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
