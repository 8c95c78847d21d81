"""Images of stars by Fourier optics: from an aperture and a spectrum to a point source's image.

This is the transfer functional of the report (part II): the Fourier transform of the aperture's
autocorrelation in space, combined with the light's autocorrelation in time (2.23). Directions
p = u / f and q = v / f are in radians, so that one result serves any focal length f, assumed the
same for all colours.

The report's 2.9 has no 1/(lambda f).  Without it the image of each colour holds
(lambda f)² times the open area, and red is weighted too high.  Here an image is
irradiance per direction: it holds the open area, whatever the colour.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault
from service.features.pictures.centroids.window import Array

# Apertures: open discs, wires, glass of any thickness. An aperture is a square grid of complex
# transmissions P = p e^(j alpha) (report, 2.5), centred between the middle cells; edges are
# weighted by the area they cover.

PupilField = npt.NDArray[np.complex128] | npt.NDArray[np.float64]


@dataclass(frozen=True)
class Pupil:
    """An aperture: complex transmission (n, n), rows along y, columns along x; cell size in m."""

    transmission: PupilField
    cell_m: float

    @property
    def open_area_m2(self) -> float:
        """The integral of |P|² over an aperture: the area in m² that transmits as much light."""
        return float(np.sum(np.abs(self.transmission) ** 2)) * self.cell_m**2

    @property
    def places_m(self) -> Array:
        """Middles of the aperture's cells along either axis, symmetric about zero, in metres."""
        return centres(self.transmission.shape[0], self.cell_m)

    def behind(self, transmission: PupilField) -> "Pupil":
        """An aperture combined with a second transmission mask."""
        return Pupil(self.transmission * transmission, self.cell_m)


def centres(number: int, cell_m: float) -> Array:
    """Middles of `number` cells in a row, symmetric about zero."""
    return np.asarray((np.arange(number) - (number - 1) / 2.0) * cell_m, dtype=np.float64)


def disc(number: int, cell_m: float, radius_m: float, obscuration: float = 0.0) -> Pupil:
    """A circular aperture on a grid of number x number cells, with an optional central obscuration.

    Raises `BadInput` where the circle is larger than the grid.
    """
    if radius_m > number * cell_m / 2.0 * (1.0 + 1e-9):
        raise BadInput(Fault("radius_m", "is larger than the grid of the pupil", str(radius_m)))
    place = centres(number, cell_m)
    radius = np.hypot(place[None, :], place[:, None])
    inside = np.clip((radius_m - radius) / cell_m + 0.5, 0.0, 1.0)
    if obscuration > 0.0:
        inside -= np.clip((obscuration * radius_m - radius) / cell_m + 0.5, 0.0, 1.0)
    return Pupil(inside, cell_m)


def behind_wires(pupil: Pupil, wires: Sequence[tuple[float, float, float]]) -> Pupil:
    """An aperture behind straight wires in any directions.

    Each wire is (direction along the wire, rad from x towards y; distance from the aperture's
    middle along the direction turned by a right angle, m; diameter, m).
    """
    x, y = pupil.places_m[None, :], pupil.places_m[:, None]
    found = pupil
    for direction, offset, diameter in wires:
        across = y * math.cos(direction) - x * math.sin(direction) - offset
        low = np.maximum(across - pupil.cell_m / 2.0, -diameter / 2.0)
        high = np.minimum(across + pupil.cell_m / 2.0, diameter / 2.0)
        found = found.behind(1.0 - np.maximum(high - low, 0.0) / pupil.cell_m)
    return found


def image_at(pupil: Pupil, wavelength_m: float, p_rad: Array, q_rad: Array) -> Array:
    """Monochromatic intensity (len(q), len(p)) of an aperture's image, by direct transform."""
    place = pupil.places_m
    turn = -2j * math.pi / wavelength_m
    along_p = np.exp(turn * np.outer(place, p_rad))
    along_q = np.exp(turn * np.outer(q_rad, place))
    field = along_q @ pupil.transmission @ along_p
    return np.asarray(np.abs(field) ** 2 * (pupil.cell_m**2 / wavelength_m) ** 2)


# The colours of a star's light, and the resulting correlation in time. Frequencies are angular,
# rad/s; wavelengths in metres; delays in seconds.

LIGHT_SPEED_M_PER_S = 299_792_458.0
PLANCK_OVER_BOLTZMANN_K_S = 7.638_232_577e-12
"""Planck's reduced constant over Boltzmann's, h-bar / k in K s."""


@dataclass(frozen=True)
class Spectrum:
    """A spectrum as discrete powers: spectral density (one-sided) times the width of each bin.

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
        """The wavelengths of a spectrum's frequencies, in metres."""
        return np.asarray(2.0 * math.pi * LIGHT_SPEED_M_PER_S / self.omega_rad_per_s)


def thermal(
    temperature_k: float, shortest_m: float, longest_m: float, colours: int = 41
) -> Spectrum:
    """The spectrum of a black body within a sharply limited band."""
    ends = 2.0 * math.pi * LIGHT_SPEED_M_PER_S / np.array([longest_m, shortest_m])
    width = (ends[1] - ends[0]) / colours
    omega = ends[0] + width * (np.arange(colours) + 0.5)
    heat = PLANCK_OVER_BOLTZMANN_K_S * omega / temperature_k
    density = omega**3 / np.expm1(heat)
    return Spectrum(omega, density / density.sum())
