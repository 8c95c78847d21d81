"""The colours of a star's light, and what they make of its correlation in time.

Frequencies are angular, rad/s; wavelengths metres; delays seconds.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault
from service.imaging.centroids.window import Array

LIGHT_SPEED_M_PER_S = 299_792_458.0
PLANCK_OVER_BOLTZMANN_K_S = 7.638_232_577e-12
"""h-bar / k, for a thermal spectrum by angular frequency."""


@dataclass(frozen=True)
class Spectrum:
    """Power at some frequencies: a one-sided spectral density times the width that each stands for.

    `omega_rad_per_s` rises; `power` is not negative.  One frequency is monochromatic light.
    """

    omega_rad_per_s: Array
    power: Array

    def __post_init__(self) -> None:
        if self.omega_rad_per_s.shape != self.power.shape or self.power.ndim != 1:
            shapes = f"{self.omega_rad_per_s.shape} and {self.power.shape}"
            raise BadInput(Fault("spectrum", "must be two lists of one length", shapes))
        rising = bool(np.all(np.diff(self.omega_rad_per_s) > 0.0))
        if not (rising and self.omega_rad_per_s[0] > 0.0):
            raise BadInput(Fault("spectrum.omega_rad_per_s", "must rise from above zero"))
        if not (np.all(self.power >= 0.0) and self.power.sum() > 0.0):
            raise BadInput(Fault("spectrum.power", "must not be negative, nor zero everywhere"))

    @property
    def wavelength_m(self) -> Array:
        """Wavelength of each colour."""
        return np.asarray(2.0 * math.pi * LIGHT_SPEED_M_PER_S / self.omega_rad_per_s)

    @property
    def mean_wavelength_m(self) -> float:
        """By power."""
        return float(self.wavelength_m @ self.power / self.power.sum())

    def correlation(self, delay_s: npt.ArrayLike) -> npt.NDArray[np.complex128]:
        """e_hh(tau) = (1/2 pi) integral of S e^(j omega tau) d omega (2.22), complex."""
        delay = np.asarray(delay_s, dtype=np.float64)
        total = np.zeros(delay.shape, dtype=np.complex128)
        for omega, power in zip(self.omega_rad_per_s, self.power, strict=True):
            total += power * np.exp(1j * omega * delay)
        return total / (2.0 * math.pi)


def monochromatic(wavelength_m: float) -> Spectrum:
    """Light of one colour."""
    omega = 2.0 * math.pi * LIGHT_SPEED_M_PER_S / wavelength_m
    return Spectrum(np.array([omega]), np.array([1.0]))


def gaussian_line(
    wavelength_m: float, relative_width: float, colours: int = 201, reach: float = 6.0
) -> Spectrum:
    """exp(-(omega - omega0)² / 2 sigma²) with sigma = relative_width omega0 (report, 2.5).

    Taken at `colours` places out to `reach` sigma, as far as frequencies are above zero.
    """
    omega0 = 2.0 * math.pi * LIGHT_SPEED_M_PER_S / wavelength_m
    sigma = relative_width * omega0
    low, high = max(omega0 - reach * sigma, 1e-3 * omega0), omega0 + reach * sigma
    omega = np.linspace(low, high, colours)
    density = np.exp(-0.5 * ((omega - omega0) / sigma) ** 2)
    return Spectrum(omega, density * (omega[1] - omega[0]))


def thermal(
    temperature_k: float, shortest_m: float, longest_m: float, colours: int = 41
) -> Spectrum:
    """A black body through a band with sharp ends."""
    ends = 2.0 * math.pi * LIGHT_SPEED_M_PER_S / np.array([longest_m, shortest_m])
    width = (ends[1] - ends[0]) / colours
    omega = ends[0] + width * (np.arange(colours) + 0.5)
    heat = PLANCK_OVER_BOLTZMANN_K_S * omega / temperature_k
    density = omega**3 / np.expm1(heat)
    return Spectrum(omega, density / density.sum())
