"""One sighting as columns of one, for identifiers and kernels that take many."""

from collections.abc import Callable
from typing import Any

import numpy as np

from service.identify.hypotheses.ledger import StarPosterior
from service.identify.hypotheses.scene import ObservedStars, ZonePairs, ZoneStars, scene_in
from service.identify.identification import MAX_RIVALS, Identification, room_for_identities
from service.identify.sighting import (
    PRIOR_DIRECTION,
    PRIOR_ROTATION,
    RegionBounds,
    SightedArrays,
    Sighting,
    SightingColumns,
    bounds_at,
    room_for_sightings,
    sighted_at,
)
from service.sky.zones import ZoneArrays


def columns_of(sighting: Sighting) -> SightingColumns:
    """A sighting as the only row of its columns."""
    n, axis = len(sighting.direction), sighting.known_axis
    seen = room_for_sightings(
        np.array((0, n)), np.array(sighting.sigma_rad), np.array(sighting.magnitude_mag)
    )
    seen.direction[:] = sighting.direction
    seen.boresight[0], seen.velocity[0] = sighting.boresight, sighting.velocity_c
    seen.prior_kind[0] = PRIOR_ROTATION if axis is None else PRIOR_DIRECTION
    seen.prior_axis[0] = sighting.region.axis if axis is None else axis
    seen.left[0] = sighting.budget.left
    seen.set_region(0, sighting.region)
    seen.set_zone(0, sighting.region, sighting.zone)
    return seen


def identified(
    identify: Callable[..., object], sighting: Sighting, *, weighs: bool, **options: Any
) -> Identification:
    """What an identifier by columns finds of one sighting, which spends of its budget."""
    n, seen = len(sighting.direction), columns_of(sighting)
    found = room_for_identities(1, n)
    identify(np.zeros(1, np.int64), seen, sighting.zone, sighting.rules, found, **options)
    sighting.budget.spend(sighting.budget.left - int(seen.left[0]))
    return found.of_sighting(0, 0, n, weighs)


def arrays_of(sighting: Sighting) -> tuple[SightedArrays, ZoneArrays, RegionBounds]:
    """A sighting as the kernels of one sighting take it."""
    seen = columns_of(sighting)
    return sighted_at(seen, 0), sighting.zone.arrays, bounds_at(seen, 0)


def scene_of(sighting: Sighting) -> tuple[ObservedStars, ZoneStars, ZonePairs]:
    """A sighting as the search for hypotheses takes it."""
    scene = scene_in(*arrays_of(sighting))
    return scene  # type: ignore[no-any-return]


def posterior_for(n: int) -> StarPosterior:
    """Room for the posterior of n stars."""
    return StarPosterior(
        star=np.empty(n, np.int64),
        probability=np.empty(n),
        none=np.empty(n),
        rivals=np.empty((n, MAX_RIVALS + 1), np.int64),
        rival_probability=np.empty((n, MAX_RIVALS + 1)),
        hypothesis=np.empty(n, np.int64),
    )
