"""Where stars stand after some years of proper motion."""

import numpy as np
import numpy.typing as npt

from service.vectors import ARCSEC_PER_RADIAN, Vector, from_ra_dec, unit


def moved(
    ra_deg: npt.ArrayLike,
    dec_deg: npt.ArrayLike,
    pm_ra_mas_per_year: npt.ArrayLike,
    pm_dec_mas_per_year: npt.ArrayLike,
    years: float,
) -> Vector:
    """Unit vectors (N, 3) of stars after some Julian years, seen from the barycentre.

    A star goes along the straight line through space that its proper motion starts,
    which also holds beside the pole; radial velocities are not known and taken as zero.
    """
    shift = motion_in(ra_deg, dec_deg, pm_ra_mas_per_year, pm_dec_mas_per_year, years)
    return unit(from_ra_dec(ra_deg, dec_deg) + shift)


def motion_in(
    ra_deg: npt.ArrayLike,
    dec_deg: npt.ArrayLike,
    pm_ra_mas_per_year: npt.ArrayLike,
    pm_dec_mas_per_year: npt.ArrayLike,
    years: float,
) -> Vector:
    """The motion (N, 3) of stars' unit vectors in some Julian years, in radians.

    Motion in right ascension is times cos(declination).
    """
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    sin_ra, cos_ra, sin_dec, cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
    east = years / (1000.0 * ARCSEC_PER_RADIAN) * np.asarray(pm_ra_mas_per_year)
    north = years / (1000.0 * ARCSEC_PER_RADIAN) * np.asarray(pm_dec_mas_per_year)
    return np.stack(
        [
            -sin_ra * east - sin_dec * cos_ra * north,
            cos_ra * east - sin_dec * sin_ra * north,
            cos_dec * north,
        ],
        axis=-1,
    )
