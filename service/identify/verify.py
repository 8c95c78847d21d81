"""The identifier `verified`: a probability for every star, from all that is known of all of them.

Hypotheses are searched for without the tests of steps 1 to 10 and weighed as a
posterior (`search`, `evidence`); a star is unique from a probability of
0.999.  STARID's votes are counted beside it and shown.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import Struct
from numba import njit

from service.identify.evidence import PRIOR_DIRECTION, PRIOR_ROTATION
from service.identify.hypotheses import log_sum, marginals
from service.identify.identification import Identification, Integers, Outcome
from service.identify.mirror import (
    LOG_MIRRORED,
    gained_by_mirror,
    in_a_mirror,
    may_be_mirrored,
    reflect,
)
from service.identify.scene import MAX_HYPOTHESES, Pairs, Seen, Stars, log_density, scratch_for
from service.identify.search import search_in
from service.identify.starid import MAX_RIVALS, Sighting, identify_by_votes
from service.vectors import Vector, separation_deg

UNIQUE_PROBABILITY = 0.999

_UNMATCHED, _UNIQUE, _AMBIGUOUS = (int(outcome) for outcome in Outcome)


class Posterior(Struct, frozen=True, eq=False, gc=False):
    """What the hypotheses say of each of n stars.

    `star` is the likeliest zone row, -1 where there is none, and `probability`
    its share; `none` that of no star of the zone.  `rivals` (n, R) are zone rows
    by falling probability, `rival_probability` (n, R), -1 beyond the last; one more
    than an answer lists.  `hypothesis` (n,) are the rows of the heaviest
    hypothesis, -1 for a star that it leaves unexplained.  `mirrored`: a mirror
    image of the field fits better.
    """

    star: Integers
    probability: Vector
    none: Vector
    rivals: Integers
    rival_probability: npt.NDArray[np.float64]
    hypothesis: Integers
    bounded: bool
    mirrored: bool


def posterior_of(sighting: Sighting, exhaustive: bool = False) -> Posterior:
    """Weigh the hypotheses of a sighting; `exhaustive`: go on after one that outweighs chance."""
    n = len(sighting.direction)
    star, probability = np.empty(n, np.int64), np.empty((2, n))
    sought = MAX_RIVALS + 1
    rivals, likely = np.empty((n, sought), np.int64), np.empty((n, sought))
    hypothesis = np.empty(n, np.int64)
    found = star, probability, rivals, likely, hypothesis
    given = *_scene_arguments(sighting), sighting.boresight, exhaustive
    # mypy takes what comes as a tuple for one argument.
    bounded, mirrored = _weigh(*given, *found)  # type: ignore[call-arg]
    return Posterior(
        star, probability[0], probability[1], rivals, likely, hypothesis, bounded, mirrored
    )


def identify_verified(sighting: Sighting) -> Identification:
    """Identify the stars of one tracker by the posterior of hypotheses."""
    star_of = sighting.zone.star
    found, votes = posterior_of(sighting), identify_by_votes(sighting)
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
        bounded=found.bounded,
        hypothesis=_named(found.hypothesis, star_of),
        mirrored=found.mirrored,
    )


def _named(rows: Integers, star_of: npt.NDArray[np.int32]) -> Integers:
    """The stars of zone rows (n,), -1 where there is no row; a zone may have no stars."""
    star = np.full(len(rows), -1)
    star[rows >= 0] = star_of[rows[rows >= 0]]
    return star


def scene_of(sighting: Sighting) -> tuple[Seen, Stars, Pairs]:
    """The sighting as the kernels take it."""
    return _scene(*_scene_arguments(sighting))  # type: ignore[no-any-return]


def _scene_arguments(sighting: Sighting) -> tuple[Any, ...]:
    zone, aim, pairs = sighting.zone, sighting.aim, sighting.zone.pairs
    rotation_known = sighting.known_axis is None
    return (
        sighting.direction,
        sighting.magnitude_mag,
        sighting.sigma_rad,
        sighting.velocity_c,
        PRIOR_ROTATION if rotation_known else PRIOR_DIRECTION,
        aim.axis if rotation_known else sighting.known_axis,
        zone.direction,
        zone.magnitude_mag,
        zone.grid.start,
        zone.grid.rows,
        zone.grid.direction,
        zone.voxels,
        aim.axis,
        math.radians(aim.least_deg),
        math.radians(aim.most_deg),
        pairs.separation_rad,
        pairs.rows,
        pairs.bin_start,
        pairs.bins_per_rad,
        zone.polar_difference_rad,
        math.radians(separation_deg(zone.aim.axis, aim.axis)),
    )


@njit(cache=True, nogil=True)
def _scene(  # type: ignore[no-untyped-def]
    observed,
    observed_magnitude,
    sigma_rad,
    velocity,
    prior_kind,
    prior_axis,
    direction,
    magnitude,
    grid_start,
    grid_rows,
    grid_direction,
    voxels,
    axis,
    least,
    most,
    pair_separation,
    pair_rows,
    bin_start,
    bins_per_rad,
    polar_difference,
    off_axis,
):
    reference_sigma = sigma_rad.min()
    weight = np.empty(len(sigma_rad))
    for k in range(len(sigma_rad)):
        ratio = reference_sigma / sigma_rad[k]
        weight[k] = ratio * ratio
    seen = Seen(
        observed,
        observed_magnitude,
        sigma_rad,
        weight,
        reference_sigma,
        velocity,
        prior_kind,
        prior_axis,
    )
    stars = Stars(
        direction,
        magnitude,
        grid_start,
        grid_rows,
        grid_direction,
        voxels,
        axis,
        least,
        most,
        np.full(len(direction), -1.0),
        log_density(direction, axis, least, most),
    )
    pairs = Pairs(
        pair_separation,
        pair_rows[0],
        pair_rows[1],
        bin_start,
        bins_per_rad,
        polar_difference,
        off_axis,
    )
    return seen, stars, pairs


@njit(cache=True, nogil=True)
def _weigh(  # type: ignore[no-untyped-def]
    observed,
    observed_magnitude,
    sigma_rad,
    velocity,
    prior_kind,
    prior_axis,
    direction,
    magnitude,
    grid_start,
    grid_rows,
    grid_direction,
    voxels,
    axis,
    least,
    most,
    pair_separation,
    pair_rows,
    bin_start,
    bins_per_rad,
    polar_difference,
    off_axis,
    boresight,
    exhaustive,
    star,
    probability,  # (2, n) of the likeliest star, and of none
    rivals,
    likely,
    hypothesis,  # (n,) the zone stars of the heaviest hypothesis
):
    """Search and marginals of a scene; whether the search was bounded, and the field mirrored."""
    n = len(observed)
    star[:], probability[0], probability[1] = -1, 0.0, 1.0
    rivals[:], likely[:], hypothesis[:] = -1, 0.0, -1
    if n < 2 or len(direction) < 2:
        return False, False
    seen, stars, pairs = _scene(
        observed,
        observed_magnitude,
        sigma_rad,
        velocity,
        prior_kind,
        prior_axis,
        direction,
        magnitude,
        grid_start,
        grid_rows,
        grid_direction,
        voxels,
        axis,
        least,
        most,
        pair_separation,
        pair_rows,
        bin_start,
        bins_per_rad,
        polar_difference,
        off_axis,
    )
    ledger, log_weight = np.empty((MAX_HYPOTHESES, n), np.int32), np.empty(MAX_HYPOTHESES)
    scratch = scratch_for(n)
    count, rest, _, bounded = search_in(scratch, seen, stars, pairs, exhaustive, ledger, log_weight)
    hypothesis[:] = scratch.leader
    heaviest = scratch.range_kept[1]
    mirrored = False
    if may_be_mirrored(seen, hypothesis, heaviest):
        image = np.empty((n, 3))
        reflect(observed, boresight, image)
        gained = gained_by_mirror(seen, in_a_mirror(seen, image), stars, pairs, scratch)
        mirrored = gained > 0.0
        rest = log_sum(rest, heaviest + gained + LOG_MIRRORED)
    marginals(ledger, log_weight, count, rest, star, probability[0], probability[1], rivals, likely)
    return bounded, mirrored
