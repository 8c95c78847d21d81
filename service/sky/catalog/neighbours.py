"""The nearest neighbour of every star, and the nearest one bright enough to be confused with it."""

import numpy as np

from service.vectors import ARCSEC_PER_RADIAN, Vector

REACH_ARCSEC = 3600.0
"""Largest distance in arcsec at which the nearest star counts as a neighbour."""
RIVAL_FAINTER_BY_MAG = 2.0
"""Largest number of magnitudes by which a rival neighbour may be fainter than the star."""

_BIN_MAG = 0.5


def nearest_neighbours(
    direction: Vector, magnitude: Vector, others: Vector, others_magnitude: Vector
) -> dict[str, Vector]:
    """Columns with the distance of each star's nearest neighbour and rival, and their magnitudes.

    Stars are unit vectors (N, 3) and magnitudes (N,); `others` (M, 3) are the possible neighbours,
    with the stars themselves as the first N rows. Returns four columns (N,) by their names in a
    catalog, NaN for no neighbour within a degree.
    """
    everyone = np.arange(len(others))
    columns = {}
    columns["neighbour_arcsec"], columns["neighbour_fainter_by_mag"] = _nearest(
        direction, magnitude, np.arange(len(direction)), others, others_magnitude, everyone
    )
    distance, fainter = np.full((2, len(direction)), np.nan)
    # The magnitude limit of a rival differs from star to star. In magnitude bins the search tree
    # has hardly more than the rivals, so that a few candidates per star suffice.
    bins = np.floor(magnitude / _BIN_MAG)
    for lower in np.unique(bins):
        stars = np.flatnonzero(bins == lower)
        limit = (lower + 1) * _BIN_MAG + RIVAL_FAINTER_BY_MAG
        distance[stars], fainter[stars] = _nearest(
            direction[stars],
            magnitude[stars],
            stars,
            others,
            others_magnitude,
            np.flatnonzero(others_magnitude <= limit),
            RIVAL_FAINTER_BY_MAG,
        )
    return columns | {"rival_arcsec": distance, "rival_fainter_by_mag": fainter}


def _nearest(
    direction: Vector,
    magnitude: Vector,
    own: np.typing.NDArray[np.intp],
    others: Vector,
    others_magnitude: Vector,
    sought: np.typing.NDArray[np.intp],
    fainter_by: float = np.inf,
) -> tuple[Vector, Vector]:
    """Distance in arcsec and magnitude difference of each star's nearest sought star, or NaN.

    `own` is each star's row in `others`, which is not its own neighbour.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(others[sought])
    reach = 2.0 * np.sin(REACH_ARCSEC / ARCSEC_PER_RADIAN / 2.0)
    distance, fainter = np.full((2, len(direction)), np.nan)
    waiting = np.arange(len(direction))
    count = 4
    while waiting.size:
        chord, place = tree.query(direction[waiting], k=count, distance_upper_bound=reach)
        in_reach = np.isfinite(chord)
        other = sought[np.where(in_reach, place, 0)]
        difference = others_magnitude[other] - magnitude[waiting, None]
        # Magnitudes are hundredths; a difference of 2.00 still counts when it rounds up.
        counts = in_reach & (other != own[waiting, None]) & (difference <= fainter_by + 1e-9)
        first = np.argmax(counts, axis=1)
        rows = np.arange(len(waiting))
        found = counts[rows, first]
        star = waiting[found]
        half = chord[rows, first][found] / 2.0
        distance[star] = 2.0 * np.arcsin(half) * ARCSEC_PER_RADIAN
        fainter[star] = difference[rows, first][found]
        # All candidates within reach were rejected, and there may be more of them.
        waiting = waiting[~found & in_reach[:, -1]]
        count *= 4
    return distance, fainter
