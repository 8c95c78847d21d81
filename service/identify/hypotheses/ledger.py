"""Ledger of hypotheses: the heaviest ones found, and the marginal probabilities of each star."""

import math
from typing import Any, NamedTuple

import numpy as np

from service.compiled.jit import njit, njit_allocating, njit_inlined, njit_no_refcount
from service.identify.hypotheses.evidence import log_sum
from service.identify.hypotheses.scene import Progress
from service.vectors import Vector

FEW = 32
"""Number of hypotheses up to which the ledger is searched linearly; beyond, by a hash table."""
LEAST_GROUP = 3
"""Least number of unexplained stars for which a second attitude is searched."""
RIVAL_PROBABILITY = 1e-3
"""Least probability of a star that is listed among the rivals of an ambiguous one."""


@njit_inlined
def known(match, ledger, count):  # type: ignore[no-untyped-def]
    """True if the ledger's first `count` hypotheses include a match."""
    if count <= FEW:
        for h in range(count):  # noqa: SIM110 - compiled, without a generator
            if _same(match, ledger, h):
                return True
        return False
    table = ledger.table
    at = _hash(match) & (len(table) - 1)
    while table[at] >= 0:
        if _same(match, ledger, table[at]):
            return True
        at = (at + 1) & (len(table) - 1)
    return False


@njit_inlined
def _same(match, ledger, h):  # type: ignore[no-untyped-def]
    """True if hypothesis h of the ledger names the same stars as a match."""
    for k in range(len(match)):  # noqa: SIM110 - compiled, without a generator
        if ledger.match[h, k] != match[k]:
            return False
    return True


@njit_no_refcount
def _hash(match):  # type: ignore[no-untyped-def]
    """A hash of a match, by which hypotheses that differ in one star usually differ."""
    hashed = 0
    for row in match:
        hashed = (hashed ^ (row + 1)) * 73856093
    return hashed ^ (hashed >> 17)


@njit_no_refcount
def _enter(ledger, h):  # type: ignore[no-untyped-def]
    """Enter hypothesis h of the ledger into its own hash table."""
    table = ledger.table
    at = _hash(ledger.match[h]) & (len(table) - 1)
    while table[at] >= 0:
        at = (at + 1) & (len(table) - 1)
    table[at] = h


@njit_inlined
def is_part(match, whole):  # type: ignore[no-untyped-def]
    """True if every star of a match is identified alike in another match."""
    apart = 0
    for k in range(len(match)):
        apart += match[k] >= 0 and match[k] != whole[k]
    return apart == 0


@njit_no_refcount
def leaves_a_group(match):  # type: ignore[no-untyped-def]
    """True if a match leaves enough stars unexplained for a second attitude.

    A reflection doubles every star, and a slew splits the stars: chance explains neither half, so
    that a first significant hypothesis may have a second beside it.
    """
    unexplained = 0
    for row in match:
        unexplained += row < 0
    return unexplained >= LEAST_GROUP


