"""The hypotheses found so far, with what stands next to them, and what they say of each star.

The ledger is two arrays, rows of matches and their log weights; `rest` is the
log weight of the null and of what was too light, or too much, to keep.
"""

import math

import numpy as np
from numba import njit

from service.identify import evidence
from service.identify.fitting import fit, log_weight_of, weigh, weigh_without
from service.identify.scene import within
from service.sky.star_buckets import nearest
from service.uncounted import borrowing, owning
from service.vectors import Vector

MATCH_GATE = 34.0
"""In sigmas: how far a star may lie from where a hypothesis's attitude puts it."""
LARGEST_GATE_RAD = 0.009
NEGLIGIBLE = 18.0
"""A hypothesis lighter than the best by this, in logarithms, is only counted, not kept."""
FEW = 32
"""Hypotheses that are looked through one by one; of more there is a table by hash."""
NEAR_SIGMAS, NEAR_MAG, RARE = 3.0, 0.5, -6.0
"""How near a matched star lies that is not tried as clutter, where chance neighbours are rare."""
LEAST_GROUP = 3
"""So many stars that one attitude leaves unexplained may have another attitude of their own."""
RIVAL_PROBABILITY = 1e-3
"""A star at least this likely is named among the rivals of one that is not unique."""


@borrowing
def known(match, ledger, count, table):  # type: ignore[no-untyped-def]
    """Whether the ledger holds this hypothesis."""
    if count <= FEW:
        for h in range(count):  # noqa: SIM110 - compiled, without a generator
            if _same(match, ledger, h):
                return True
        return False
    at = _hash(match) & (len(table) - 1)
    while table[at] >= 0:
        if _same(match, ledger, table[at]):
            return True
        at = (at + 1) & (len(table) - 1)
    return False


@borrowing
def _same(match, ledger, h):  # type: ignore[no-untyped-def]
    """Whether hypothesis h of the ledger names the same stars."""
    for k in range(len(match)):  # noqa: SIM110 - compiled, without a generator
        if ledger[h, k] != match[k]:
            return False
    return True


@borrowing
def _hash(match):  # type: ignore[no-untyped-def]
    """A number that scatters hypotheses, also those that differ in one star."""
    hashed = 0
    for row in match:
        hashed = (hashed ^ (row + 1)) * 73856093
    return hashed ^ (hashed >> 17)


@borrowing
def _enter(ledger, h, table):  # type: ignore[no-untyped-def]
    """Write where the ledger has hypothesis h into the table by hash."""
    at = _hash(ledger[h]) & (len(table) - 1)
    while table[at] >= 0:
        at = (at + 1) & (len(table) - 1)
    table[at] = h


@borrowing
def part_of(match, whole):  # type: ignore[no-untyped-def]
    """Whether every star of a match is the same in another."""
    apart = 0
    for k in range(len(match)):
        apart += match[k] >= 0 and match[k] != whole[k]
    return apart == 0


@borrowing
def leaves_a_group(match):  # type: ignore[no-untyped-def]
    """Whether a match leaves so many stars unexplained that another attitude may explain them.

    A reflection doubles every star, and a slew halves them: chance explains
    neither half, so that the first hypothesis beyond chance is not the only one.
    """
    unexplained = 0
    for row in match:
        unexplained += row < 0
    return unexplained >= LEAST_GROUP


@borrowing
def log_sum(a, b):  # type: ignore[no-untyped-def]
    """ln(e^a + e^b)."""
    top = max(a, b)
    return top if top == -math.inf else top + math.log(math.exp(a - top) + math.exp(b - top))


@owning
def _smallest(values: Vector, at: int) -> float:
    """The value before which so many are smaller."""
    found: float = np.partition(values, at)[at]
    return found


