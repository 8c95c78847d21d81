"""The report's example (2.5): a Gaussian line through a circular aperture.

The report leaves it as an integral without a closed form; here it is integrated.
"""

import math

import numpy as np
import numpy.typing as npt
from scipy.special import j1, jn_zeros

from service.imaging.centroids.window import Array
from service.imaging.optics.spectrum import LIGHT_SPEED_M_PER_S, gaussian_line


def line_correlation(
    delay_s: npt.ArrayLike, omega0_rad_per_s: float, sigma_rad_per_s: float
) -> npt.NDArray[np.complex128]:
    """e_hh of exp(-(omega - omega0)² / 2 sigma²): a Gaussian times e^(j omega0 tau).

    One-sided; of the spectrum that has both signs of omega the cosine is left.
    """
    tau = np.asarray(delay_s, dtype=np.float64)
    height = sigma_rad_per_s / math.sqrt(2.0 * math.pi)
    fall = np.exp(-0.5 * (sigma_rad_per_s * tau) ** 2)
    return np.asarray(height * fall * np.exp(1j * omega0_rad_per_s * tau))


def disc_autocorrelation(distance_m: npt.ArrayLike, radius_m: float) -> Array:
    """Phi of a circle: the area that two of them share at a distance D, zero from 2 a on."""
    half = np.minimum(np.asarray(distance_m, dtype=np.float64) / (2.0 * radius_m), 1.0)
    return np.asarray(2.0 * radius_m**2 * (np.arccos(half) - half * np.sqrt(1.0 - half**2)))


def airy(angle_rad: npt.ArrayLike, radius_m: float, wavelength_m: npt.ArrayLike) -> Array:
    """[2 J1(q) / q]², q = omega a r / (c f): one colour's image, 1 at its middle."""
    q = 2.0 * math.pi * radius_m * np.asarray(angle_rad) / np.asarray(wavelength_m)
    at_zero = q == 0.0
    safe = np.where(at_zero, 1.0, q)
    return np.asarray(np.where(at_zero, 1.0, (2.0 * j1(safe) / safe) ** 2))


def disc_image(
    angle_rad: npt.ArrayLike,
    radius_m: float,
    wavelength_m: float,
    relative_width: float,
    report_weight: bool = False,
    colours: int = 401,
) -> Array:
    """The image along a radius, per unit of power; `report_weight` leaves out 1/(lambda f)²."""
    line = gaussian_line(wavelength_m, relative_width, colours)
    power = line.power / line.power.sum()
    angle = np.asarray(angle_rad, dtype=np.float64)[..., None]
    area = math.pi * radius_m**2
    each = area**2 * airy(angle, radius_m, line.wavelength_m)
    weight = power if report_weight else power / line.wavelength_m**2
    return np.asarray(each @ weight)


def first_null_rad(radius_m: float, wavelength_m: float) -> float:
    """The first dark ring of one colour, 1.22 lambda / D."""
    return float(jn_zeros(1, 1)[0]) * wavelength_m / (2.0 * math.pi * radius_m)


def null_fill(relative_width: float, report_weight: bool = False) -> float:
    """Light at the middle colour's first dark ring, over that at the centre.

    It is the same for every aperture and colour.
    """
    radius, wavelength = 1.0, 1e-6
    places = np.array([0.0, first_null_rad(radius, wavelength)])
    centre, ring = disc_image(places, radius, wavelength, relative_width, report_weight)
    return float(ring / centre)


def omega_of(wavelength_m: float) -> float:
    """Angular frequency of a wavelength."""
    return 2.0 * math.pi * LIGHT_SPEED_M_PER_S / wavelength_m
