"""The hypotheses found so far, with what stands next to them, and what they say of each star.

The ledger is two arrays, rows of matches and their log weights; `rest` is the
log weight of the null and of what was too light, or too much, to keep.
"""

import math

import numpy as np
from numba import njit

from service.identify.fitting import fit, weigh
from service.identify.scene import nearest, within

MAX_HYPOTHESES = 2048
MATCH_GATE = 34.0
"""In sigmas: how far a star may lie from where a hypothesis's attitude puts it."""
LARGEST_GATE_RAD = 0.009
NEGLIGIBLE = 18.0
"""A hypothesis lighter than the best by this, in logarithms, is only counted, not kept."""
RIVAL_PROBABILITY = 1e-3
"""A star at least this likely is named among the rivals of an ambiguous one."""


@njit(cache=True, nogil=True)
def known(match, ledger, count):  # type: ignore[no-untyped-def]
    """Whether the ledger holds this hypothesis."""
    for h in range(count):
        same = True
        for k in range(len(match)):
            if ledger[h, k] != match[k]:
                same = False
                break
        if same:
            return True
    return False


@njit(cache=True, nogil=True)
def log_sum(a, b):  # type: ignore[no-untyped-def]
    """ln(e^a + e^b)."""
    top = max(a, b)
    return top if top == -math.inf else top + math.log(math.exp(a - top) + math.exp(b - top))


@njit(cache=True, nogil=True)
def keep(match, value, ledger, log_weight, count, rest):  # type: ignore[no-untyped-def]
    """Keep a weighed hypothesis; where there is no room, the lightest goes to the rest."""
    if value == -math.inf:
        return count, rest
    if count < len(log_weight):
        ledger[count] = match
        log_weight[count] = value
        return count + 1, rest
    lightest = np.argmin(log_weight)
    if value <= log_weight[lightest]:
        return count, log_sum(rest, value)
    rest = log_sum(rest, log_weight[lightest])
    ledger[lightest] = match
    log_weight[lightest] = value
    return count, rest


@njit(cache=True, nogil=True)
def consider(seen, stars, density, match, ledger, log_weight, count, rest):  # type: ignore[no-untyped-def]
    """Fit a hypothesis, match all stars anew at its attitude, weigh it and what stands next to it.

    Next to it stand the hypotheses without one of its stars, and with a star's
    second-nearest neighbour in its place.
    """
    n = len(match)
    t, references = np.empty((3, 3)), np.empty((n, 3))
    if fit(seen, stars, match, t, references)[0] == 0:
        return count, rest
    p, found = np.empty(3), np.empty(2, np.int32)
    second = np.full(n, -1, np.int32)
    fresh = np.full(n, -1, np.int32)
    for k in range(n):
        for j in range(3):
            p[j] = (
                t[0, j] * seen.observed[k, 0]
                + t[1, j] * seen.observed[k, 1]
                + t[2, j] * seen.observed[k, 2]
            )
        norm = 0.0
        for j in range(3):
            p[j] -= seen.velocity[j]
            norm += p[j] * p[j]
        norm = math.sqrt(norm)
        for j in range(3):
            p[j] /= norm
        gate = min(MATCH_GATE * seen.sigma_rad[k], LARGEST_GATE_RAD)
        nearest(p, gate, stars, fresh[:k], found)
        if found[0] >= 0 and within(found[0], stars):
            fresh[k] = found[0]
        if found[1] >= 0 and within(found[1], stars):
            second[k] = found[1]
    if known(fresh, ledger, count):
        return count, rest
    base = weigh(seen, stars, density, fresh, t, references)
    count, rest = keep(fresh, base, ledger, log_weight, count, rest)
    if base < rest - NEGLIGIBLE:
        return count, rest
    for k in range(n):
        if fresh[k] < 0:
            continue
        mine = fresh[k]
        for other in (np.int32(-1), second[k]):
            taken = False
            for x in range(n):
                if other >= 0 and fresh[x] == other:
                    taken = True
            if taken:
                continue
            fresh[k] = other
            if not known(fresh, ledger, count):
                value = weigh(seen, stars, density, fresh, t, references)
                count, rest = keep(fresh, value, ledger, log_weight, count, rest)
            if second[k] == -1:
                break
        fresh[k] = mine
    return count, rest


@njit(cache=True, nogil=True)
def marginals(ledger, log_weight, count, rest, star, probability, none, rivals):  # type: ignore[no-untyped-def]
    """Per star: the likeliest zone row, its probability, that of no star, and all rows in question.

    `rivals` (n, R) gets the rows by falling probability, -1 beyond the last.
    """
    n, room = rivals.shape
    top = rest
    for h in range(count):
        top = max(top, log_weight[h])
    total = math.exp(rest - top)
    for h in range(count):
        total += math.exp(log_weight[h] - top)
    rows = np.empty(count + 1, np.int64)
    share = np.empty(count + 1)
    for k in range(n):
        different = 0
        nothing = math.exp(rest - top)
        for h in range(count):
            w = math.exp(log_weight[h] - top)
            row = ledger[h, k]
            if row < 0:
                nothing += w
                continue
            at = 0
            while at < different and rows[at] != row:
                at += 1
            if at == different:
                rows[at], share[at] = row, 0.0
                different += 1
            share[at] += w
        none[k] = nothing / total
        star[k], probability[k] = -1, 0.0
        ranked = np.argsort(-share[:different])
        for at in range(room):
            rivals[k, at] = -1
            if at < different and share[ranked[at]] / total >= RIVAL_PROBABILITY:
                rivals[k, at] = rows[ranked[at]]
        if different:
            star[k] = rows[ranked[0]]
            probability[k] = share[ranked[0]] / total
