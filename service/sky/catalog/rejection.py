"""Which stars of a run catalog are left out though they are bright enough, and why."""

import numpy as np
import numpy.typing as npt

from service.missions.mission import RunCatalogSettings
from service.sky.catalog.blending import pairs_within
from service.sky.catalog.star_catalog import Catalog
from service.vectors import ARCSEC_PER_RADIAN, Vector


def rejections(
    catalog: Catalog,
    settings: RunCatalogSettings,
    direction: Vector,
    magnitude: Vector,
    leads: npt.NDArray[np.bool_],
    judged: npt.NDArray[np.bool_],
) -> dict[int, str]:
    """Row and reason of every star of `judged` that is rejected; a merged one by its leader.

    What is not known of a star does not reject it.  Of several reasons the
    first is given.
    """
    reasons: dict[int, str] = {}
    amplitude, sigma = settings.reject_variable_amplitude_mag, settings.reject_position_sigma_arcsec
    if amplitude is not None:
        for star in np.flatnonzero(judged & (catalog.variability_mag > amplitude)):
            reasons[int(star)] = f"variable by {catalog.variability_mag[star]:.2f} mag"
    if sigma is not None:
        for star in np.flatnonzero(judged & (catalog.position_sigma_arcsec > sigma)):
            shown = f"uncertain position: {catalog.position_sigma_arcsec[star]:.2f} arcsec"
            reasons.setdefault(int(star), shown)
    distance = _nearest_disturbing(catalog, settings, direction, magnitude, leads)
    for star in np.flatnonzero(judged & np.isfinite(distance)):
        reasons.setdefault(int(star), f"neighbour at {distance[star]:.1f} arcsec")
    return reasons


def _nearest_disturbing(
    catalog: Catalog,
    settings: RunCatalogSettings,
    direction: Vector,
    magnitude: Vector,
    leads: npt.NDArray[np.bool_],
) -> Vector:
    """Distance in arcsec of each star's nearest disturbing neighbour; infinite where there is none.

    Neighbours are the other stars of the catalog after merging and, for those
    fainter than the catalog, the two of which the catalog holds the distance;
    one within the merging distance is part of the star.
    """
    within = settings.reject_neighbour_within_arcsec
    fainter = settings.reject_neighbour_fainter_by_mag
    distance = np.full(len(catalog), np.inf)
    if within == 0.0:
        return distance
    rows = np.flatnonzero(leads)
    for one, other in rows[pairs_within(direction[rows], within)]:
        apart = float(np.linalg.norm(direction[one] - direction[other])) * ARCSEC_PER_RADIAN
        for star, neighbour in ((one, other), (other, one)):
            if magnitude[neighbour] - magnitude[star] <= fainter:
                distance[star] = min(distance[star], apart)
    for apart_of_all, difference in (
        (catalog.neighbour_arcsec, catalog.neighbour_fainter_by_mag),
        (catalog.rival_arcsec, catalog.rival_fainter_by_mag),
    ):
        counts = (apart_of_all > settings.merge_within_arcsec) & (apart_of_all <= within)
        counts &= difference <= fainter
        distance[counts] = np.minimum(distance[counts], apart_of_all[counts])
    return distance
