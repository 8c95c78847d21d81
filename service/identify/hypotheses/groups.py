"""Two groups of stars with an attitude each, and the share of probability of either group.

Reflections, or an unreported slew within a batch, leave two groups of stars, neither explained by
chance. The groups are identified separately, and the probability is divided between them.
"""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from msgspec import structs

from service.compiled.jit import njit
from service.identify.hypotheses import evidence
from service.identify.hypotheses.fitting import weigh
from service.identify.hypotheses.ledger import LEAST_GROUP, RIVAL_PROBABILITY
from service.identify.hypotheses.scene import (
    ObservedStars,
    ZoneStars,
    log_density,
    scratch_for,
    with_magnitude,
)
from service.identify.hypotheses.verified import UNIQUE_PROBABILITY
from service.identify.identification import Identification, Integers, Outcome
from service.identify.sighting import SightingColumns, sighted_at
from service.observations.calibrate import CorrectedObservations
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.zones import Zone
from service.vectors import read_only

Mask = npt.NDArray[np.bool_]

NOISE_SIGMAS = 6.0
"""Difference of two groups' log weights, in units of sqrt(3 n), that is taken for noise.

Half the difference of two chi-squares of 3 n degrees of freedom, from n places and magnitudes each,
has a standard deviation of sqrt(3 n). With four sigmas 0.11 % of the names of probability 0.999
were wrong: sometimes a star of one group also fits the attitude of the other.
"""

_UNMATCHED, _UNIQUE, _AMBIGUOUS = (int(outcome) for outcome in Outcome)
_NO_ROWS, _NO_VOXELS = np.empty(0, np.int32), np.empty((0, 0), np.uint8)
"""Arrays without rows, in place of the zone's search grid, for weighing known identities."""


def may_be_a_group(masks: Sequence[Mask]) -> bool:
    """True if any tracker has enough of the masked stars for an attitude."""
    return any(int(mask.sum()) >= LEAST_GROUP for mask in masks)


def part_of(
    corrected: Sequence[CorrectedObservations], masks: Sequence[Mask]
) -> tuple[CorrectedObservations, ...]:
    """The observations of each tracker restricted to the stars in its mask (n,)."""
    return tuple(
        structs.replace(
            each,
            direction_body=read_only(each.direction_body[mask]),
            magnitude_mag=read_only(each.magnitude_mag[mask]),
            sigma_arcsec=read_only(each.sigma_arcsec[mask]),
            sigma_rad=each.sigma_rad[mask],
            outside_field_of_view=each.outside_field_of_view[mask],
        )
        for each, mask in zip(corrected, masks, strict=True)
    )


def of_all(part: Identification, mask: Mask) -> Identification:
    """The identification of some of a tracker's stars, extended to all, the others unmatched."""
    n = len(mask)
    places = np.flatnonzero(mask).tolist()

    def spread(values: npt.NDArray[np.generic], missing: float) -> npt.NDArray[np.generic]:
        of_every = np.full(n, missing, values.dtype)
        of_every[mask] = values
        return of_every

    rivals: list[tuple[int, ...]] = [()] * n
    likely: list[tuple[float, ...]] = [()] * n
    for place, names in zip(places, part.rivals, strict=True):
        rivals[place] = names
    for place, chances in zip(places, part.rival_probability or ((),) * len(places), strict=True):
        likely[place] = chances
    return structs.replace(
        part,
        outcome=spread(part.outcome, _UNMATCHED),
        star=spread(part.star, -1),
        votes=spread(part.votes, 0),
        runner_up=spread(part.runner_up, 0),
        rivals=tuple(rivals),
        probability=spread(part.probability, 1.0),
        rival_probability=tuple(likely),
        hypothesis=spread(part.star if part.hypothesis is None else part.hypothesis, -1),
    )


