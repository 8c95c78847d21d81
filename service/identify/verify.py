"""The identifier `verified`: a probability for every star, from all that is known of all of them.

Hypotheses are searched for without the tests of steps 1 to 10 and weighed as a
posterior (`search`, `evidence`); a star is unique from a probability of
0.999.  STARID's votes are counted beside it and shown.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.identify.evidence import PRIOR_DIRECTION, PRIOR_ROTATION
from service.identify.hypotheses import marginals
from service.identify.identification import Identification, Integers, Outcome
from service.identify.scene import MAX_HYPOTHESES, Pairs, Seen, Stars, log_density
from service.identify.search import search
from service.identify.starid import MAX_RIVALS, Sighting, identify_by_votes
from service.vectors import Vector, separation_deg

UNIQUE_PROBABILITY = 0.999

_UNMATCHED, _UNIQUE, _AMBIGUOUS = (int(outcome) for outcome in Outcome)


@dataclass(frozen=True)
class Posterior:
    """What the hypotheses say of each of n stars.

    `star` is the likeliest zone row, -1 where there is none, and `probability`
    its share; `none` that of no star of the zone.  `rivals` (n, R) are zone rows
    by falling probability, `rival_probability` (n, R), -1 beyond the last.
    """

    star: Integers
    probability: Vector
    none: Vector
    rivals: Integers
    rival_probability: npt.NDArray[np.float64]
    bounded: bool


def posterior_of(sighting: Sighting, exhaustive: bool = False) -> Posterior:
    """Weigh the hypotheses of a sighting; `exhaustive`: go on after one that outweighs chance."""
    n = len(sighting.direction)
    star, probability, none = np.full(n, -1), np.zeros(n), np.ones(n)
    rivals, likely = np.full((n, MAX_RIVALS), -1), np.zeros((n, MAX_RIVALS))
    bounded = False
    if n >= 2 and len(sighting.zone.star) >= 2:
        ledger = np.empty((MAX_HYPOTHESES, n), np.int32)
        log_weight = np.empty(MAX_HYPOTHESES)
        count, rest, _, bounded = search(*scene_of(sighting), exhaustive, ledger, log_weight)
        marginals(ledger, log_weight, count, rest, star, probability, none, rivals, likely)
    return Posterior(star, probability, none, rivals, likely, bool(bounded))


def identify_verified(sighting: Sighting) -> Identification:
    """Identify the stars of one tracker by the posterior of hypotheses."""
    star_of = sighting.zone.star
    found, votes = posterior_of(sighting), identify_by_votes(sighting)
    n = len(found.star)
    outcome, star = np.empty(n, np.int64), np.full(n, -1)
    probability = np.empty(n)
    rivals: list[tuple[int, ...]] = [()] * n
    likely: list[tuple[float, ...]] = [()] * n
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
        bounded=found.bounded,
    )


def scene_of(sighting: Sighting) -> tuple[Seen, Stars, Pairs]:
    """The sighting as the kernels take it."""
    zone, aim, pairs = sighting.zone, sighting.aim, sighting.zone.pairs
    reference_sigma = float(sighting.sigma_rad.min())
    seen = Seen(
        observed=sighting.direction,
        magnitude=sighting.magnitude_mag,
        sigma_rad=sighting.sigma_rad,
        weight=(reference_sigma / sighting.sigma_rad) ** 2,
        reference_sigma=reference_sigma,
        velocity=sighting.velocity_c,
        prior_kind=PRIOR_ROTATION if sighting.known_axis is None else PRIOR_DIRECTION,
        prior_axis=aim.axis if sighting.known_axis is None else sighting.known_axis,
    )
    least, most = math.radians(aim.least_deg), math.radians(aim.most_deg)
    stars = Stars(
        direction=zone.direction,
        magnitude=zone.magnitude_mag,
        grid_start=zone.grid.start,
        grid_rows=zone.grid.rows,
        grid_direction=zone.grid.direction,
        voxels=zone.voxels,
        axis=aim.axis,
        least=least,
        most=most,
        polar=np.full(len(zone.star), -1.0),
        log_density=log_density(zone.direction, aim.axis, least, most),
    )
    return (
        seen,
        stars,
        Pairs(
            pairs.separation_rad,
            pairs.brighter,
            pairs.dimmer,
            pairs.bin_start,
            pairs.bins_per_rad,
            zone.polar_difference_rad,
            math.radians(separation_deg(zone.aim.axis, aim.axis)),
        ),
    )
