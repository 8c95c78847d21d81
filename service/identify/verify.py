"""The identifier `verified`: a probability for every star, from all that is known of all of them.

Hypotheses are searched for without the tests of steps 1 to 10 and weighed as a
posterior (`hypotheses`, `evidence`); a star is unique from a probability of
0.999.  STARID's votes are counted beside it and shown.
"""

import math
from dataclasses import replace

import numpy as np

from service.identify import hypotheses as search_for
from service.identify.evidence import PRIOR_DIRECTION, PRIOR_ROTATION
from service.identify.identification import Identification, Outcome
from service.identify.starid import MAX_RIVALS, Sighting, identify_by_votes

UNIQUE_PROBABILITY = 0.999


def identify_verified(sighting: Sighting) -> Identification:
    """Identify the stars of one tracker by the posterior of hypotheses."""
    zone, aim = sighting.zone, sighting.aim
    n = len(sighting.direction)
    star, probability, none = np.full(n, -1), np.zeros(n), np.ones(n)
    rivals = np.full((n, MAX_RIVALS), -1)
    bounded = False
    if n >= 2 and len(zone.star) >= 2:
        found = np.empty((search_for.MAX_HYPOTHESES, n), np.int32)
        log_weight = np.empty(search_for.MAX_HYPOTHESES)
        grid, pairs = zone.grid, zone.pairs
        count, rest, _, bounded = search_for.search(
            sighting.direction,
            sighting.magnitude_mag,
            sighting.sigma_rad,
            zone.direction,
            zone.magnitude_mag,
            pairs.separation_rad,
            pairs.brighter,
            pairs.dimmer,
            pairs.bin_start,
            pairs.bins_per_rad,
            grid.box,
            grid.offset,
            grid.start,
            grid.rows,
            aim.axis,
            math.radians(aim.least_deg),
            math.radians(aim.most_deg),
            sighting.velocity_c,
            PRIOR_ROTATION if sighting.known_axis is None else PRIOR_DIRECTION,
            aim.axis if sighting.known_axis is None else sighting.known_axis,
            False,
            found,
            log_weight,
        )
        search_for.marginals(found, log_weight, count, rest, star, probability, none, rivals)
    unique = probability >= UNIQUE_PROBABILITY
    unmatched = ~unique & (none >= probability)
    return replace(
        identify_by_votes(sighting),
        outcome=np.where(
            unique,
            int(Outcome.UNIQUE),
            np.where(unmatched, int(Outcome.UNMATCHED), int(Outcome.AMBIGUOUS)),
        ),
        star=np.where(unique, zone.star[star], -1),
        rivals=tuple(
            ()
            if unique[k] or unmatched[k]
            else tuple(zone.star[rivals[k][rivals[k] >= 0]].tolist())
            for k in range(n)
        ),
        probability=np.where(unmatched, none, probability),
        bounded=bounded,
    )
