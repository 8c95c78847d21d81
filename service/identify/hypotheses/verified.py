"""The identifier `verified`: a posterior probability for the identity of every star.

Hypotheses are searched without the tests of steps 1 to 10 and weighed by their posterior (`search`,
`evidence`); a star is unique from a probability of 0.999. STARID's votes are counted too, for
information.
"""

import numpy as np

from service.compiled.arrays import copy_rows
from service.compiled.jit import njit, njit_no_refcount
from service.identify.hypotheses.evidence import log_sum
from service.identify.hypotheses.ledger import StarPosterior, marginals
from service.identify.hypotheses.mirror import (
    LOG_MIRRORED,
    in_a_mirror,
    may_be_mirrored,
    reflect,
    weigh_in_a_mirror,
)
from service.identify.hypotheses.scene import ledger_for, scene_in, scratch_for
from service.identify.hypotheses.search import search
from service.identify.identification import IdentifiedColumns, Integers, Outcome
from service.identify.sighting import SightingColumns, bounds_at, sighted_at
from service.identify.voting.starid import identify_by_votes
from service.missions.mission import Rules
from service.sky.zones import Zone

UNIQUE_PROBABILITY = 0.999

_UNMATCHED, _UNIQUE, _AMBIGUOUS = (int(outcome) for outcome in Outcome)


def identify_verified(
    which: Integers,
    seen: SightingColumns,
    zone: Zone,
    rules: Rules,
    found: IdentifiedColumns,
    exhaustive: bool = False,
) -> None:
    """Identify the stars of sightings by the posterior of hypotheses, into `found`.

    `which` has the row numbers of the sightings that the zone serves. With `exhaustive` the search
    continues after a hypothesis that outweighs chance.
    """
    # The votes are counted first because they cost least.
    identify_by_votes(which, seen, zone, rules, found)
    weigh_sightings(which, seen, zone.arrays, zone.star, exhaustive, found)


@njit(nogil=True)
def weigh_sightings(which, seen, zone, star_of, exhaustive, found):  # type: ignore[no-untyped-def]
    """Weigh hypotheses for the sightings that a zone serves, and record their stars' identities.

    `which` are the sightings' rows in the columns `seen` and `found`.
    """
    for s in which:
        first, last = seen.offsets[s], seen.offsets[s + 1]
        n = last - first
        posterior = StarPosterior(
            star=np.full(n, -1),
            probability=np.zeros(n),
            none=np.ones(n),
            rivals=found.rivals[first:last],
            rival_probability=found.rival_probability[first:last],
            hypothesis=found.hypothesis[first:last],
        )
        posterior.rivals[:], posterior.rival_probability[:], posterior.hypothesis[:] = -1, 0.0, -1
        found.rivals_cut[s] = 0
        found.explained[s] = 0
        if n >= 2 and len(zone.direction) >= 2:
            max_work = max(seen.left[s], 0)
            bounded, mirrored, work = _weigh(
                sighted_at(seen, s), zone, bounds_at(seen, s), exhaustive, max_work, posterior
            )
            found.bounded[s], found.mirrored[s] = found.bounded[s] or bounded, mirrored
            seen.left[s] -= work
        for k in range(n):
            found.rivals_cut[s] += _name(k, first + k, posterior, star_of, found)
            found.explained[s] += found.hypothesis[first + k] >= 0


@njit_no_refcount
def _name(k, at, posterior, star_of, found):  # type: ignore[no-untyped-def]
    """Record the identity of star k of a posterior in row `at`; true if its rivals are cut."""
    row, chance, none = posterior.star[k], posterior.probability[k], posterior.none[k]
    rivals, explained = found.rivals[at], found.hypothesis[at]
    found.hypothesis[at] = star_of[explained] if explained >= 0 else -1
    if chance >= UNIQUE_PROBABILITY:
        # The rivals of a unique star are too unlikely to list.
        found.outcome[at], found.star[at], found.probability[at] = _UNIQUE, star_of[row], chance
        rivals[:] = -1
        return False
    unmatched = none >= chance
    found.outcome[at], found.star[at] = _UNMATCHED if unmatched else _AMBIGUOUS, -1
    found.probability[at] = none if unmatched else chance
    for place in range(len(rivals)):
        if rivals[place] >= 0:
            rivals[place] = star_of[rivals[place]]
    return rivals[len(rivals) - 1] >= 0


@njit(nogil=True)
def _weigh(sighted, zone, bounds, exhaustive, max_work, posterior):  # type: ignore[no-untyped-def]
    """Search and sum a sighting's hypotheses; returns if cut short, if mirrored, and the work."""
    n = len(sighted.direction)
    observed, stars, pairs = scene_in(sighted, zone, bounds)
    scratch, ledger = scratch_for(n), ledger_for(n)
    progress, bounded = search(observed, stars, pairs, exhaustive, max_work, scratch, ledger)
    copy_rows(ledger.heaviest_match, posterior.hypothesis)
    unexplored_weight = progress.unexplored_weight
    mirrored, work = False, progress.work
    if may_be_mirrored(observed, ledger):
        image = np.empty((n, 3))
        reflect(observed.direction, sighted.boresight, image)
        reflected = in_a_mirror(observed, image)
        left = max_work - work
        weight, more = weigh_in_a_mirror(reflected, sighted.boresight, stars, pairs, left)
        mirrored, work = weight > ledger.heaviest[0], work + more
        bounded = bounded or more >= left
        unexplored_weight = log_sum(unexplored_weight, weight + LOG_MIRRORED)
    marginals(ledger, progress.count, unexplored_weight, posterior)
    return bounded, mirrored, work
