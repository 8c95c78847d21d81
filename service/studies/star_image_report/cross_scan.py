"""Laws of the cross-scan (report, 7.2 to 7.5 and 7.7), in the units of the image plane.

`displacement` is where the star stands, plus the first moment over the sum.  The report
writes the image as Phi(u + a), whose star is at -a, and drops that minus in 7.4 to 7.6
and 7.17 to 7.22.  What the telescope must be moved by is minus the displacement.
"""

import numpy as np

from service.imaging.centroids.window import Array
from service.observations.scans.profile import ProfileMoment, moment


def nyquist_spacing(
    shortest_wavelength_m: float, focal_length_m: float, diameter_m: float
) -> float:
    """T = pi / B = lambda f / (2 D): the widest step at which samples hold all of an image (m)."""
    return shortest_wavelength_m * focal_length_m / (2.0 * diameter_m)


def variance_sampled(spacing: float, noise_sigma: float, reach: int, light_sum: float) -> float:
    """T² sigma² N (N + 1)(2N + 1) / [3 (sum Phi)²] (7.36; one printing has N² + 1 in it).

    For a star in the middle of the scan and white noise.
    """
    n = reach
    return spacing**2 * noise_sigma**2 * n * (n + 1) * (2 * n + 1) / (3.0 * light_sum**2)


def variance_of_long_scan(
    spacing: float, noise_sigma: float, half_length: float, light_integral: float
) -> float:
    """(pi / B) 2 sigma² V³ / [3 (integral of Phi)²] (7.40): 7.36 for N far above 1."""
    return spacing * 2.0 * noise_sigma**2 * half_length**3 / (3.0 * light_integral**2)


def variance_in_full(samples: Array, spacing: float, noise_sigma: float) -> ProfileMoment:
    """sigma² sum (v - d)² / (sum Phi)²: 7.36 and (2N + 1) d² sigma² / (sum Phi)² for a star off it.

    In steps of the scan; `variance` times spacing² is the law.
    """
    return moment(samples, np.full(samples.shape, noise_sigma**2))


def truncated(displacement: float, half_length: float, end_light: float, light: float) -> float:
    """What a scan from -V to V finds: d [1 - 2 V <Phi(V)> / E], with <Phi(V)> the mean of its ends.

    `light` is E, the integral along the line.
    """
    return displacement * (1.0 - 2.0 * half_length * end_light / light)


def with_background(
    displacement: float, light_sum: float, samples: int, background: float
) -> float:
    """What a scan finds when a level is left in: d E / (E + (2N + 1) b0)."""
    return displacement * light_sum / (light_sum + samples * background)