def shared(found: Identification, rival: Identification, share: float) -> Identification:
    """An identification whose probabilities are reduced to its attitude's share.

    A name keeps its probability times the share; where the rival identification names the star too,
    its name gets the rest. A name below the probability of `unique` becomes the first of the star's
    rivals.
    """
    n = len(found.star)
    outcome, star, probability = found.outcome.copy(), found.star.copy(), found.probability.copy()
    rivals, likely = list(found.rivals), list(found.rival_probability or ((),) * n)
    for k in range(n):
        chances: dict[int, float] = {}
        if found.star[k] >= 0:
            chances[int(found.star[k])] = share * float(found.probability[k])
        for row, chance in zip(found.rivals[k], likely[k], strict=True):
            chances[row] = chances.get(row, 0.0) + share * chance
        if rival.star[k] >= 0:
            row = int(rival.star[k])
            other = (1.0 - share) * float(rival.probability[k])
            chances[row] = chances.get(row, 0.0) + other
        if not chances:
            continue
        best = max(chances, key=lambda row: chances[row])
        if chances[best] >= UNIQUE_PROBABILITY:
            outcome[k], star[k], probability[k] = _UNIQUE, best, chances[best]
            rivals[k], likely[k] = (), ()
            continue
        none = max(0.0, 1.0 - sum(chances.values()))
        ranked = sorted(chances.items(), key=lambda each: -each[1])
        ranked = [each for each in ranked if each[1] >= RIVAL_PROBABILITY]
        rivals[k] = tuple(row for row, _ in ranked)
        likely[k] = tuple(chance for _, chance in ranked)
        star[k] = -1
        outcome[k] = _UNMATCHED if none > chances[best] else _AMBIGUOUS
        probability[k] = max(none, chances[best])
    return structs.replace(
        found,
        outcome=outcome,
        star=star,
        rivals=tuple(rivals),
        probability=probability,
        rival_probability=tuple(likely),
    )


def first_share(log_weight: float, other_log_weight: float, stars: int) -> float:
    """Probability share of the first of two groups of stars, from both log weights.

    The noise of the groups' chi-squares does not show which one is real, so that part of the
    difference of weights is ignored.
    """
    difference = log_weight - other_log_weight
    noise = NOISE_SIGMAS * math.sqrt(3.0 * stars)
    significant = math.copysign(max(abs(difference) - noise, 0.0), difference)
    return 1.0 / (1.0 + math.exp(min(-significant, 700.0)))


def log_weight_of_group(
    seen: SightingColumns, s: int, zone: Zone, star: Integers, run_catalog: RunCatalog
) -> float:
    """The log posterior weight of a sighting's stars, identified with catalog rows `star` (n,).

    The measure is that of hypotheses (see `evidence`); stars with -1 are clutter.
    """
    if not len(star):
        return 0.0
    return float(
        _log_weight_of(
            sighted_at(seen, s),
            read_only(run_catalog.direction[star]),
            read_only(run_catalog.magnitude_mag[star]),
            star,
            log_density(zone.direction, seen.axis[s], seen.least[s], seen.most[s]),
        )
    )


@njit(nogil=True, error_model="numpy")
def _log_weight_of(sighted, star_direction, star_magnitude, star, density):  # type: ignore[no-untyped-def]
    """The log posterior weight of observed stars with given catalog directions and magnitudes.

    `star` (n,) holds their rows, -1 for clutter; `density` is the logarithm of the zone's stars per
    steradian.
    """
    sigma_rad = sighted.sigma_rad
    n = len(sigma_rad)
    reference_sigma = sigma_rad.min()
    weight = np.empty(n)
    for k in range(n):
        weight[k] = (reference_sigma / sigma_rad[k]) ** 2
    observed = ObservedStars(
        direction=sighted.direction,
        magnitude=sighted.magnitude,
        sigma_rad=sigma_rad,
        weight=weight,
        reference_sigma=reference_sigma,
        velocity=sighted.velocity,
        prior_kind=sighted.prior_kind,
        prior_axis=sighted.prior_axis,
    )
    scratch = scratch_for(n)
    matched = 0
    for k in range(n):
        scratch.match[k] = k if star[k] >= 0 else -1
        matched += star[k] >= 0
    if matched < 2:
        return evidence.log_null(n, with_magnitude(observed))
    # Only positions and magnitudes are used: the star grid and the bounds are empty.
    stars = ZoneStars(
        direction=star_direction,
        magnitude=star_magnitude,
        grid_start=_NO_ROWS,
        grid_rows=_NO_ROWS,
        grid_direction=star_direction,
        voxels=_NO_VOXELS,
        axis=sighted.prior_axis,
        least=0.0,
        most=math.pi,
        polar=np.empty(0),
        log_density=density,
    )
    return weigh(observed, stars, scratch.match, scratch)
