"""The hypotheses of a search, summed up to what they say of each star."""

import math
from typing import Any, NamedTuple

import numpy as np

from service.compiled.jit import njit
from service.identify.hypotheses.ledger import FEW

RIVAL_PROBABILITY = 1e-3
"""A star at least this likely is named among the rivals of one that is not unique."""


class StarPosterior(NamedTuple):
    """What the hypotheses say of each of n stars, as kernels write it.

    `star` (n,) is the likeliest zone row, -1 where there is none, `probability`
    (n,) its share, and `none` (n,) that of no star of the zone.  `rivals` (n, R) are
    all rows in question by falling `rival_probability` (n, R), -1 beyond the last.
    `hypothesis` (n,) are the rows of the heaviest hypothesis, -1 where it explains
    nothing.
    """

    star: Any
    probability: Any
    none: Any
    rivals: Any
    rival_probability: Any
    hypothesis: Any


@njit(nogil=True)
def marginals(ledger, count, unexplored_weight, posterior):  # type: ignore[no-untyped-def]
    """Sum up the first `count` hypotheses of a ledger; into all of `posterior` but `hypothesis`."""
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
            # In order of rows, those of one star stand together.
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
