"""The sky as it is at one time and place, whatever a run catalog says of it.

The service identifies with a catalog that serves a whole step of years, as
seen from the solar system's barycentre.  The stars themselves have moved by
then, and shift with the year; samples are drawn from these, so that what the
service leaves out is in the errors that its answers are judged by.

Light is not bent by the Sun here (4 mas at right angles to it), and stars
that the run catalog rejects are never among those that a tracker picks.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from erfa import ufunc

from service.missions.mission import RunCatalogSettings
from service.sky.catalog.blending import Rows, merged_into
from service.sky.catalog.proper_motion import moved
from service.sky.catalog.run_catalog import J2000_YEAR, RunCatalog, instrument_magnitude
from service.sky.catalog.star_catalog import Catalog
from service.sky.ephemeris import KM_PER_AU
from service.times import Utc
from service.vectors import ARCSEC_PER_RADIAN, Vector, unit


@dataclass(frozen=True, eq=False)
class RealSky:
    """The stars of a run catalog with the real ones behind each: one, or those seen as a blend.

    A tracker cannot separate what the mission merges: it sees one star, in the
    components' centre of light and as bright as all of them.
    """

    catalog: Catalog
    run: RunCatalog
    component: Rows
    """Rows of the catalog, those of one star beside each other, in the run catalog's order."""
    first: Rows
    """Where each star's components begin; one entry more than there are stars."""
    light: Vector
    """Of each component, in the mission's instrument."""
    magnitude_mag: Vector
    """Of each star, all its components together."""

    def directions(self, star: Rows, time: Utc, position_km: Vector) -> Vector:
        """Unit vectors (n, 3), ICRS, from a spacecraft at a geocentric position to some stars.

        Proper motion to the very time, and parallax; aberration is not in them.
        """
        count = self.first[star + 1] - self.first[star]
        start = np.cumsum(count) - count
        place = np.arange(count.sum()) + np.repeat(self.first[star] - start, count)
        row, known = self.component[place], self.catalog
        geometric = moved(
            known.ra_deg[row],
            known.dec_deg[row],
            known.pm_ra_mas_per_year[row],
            known.pm_dec_mas_per_year[row],
            time.julian_year - J2000_YEAR,
        )
        # What is not known, or measured below zero, is as good as at infinity.
        parallax = np.fmax(known.parallax_mas[row], 0.0) / (1000.0 * ARCSEC_PER_RADIAN)
        seen = unit(geometric - parallax[:, None] * observer_position_au(time, position_km))
        return unit(np.add.reduceat(self.light[place, None] * seen, start) if len(star) else seen)


@lru_cache(maxsize=4)
def real_sky(catalog: Catalog, settings: RunCatalogSettings, run: RunCatalog) -> RealSky:
    """What stands behind the stars of a run catalog that was made with these settings."""
    alone = instrument_magnitude(catalog, settings.color_polynomial_mag)
    then = moved(
        catalog.ra_deg,
        catalog.dec_deg,
        catalog.pm_ra_mas_per_year,
        catalog.pm_dec_mas_per_year,
        run.epoch_year - J2000_YEAR,
    )
    leader = merged_into(then, alone, catalog.light_elsewhere, settings.merge_within_arcsec)
    star_of = np.full(len(catalog), -1)
    star_of[run.catalog_row] = np.arange(len(run))
    star = star_of[leader]
    itself = leader == np.arange(len(catalog))
    component = np.flatnonzero((star >= 0) & (itself | ~catalog.light_elsewhere))
    component = component[np.argsort(star[component], kind="stable")]
    first = np.searchsorted(star[component], np.arange(len(run) + 1))
    light = 10.0 ** (-0.4 * alone[component])
    magnitude = -2.5 * np.log10(np.add.reduceat(light, first[:-1]))
    return RealSky(catalog, run, component, first, light, magnitude)


def observer_position_au(time: Utc, position_km: Vector) -> Vector:
    """Position (3,) from the solar system's barycentre of a spacecraft at a geocentric position."""
    _, barycentric, _ = ufunc.epv00(*time.tt)
    return np.asarray(barycentric["p"] + position_km / KM_PER_AU)
