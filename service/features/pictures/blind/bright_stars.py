"""The bright stars that a picture from any lens may show, moved to a year's epoch."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from service.sky.catalog.run_catalog import J2000_YEAR
from service.sky.catalog.star_catalog import Catalog, moved
from service.vectors import Vector, read_only

FAINTEST_MAG = 9.0
MERGED_ARCSEC = 40.0
"""Distance in arcsec within which most pictures show two stars as one: the fainter is dropped."""


@dataclass(frozen=True, eq=False)
class BrightStars:
    """Directions (n, 3) of bright stars, ICRS, brightest first, with V and catalog row."""

    catalog: Catalog
    year: float
    direction: Vector
    magnitude_mag: Vector
    row: np.ndarray

    @property
    def nbytes(self) -> int:
        """The size of the list of stars in memory, in bytes."""
        return int(self.direction.nbytes + self.magnitude_mag.nbytes + self.row.nbytes)

    @cached_property
    def star_id(self) -> tuple[str, ...]:
        """The identifiers of all bright stars, brightest first."""
        return tuple(self.catalog.star_ids(self.row))


def bright_stars(catalog: Catalog, year: float) -> BrightStars:
    """The bright stars of a catalog in a Julian year, without the fainter stars of close pairs."""
    row = np.flatnonzero(catalog.magnitude_v_mag <= FAINTEST_MAG)
    direction = moved(
        catalog.ra_deg[row],
        catalog.dec_deg[row],
        catalog.pm_ra_mas_per_year[row],
        catalog.pm_dec_mas_per_year[row],
        year - J2000_YEAR,
    )
    reach = np.radians(MERGED_ARCSEC / 3600.0)
    close = cKDTree(direction).query_pairs(reach, output_type="ndarray")
    kept = np.ones(len(row), dtype=bool)
    # Rows are in order of brightness: the later star of a pair is the fainter one.
    kept[close.max(axis=1)] = False
    return BrightStars(
        catalog,
        year,
        read_only(direction[kept]),
        read_only(catalog.magnitude_v_mag[row[kept]]),
        read_only(row[kept]),
    )