@borrowing
def keep(match, value, ledger, log_weight, count, rest, table, range_kept, leader):  # type: ignore[no-untyped-def]
    """Keep a weighed hypothesis, the heaviest also as the `leader` (n,).

    Where there is no room, the lightest quarter goes to the rest, and from then on
    whatever is no heavier.  `range_kept` has the heaviest of those that went, and
    the heaviest of all.
    """
    if value <= range_kept[0]:
        return count, log_sum(rest, value)
    if value > range_kept[1]:
        range_kept[1] = value
        for k in range(len(match)):
            leader[k] = match[k]
    if count == len(log_weight):
        quarter = count // 4
        floor = range_kept[0] = _smallest(log_weight, quarter)
        stay = 0
        for h in range(count):
            if log_weight[h] <= floor and h - stay <= quarter:
                rest = log_sum(rest, log_weight[h])
                continue
            for k in range(len(match)):
                ledger[stay, k] = ledger[h, k]
            log_weight[stay] = log_weight[h]
            stay += 1
        count = stay
        table[:] = -1
        for h in range(count):
            _enter(ledger, h, table)
        if value <= floor:
            return count, log_sum(rest, value)
    for k in range(len(match)):
        ledger[count, k] = match[k]
    log_weight[count] = value
    if count > FEW:
        _enter(ledger, count, table)
    elif count == FEW:
        table[:] = -1
        for h in range(count + 1):
            _enter(ledger, h, table)
    return count + 1, rest


@borrowing
def consider(seen, stars, match, scratch, ledger, log_weight, count, rest, best):  # type: ignore[no-untyped-def]
    """Fit a hypothesis, match all stars anew at its attitude, weigh it and what stands next to it.

    Next to it stand the hypotheses without one of its stars, unless that one
    sits well, and with a star's second-nearest neighbour in its place.  Returns
    the number of hypotheses, the rest, the heaviest, the work, in stars looked
    up or fitted, and whether the stars fit together at all.
    """
    n = len(match)
    matched, square, log_det = fit(seen, stars, match, scratch, 1)
    if matched == 0:
        return count, rest, best, n, True
    misfit = math.sqrt(square / matched) > evidence.POSITION_SCALES[-1] * seen.reference_sigma
    if matched > 3 and misfit:
        return count, rest, best, n, False
    fresh, second, table = scratch.fresh, scratch.second, scratch.table
    kept, leader = scratch.range_kept, scratch.leader
    _match_at(seen, stars, scratch.t, fresh, second)
    if known(fresh, ledger, count, table):
        return count, rest, best, 2 * n, not misfit
    if not (part_of(fresh, match) and part_of(match, fresh)):
        matched, square, log_det = fit(seen, stars, fresh, scratch, 1)
        if matched < 2:
            return count, rest, best, 3 * n, not misfit
    base = log_weight_of(seen, stars, fresh, scratch.t, matched, square, log_det)
    count, rest = keep(fresh, base, ledger, log_weight, count, rest, table, kept, leader)
    best = max(best, base)
    work = 3 * n
    if base < max(best, rest) - NEGLIGIBLE:
        return count, rest, best, work, not misfit
    rare = _neighbours_are_rare(seen, stars)
    for k in range(n):
        if fresh[k] < 0 or (rare and _sits_well(seen, stars, fresh, k, scratch)):
            continue
        mine = fresh[k]
        fresh[k] = -1
        if not known(fresh, ledger, count, table):
            value = weigh_without(seen, stars, fresh, k, square, scratch)
            count, rest = keep(fresh, value, ledger, log_weight, count, rest, table, kept, leader)
            best = max(best, value)
            work += 1
        fresh[k] = mine
    for k in range(n):
        if fresh[k] < 0 or second[k] < 0 or _names(fresh, second[k]):
            continue
        mine = fresh[k]
        fresh[k] = second[k]
        if not known(fresh, ledger, count, table):
            # This fits anew: nothing below may need the fit of the hypothesis itself.
            value = weigh(seen, stars, fresh, scratch)
            count, rest = keep(fresh, value, ledger, log_weight, count, rest, table, kept, leader)
            best = max(best, value)
            work += n
        fresh[k] = mine
    return count, rest, best, work, not misfit


@borrowing
def _names(match, row):  # type: ignore[no-untyped-def]
    """Whether a match has this zone star."""
    for one in match:  # noqa: SIM110 - compiled, without a generator
        if one == row:
            return True
    return False


@borrowing
def _neighbours_are_rare(seen, stars):  # type: ignore[no-untyped-def]
    """Whether chance hardly ever puts a star of the zone within the widest scale of noise.

    Its probability is rho 2 pi s^2; where that is as rare as e^-6, the hypothesis
    without a star that sits well weighs less than about e^-8 of the one with it.
    """
    widest = evidence.POSITION_SCALES[-1] * seen.reference_sigma
    return stars.log_density + math.log(2.0 * math.pi * widest * widest) <= RARE


