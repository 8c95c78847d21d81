"""The identifier `verified`: a probability for every star, from all that is known of all of them.

Hypotheses are searched for without the tests of steps 1 to 10 and weighed as a
posterior (`search`, `evidence`); a star is unique from a probability of
0.999.  STARID's votes are counted beside it and shown.
"""

import math
from dataclasses import replace

import numpy as np

from service.identify.evidence import PRIOR_DIRECTION, PRIOR_ROTATION
from service.identify.hypotheses import MAX_HYPOTHESES, marginals
from service.identify.identification import Identification, Outcome
from service.identify.scene import Pairs, Seen, Stars
from service.identify.search import search
from service.identify.starid import MAX_RIVALS, Sighting, identify_by_votes

UNIQUE_PROBABILITY = 0.999


def identify_verified(sighting: Sighting) -> Identification:
    """Identify the stars of one tracker by the posterior of hypotheses."""
    zone = sighting.zone
    n = len(sighting.direction)
    star, probability, none = np.full(n, -1), np.zeros(n), np.ones(n)
    rivals = np.full((n, MAX_RIVALS), -1)
    bounded = False
    if n >= 2 and len(zone.star) >= 2:
        ledger = np.empty((MAX_HYPOTHESES, n), np.int32)
        log_weight = np.empty(MAX_HYPOTHESES)
        count, rest, _, bounded = search(*_scene(sighting), False, ledger, log_weight)
        marginals(ledger, log_weight, count, rest, star, probability, none, rivals)
    unique = probability >= UNIQUE_PROBABILITY
    unmatched = ~unique & (none >= probability)
    named = np.full(n, -1)
    named[unique] = zone.star[star[unique]]
    return replace(
        identify_by_votes(sighting),
        outcome=np.where(
            unique,
            int(Outcome.UNIQUE),
            np.where(unmatched, int(Outcome.UNMATCHED), int(Outcome.AMBIGUOUS)),
        ),
        star=named,
        rivals=tuple(
            ()
            if unique[k] or unmatched[k]
            else tuple(zone.star[rivals[k][rivals[k] >= 0]].tolist())
            for k in range(n)
        ),
        probability=np.where(unmatched, none, probability),
        bounded=bounded,
    )


def _scene(sighting: Sighting) -> tuple[Seen, Stars, Pairs]:
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
    stars = Stars(
        direction=zone.direction,
        magnitude=zone.magnitude_mag,
        box=zone.grid.box,
        offset=zone.grid.offset,
        start=zone.grid.start,
        rows=zone.grid.rows,
        axis=aim.axis,
        least=math.radians(aim.least_deg),
        most=math.radians(aim.most_deg),
        polar=np.full(len(zone.star), -1.0),
    )
    return (
        seen,
        stars,
        Pairs(
            pairs.separation_rad, pairs.brighter, pairs.dimmer, pairs.bin_start, pairs.bins_per_rad
        ),
    )
