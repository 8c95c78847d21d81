"""The identifier `starid`: pairs of stars vote, a unique maximum identifies.

A tie is ambiguous, no votes is unmatched, one vote is enough (Fink & Shoup
1994; the paper counts unmatched stars among its ambiguous ones).
"""

import math
from dataclasses import dataclass

import numpy as np

from service.identify.identification import Identification, Outcome
from service.identify.pair_tests import cast_votes, count_votes
from service.missions.mission import Tests, Tolerances
from service.sky.zones import Aim, Zone
from service.vectors import Vector

MAX_RIVALS = 20


@dataclass(frozen=True)
class Sighting:
    """What an identifier is given: one tracker's stars and where to look for them.

    `direction` (n, 3) is inertial through the presumed attitude; magnitudes may
    be NaN; sigma is one standard deviation per tangent axis.  `zone` holds at
    least the stars within `aim`.  Of the presumed attitude the whole rotation
    is known, or only how it points `known_axis` (inertial).  `velocity_c` of the
    observer is zero where aberration is not to be corrected.
    """

    direction: Vector
    magnitude_mag: Vector
    sigma_rad: Vector
    known_axis: Vector | None
    velocity_c: Vector
    aim: Aim
    zone: Zone
    tolerances: Tolerances
    tests: Tests


def identify_by_votes(sighting: Sighting) -> Identification:
    """Identify the stars of one tracker by the votes of pairs, steps 1 to 10."""
    zone, aim, limits, tests = (
        sighting.zone,
        sighting.aim,
        sighting.tolerances,
        sighting.tests,
    )
    n = len(sighting.direction)
    votes = np.zeros((n, len(zone.star)), np.int32)
    cast_votes(
        sighting.direction,
        sighting.magnitude_mag,
        zone.direction,
        zone.magnitude_mag,
        zone.pairs.separation_rad,
        zone.pairs.brighter,
        zone.pairs.dimmer,
        zone.pairs.bin_start,
        zone.pairs.bins_per_rad,
        aim.axis,
        math.radians(aim.least_deg),
        math.radians(aim.most_deg),
        math.radians(limits.separation_deg),
        limits.magnitude_mag,
        limits.magnitude_order_mag,
        math.radians(limits.cross_product_deg),
        math.radians(limits.pole_difference_deg),
        math.radians(limits.pole_angle_deg),
        tests.magnitude,
        tests.cross_product,
        tests.pole,
        votes,
    )
    counted = np.empty((4, n), np.int64)
    winner, highest, second, tied = counted
    count_votes(votes, winner, highest, second, tied)
    outcome = np.where(tied > 1, int(Outcome.AMBIGUOUS), tied)
    star = np.full(n, -1)
    unique = tied == 1
    star[unique] = zone.star[winner[unique]]
    return Identification(
        outcome=outcome,
        star=star,
        votes=highest,
        runner_up=second,
        rivals=tuple(
            tuple(zone.star[np.flatnonzero(votes[i] == highest[i])[:MAX_RIVALS]].tolist())
            if tied[i] > 1
            else ()
            for i in range(n)
        ),
        probability=np.full(n, np.nan),
    )
