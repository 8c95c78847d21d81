"""The identifier `verified`: a probability for every star, from all that is known of all of them.

Hypotheses are searched for without the tests of steps 1 to 10 and weighed as a
posterior (`search`, `evidence`); a star is unique from a probability of
0.999.  STARID's votes are counted beside it and shown.
"""

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from service.compiled.copying import copy_rows
from service.compiled.jit import njit
from service.identify.hypotheses.evidence import log_sum
from service.identify.hypotheses.marginals import StarPosterior, marginals
from service.identify.hypotheses.mirror import (
    LOG_MIRRORED,
    in_a_mirror,
    may_be_mirrored,
    reflect,
    weigh_in_a_mirror,
)
from service.identify.hypotheses.scene import (
    ObservedStars,
    ZonePairs,
    ZoneStars,
    ledger_for,
    scene_in,
    scratch_for,
)
from service.identify.hypotheses.search import search
from service.identify.identification import Identification, Integers, Outcome
from service.identify.sighting import Sighting
from service.identify.voting.starid import MAX_RIVALS, identify_by_votes

UNIQUE_PROBABILITY = 0.999

_UNMATCHED, _UNIQUE, _AMBIGUOUS = (int(outcome) for outcome in Outcome)


class Posterior(Struct, frozen=True, eq=False, gc=False):
    """What the hypotheses say of each star of a sighting.

    `bounded`: the search ended at the most work that was left.  `mirrored`: a mirror
    image of the field fits better.
    """

    stars: StarPosterior
    bounded: bool
    mirrored: bool


def posterior_of(sighting: Sighting, exhaustive: bool = False) -> Posterior:
    """Weigh the hypotheses of a sighting; `exhaustive`: go on after one that outweighs chance."""
    stars = posterior_for(len(sighting.direction))
    arrays = sighting.arrays, sighting.zone.arrays, sighting.bounds
    bounded, mirrored, work = _weigh(*arrays, exhaustive, sighting.budget.left, stars)
    sighting.budget.spend(work)
    return Posterior(stars, bounded, mirrored)


def posterior_for(n: int) -> StarPosterior:
    """Room for the posterior of n stars, and one rival more than an answer lists."""
    return StarPosterior(
        star=np.empty(n, np.int64),
        probability=np.empty(n),
        none=np.empty(n),
        rivals=np.empty((n, MAX_RIVALS + 1), np.int64),
        rival_probability=np.empty((n, MAX_RIVALS + 1)),
        hypothesis=np.empty(n, np.int64),
    )


def identify_verified(sighting: Sighting) -> Identification:
    """Identify the stars of one tracker by the posterior of hypotheses."""
    star_of = sighting.zone.star
    # The votes first, which cost least.
    votes, posterior = identify_by_votes(sighting), posterior_of(sighting)
    found = posterior.stars
    n = len(found.star)
    outcome, star = np.empty(n, np.int64), np.full(n, -1)
    probability = np.empty(n)
    rivals: list[tuple[int, ...]] = [()] * n
    likely: list[tuple[float, ...]] = [()] * n
    rivals_cut = 0
    columns = zip(found.star.tolist(), found.probability.tolist(), found.none.tolist(), strict=True)
    for k, (row, chance, none) in enumerate(columns):
        if chance >= UNIQUE_PROBABILITY:
            # Of a unique star the others are too unlikely to matter.
            outcome[k], star[k], probability[k] = _UNIQUE, star_of[row], chance
            continue
        unmatched = none >= chance
        outcome[k] = _UNMATCHED if unmatched else _AMBIGUOUS
        probability[k] = none if unmatched else chance
        in_question = found.rivals[k] >= 0
        rivals_cut += int(in_question[MAX_RIVALS])
        in_question[MAX_RIVALS] = False
        rivals[k] = tuple(star_of[found.rivals[k][in_question]].tolist())
        likely[k] = tuple(found.rival_probability[k][in_question].tolist())
    return Identification(
        outcome=outcome,
        star=star,
        votes=votes.votes,
        runner_up=votes.runner_up,
        rivals=tuple(rivals),
        rival_probability=tuple(likely),
        probability=probability,
        rivals_cut=rivals_cut,
        bounded=posterior.bounded or votes.bounded,
        hypothesis=_named(found.hypothesis, star_of),
        mirrored=posterior.mirrored,
    )


def _named(rows: Integers, star_of: npt.NDArray[np.int32]) -> Integers:
    """The stars of zone rows (n,), -1 where there is no row; a zone may have no stars."""
    star = np.full(len(rows), -1)
    star[rows >= 0] = star_of[rows[rows >= 0]]
    return star


def scene_of(sighting: Sighting) -> tuple[ObservedStars, ZoneStars, ZonePairs]:
    """The sighting as the search takes it."""
    scene = scene_in(sighting.arrays, sighting.zone.arrays, sighting.bounds)
    return scene  # type: ignore[no-any-return]


@njit(nogil=True)
def _weigh(sighted, zone, bounds, exhaustive, max_work, posterior):  # type: ignore[no-untyped-def]
    """Search and marginals of a scene; whether it was bounded, whether mirrored, and the work."""
    n = len(sighted.direction)
    posterior.star[:], posterior.probability[:], posterior.none[:] = -1, 0.0, 1.0
    posterior.rivals[:], posterior.rival_probability[:], posterior.hypothesis[:] = -1, 0.0, -1
    if n < 2 or len(zone.direction) < 2:
        return False, False, 0
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