@njit_allocating
def _smallest(values: Vector, at: int) -> float:
    """The value at a rank in ascending order, by Hoare's selection (1961, algorithm 65).

    Compiling numba's `np.partition` would take three seconds.
    """
    left = values.copy()
    low, high = 0, len(left) - 1
    while low < high:
        pivot = left[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while left[i] < pivot:
                i += 1
            while left[j] > pivot:
                j -= 1
            if i <= j:
                left[i], left[j] = left[j], left[i]
                i += 1
                j -= 1
        if j < at < i:
            break
        low, high = (low, j) if at <= j else (i, high)
    found: float = left[at]
    return found


@njit_no_refcount
def clear(ledger):  # type: ignore[no-untyped-def]
    """Reset the heaviest hypotheses in a ledger; the count of the new search hides all others."""
    ledger.heaviest_match[:] = -1
    ledger.heaviest[0] = ledger.heaviest_dropped[0] = -math.inf


@njit_inlined
def spent(progress, work):  # type: ignore[no-untyped-def]
    """The progress of a search with further work added."""
    return Progress(
        *(progress.count, progress.unexplored_weight, progress.best),
        *(progress.work + work, progress.max_work),
    )


@njit_inlined
def at_bound(progress):  # type: ignore[no-untyped-def]
    """True if a search has reached its work limit."""
    return progress.work >= progress.max_work


@njit_inlined
def left_unexplored(progress, log_weight):  # type: ignore[no-untyped-def]
    """The progress of a search with a log weight added to the unexplored weight."""
    total = log_sum(progress.unexplored_weight, log_weight)
    return Progress(progress.count, total, progress.best, progress.work, progress.max_work)


@njit_no_refcount
def keep(match, value, ledger, progress):  # type: ignore[no-untyped-def]
    """Add a weighed hypothesis to the ledger; returns the new progress of the search.

    Where the ledger is full, the lightest quarter goes to the unexplored weight, and from then on
    so does any hypothesis that is no heavier.
    """
    log_weight, count, unexplored = ledger.log_weight, progress.count, progress.unexplored_weight
    best, work, max_work = progress.best, progress.work, progress.max_work
    if value <= ledger.heaviest_dropped[0]:
        return left_unexplored(progress, value)
    if value > ledger.heaviest[0]:
        ledger.heaviest[0] = value
        for k in range(len(match)):
            ledger.heaviest_match[k] = match[k]
    if count == len(log_weight):
        count, unexplored = _drop_lightest(ledger, count, unexplored)
        if value <= ledger.heaviest_dropped[0]:
            return Progress(count, log_sum(unexplored, value), best, work, max_work)
    for k in range(len(match)):
        ledger.match[count, k] = match[k]
    log_weight[count] = value
    if count > FEW:
        _enter(ledger, count)
    elif count == FEW:
        ledger.table[:] = -1
        for h in range(count + 1):
            _enter(ledger, h)
    return Progress(count + 1, unexplored, best, work, max_work)


@njit_no_refcount
def _drop_lightest(ledger, count, unexplored):  # type: ignore[no-untyped-def]
    """Drop the lightest quarter of the ledger; returns the number left and the unexplored
    weight.
    """
    log_weight = ledger.log_weight
    quarter = count // 4
    floor = ledger.heaviest_dropped[0] = _smallest(log_weight, quarter)
    stay = 0
    for h in range(count):
        if log_weight[h] <= floor and h - stay <= quarter:
            unexplored = log_sum(unexplored, log_weight[h])
            continue
        for k in range(ledger.match.shape[1]):
            ledger.match[stay, k] = ledger.match[h, k]
        log_weight[stay] = log_weight[h]
        stay += 1
    ledger.table[:] = -1
    for h in range(stay):
        _enter(ledger, h)
    return stay, unexplored


class StarPosterior(NamedTuple):
    """The posterior of each of n stars, summed over hypotheses, as arrays filled by kernels.

    `star` (n,) is the most likely zone row, -1 for none, `probability` (n,) its probability, and
    `none` (n,) that of no star of the zone. `rivals` (n, R) are all possible rows by decreasing
    `rival_probability` (n, R), -1 after the last. `hypothesis` (n,) has the rows of the heaviest
    hypothesis, -1 for unexplained stars.
    """

    star: Any
    probability: Any
    none: Any
    rivals: Any
    rival_probability: Any
    hypothesis: Any


@njit(nogil=True)
def marginals(ledger, count, unexplored_weight, posterior):  # type: ignore[no-untyped-def]
    """Sum the hypotheses of a ledger into probabilities of each star's identities (`posterior`)."""
    rivals, rival_probability = posterior.rivals, posterior.rival_probability
    log_weight = ledger.log_weight
    n, listed = rivals.shape
    top = unexplored_weight
    for h in range(count):
        top = max(top, log_weight[h])
    weight = np.empty(count)
    unknown = math.exp(unexplored_weight - top)
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
            order = np.argsort(ledger.match[:count, k])
        for rank in range(count):
            h = order[rank] if many else rank
            row = ledger.match[h, k]
            if row < 0:
                nothing += weight[h]
                continue
            # Sorted by row, the entries of one star are adjacent.
            at = max(different - 1, 0) if many else 0
            while at < different and rows[at] != row:
                at += 1
            if at == different:
                rows[at], share[at] = row, 0.0
                different += 1
            share[at] += weight[h]
        posterior.none[k] = nothing / total
        posterior.star[k], posterior.probability[k] = -1, 0.0
        rivals[k], rival_probability[k] = -1, 0.0
        for rank in range(listed):
            best = -1
            for at in range(different):
                if share[at] >= 0.0 and (best < 0 or share[at] > share[best]):
                    best = at
            if best < 0:
                break
            chance = share[best] / total
            if rank == 0:
                posterior.star[k], posterior.probability[k] = rows[best], chance
            if chance >= RIVAL_PROBABILITY:
                rivals[k, rank], rival_probability[k, rank] = rows[best], chance
                share[best] = -1.0
            else:
                break
