"""Stars that a tracker cannot separate: which are seen as one, how bright and where."""

import numpy as np
import numpy.typing as npt

from service.sky.geometry.pairs import build_pairs
from service.vectors import Vector

Rows = npt.NDArray[np.intp]


def merged_into(
    direction: Vector,
    magnitude: Vector,
    light_elsewhere: npt.NDArray[np.bool_],
    within_arcsec: float,
) -> Rows:
    """For every star (N,) the row of the star it is merged into: itself where it stands alone.

    From the brightest down, a star that is still alone takes in every fainter
    one that is still alone and not further than `within_arcsec` from it;
    chains end there.  Stars whose light is elsewhere come last, so that none
    of them leads a real one.
    """
    leader = np.arange(len(magnitude))
    if within_arcsec > 0.0:
        rank = np.empty_like(leader)
        rank[np.lexsort((leader, magnitude, light_elsewhere))] = leader
        pairs = pairs_within(direction, within_arcsec)
        swap = rank[pairs[:, 0]] > rank[pairs[:, 1]]
        pairs[swap] = pairs[swap, ::-1]
        for first, second in pairs[np.lexsort(rank[pairs].T[::-1])]:
            if leader[first] == first and leader[second] == second:
                leader[second] = first
    return leader


def pairs_within(direction: Vector, within_arcsec: float) -> Rows:
    """The pairs (P, 2) of rows not further apart than some arcsec."""
    pairs = build_pairs(direction, within_arcsec / 3600.0)
    return np.stack([pairs.brighter, pairs.dimmer], axis=1).astype(np.intp)


def combined(
    direction: Vector, magnitude: Vector, light_elsewhere: npt.NDArray[np.bool_], leader: Rows
) -> tuple[Vector, Vector]:
    """Directions (N, 3), not normalised, and magnitudes after merging.

    Further columns of `direction`, such as motions, are combined alike.  A leader has
    the light of its group and stands in the group's centre of light; every other star
    is as it was.
    """
    direction, magnitude = direction.copy(), magnitude.copy()
    lost = np.flatnonzero((leader != np.arange(len(leader))) & ~light_elsewhere)
    group, place = np.unique(leader[lost], return_inverse=True)
    light = 10.0 ** (-0.4 * magnitude)
    total = light[group] + np.bincount(place, light[lost], len(group))
    for axis in range(direction.shape[1]):
        moment = np.bincount(place, light[lost] * direction[lost, axis], len(group))
        direction[group, axis] = (light[group] * direction[group, axis] + moment) / total
    magnitude[group] = -2.5 * np.log10(total)
    return direction, magnitude