@njit(cache=True, nogil=True, inline="always")
def _sits_well(seen, stars, match, k, scratch):  # type: ignore[no-untyped-def]
    """Whether a star fits so well, in place and magnitude, that it can hardly be clutter."""
    # False where there is no magnitude, as with any comparison with NaN.
    if abs(seen.magnitude[k] - stars.magnitude[match[k]]) > NEAR_MAG:
        return False
    t, observed, references = scratch.t, seen.observed, scratch.references
    r0, r1, r2 = references[k, 0], references[k, 1], references[k, 2]
    square = 0.0
    for i in range(3):
        square += (observed[k, i] - t[i, 0] * r0 - t[i, 1] * r1 - t[i, 2] * r2) ** 2
    return square < (NEAR_SIGMAS * seen.sigma_rad[k]) ** 2


@njit(cache=True, nogil=True, inline="always")
def _match_at(seen, stars, t, first, second):  # type: ignore[no-untyped-def]
    """Match every observed star at an attitude: its nearest zone star, and the second-nearest."""
    n = len(seen.observed)
    first[:] = -1
    second[:] = -1
    for k in range(n):
        o0, o1, o2 = seen.observed[k, 0], seen.observed[k, 1], seen.observed[k, 2]
        p0 = t[0, 0] * o0 + t[1, 0] * o1 + t[2, 0] * o2 - seen.velocity[0]
        p1 = t[0, 1] * o0 + t[1, 1] * o1 + t[2, 1] * o2 - seen.velocity[1]
        p2 = t[0, 2] * o0 + t[1, 2] * o1 + t[2, 2] * o2 - seen.velocity[2]
        norm = math.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
        gate = min(MATCH_GATE * seen.sigma_rad[k], LARGEST_GATE_RAD)
        one, other = nearest(
            p0 / norm,
            p1 / norm,
            p2 / norm,
            gate,
            stars.grid_start,
            stars.grid_rows,
            stars.grid_direction,
            first,
            k,
        )
        if one >= 0 and within(one, stars):
            first[k] = one
        if other >= 0 and within(other, stars):
            second[k] = other


@njit(cache=True, nogil=True)
def marginals(ledger, log_weight, count, rest, star, probability, none, rivals, likely):  # type: ignore[no-untyped-def]
    """Per star: the likeliest zone row, its probability, that of no star, and all rows in question.

    `rivals` (n, R) gets the rows by falling probability, -1 beyond the last,
    `likely` (n, R) their probabilities.
    """
    n, room = rivals.shape
    top = rest
    for h in range(count):
        top = max(top, log_weight[h])
    weight = np.empty(count)
    unknown = math.exp(rest - top)
    total = unknown
    for h in range(count):
        weight[h] = math.exp(log_weight[h] - top)
        total += weight[h]
    many = count > FEW
    order = np.empty(0, np.int64)
    rows = np.empty(count + 1, np.int64)
    share = np.empty(count + 1)
    for k in range(n):
        different = 0
        nothing = unknown
        if many:
            order = np.argsort(ledger[:count, k])
        for rank in range(count):
            h = order[rank] if many else rank
            row = ledger[h, k]
            if row < 0:
                nothing += weight[h]
                continue
            # In order of rows, those of one star stand together.
            at = max(different - 1, 0) if many else 0
            while at < different and rows[at] != row:
                at += 1
            if at == different:
                rows[at], share[at] = row, 0.0
                different += 1
            share[at] += weight[h]
        none[k] = nothing / total
        star[k], probability[k] = -1, 0.0
        rivals[k], likely[k] = -1, 0.0
        for rank in range(room):
            best = -1
            for at in range(different):
                if share[at] >= 0.0 and (best < 0 or share[at] > share[best]):
                    best = at
            if best < 0:
                break
            chance = share[best] / total
            if rank == 0:
                star[k], probability[k] = rows[best], chance
            if chance >= RIVAL_PROBABILITY:
                rivals[k, rank], likely[k, rank] = rows[best], chance
                share[best] = -1.0
            else:
                break
