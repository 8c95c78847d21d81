"""Images of stars by Fourier optics: from an aperture and a spectrum to a point source's image.

This is the transfer functional of the report (part II): the Fourier transform of the aperture's
autocorrelation in space, combined with the light's autocorrelation in time (2.23). The functions
below give the same numbers in several ways; directions p = u / f and q = v / f are in radians, so
that one result serves any focal length f, assumed the same for all colours.

The report's 2.9 has no 1/(lambda f).  Without it the image of each colour holds
(lambda f)² times the open area, and red is weighted too high.  Here an image is
irradiance per direction: it holds the open area, whatever the colour.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault
from service.imaging.centroids.window import Array


@dataclass(frozen=True)
class PointImage:
    """The image of a point source as `intensity` by direction, centred, of odd size.

    The sum of intensity times `step_rad`² is the light in the image, in m² of open aperture.
    """

    intensity: Array
    step_rad: float

    @property
    def held_m2(self) -> float:
        """The total light within the image of a point source, in m² of open aperture."""
        return float(self.intensity.sum()) * self.step_rad**2

    @property
    def angles_rad(self) -> Array:
        """The directions p of an image's columns, equal to q of its rows, in radians."""
        reach = self.intensity.shape[0] // 2
        return np.arange(-reach, reach + 1) * self.step_rad


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

    def with_plate(self, thickness_m: Array, index: float, wavelength_m: float) -> "Pupil":
        """An aperture behind a glass plate of varying thickness: alpha = 2 pi (n1 - 1) gamma /
        lambda (2.5).

        The phase, and the index where the glass is dispersive, hold for one wavelength.
        """
        alpha = 2.0 * math.pi * (index - 1.0) * thickness_m / wavelength_m
        return self.behind(np.exp(1j * alpha))

    def is_even(self) -> bool:
        """True if f(x, y) = f(-x, y) = f(x, -y) for an aperture, so that its image is even (7.10 to
        7.16).
        """
        f = self.transmission
        tight = 1e-12 * float(np.abs(f).max())
        return bool(np.allclose(f, f[::-1], 0, tight) and np.allclose(f, f[:, ::-1], 0, tight))


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


def between_wires(places_m: Array, cell_m: float, wires: Sequence[tuple[float, float]]) -> Array:
    """Uncovered share of every cell in a row behind parallel wires (middle, diameter) in metres."""
    covered = np.zeros_like(places_m)
    for middle, diameter in wires:
        low = np.maximum(places_m - cell_m / 2.0, middle - diameter / 2.0)
        high = np.minimum(places_m + cell_m / 2.0, middle + diameter / 2.0)
        covered += np.maximum(high - low, 0.0) / cell_m
    return np.asarray(np.maximum(1.0 - covered, 0.0))


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


def image_by_fft(pupil: Pupil, wavelength_m: float) -> PointImage:
    """The monochromatic image of an aperture over all directions that its grid resolves.

    The step is lambda over the width of the grid. The grid should be at least twice as wide as the
    open aperture, which halves the step that sampling requires.
    """
    n = pupil.transmission.shape[0]
    field = np.fft.fftshift(np.fft.fft2(pupil.transmission))
    intensity = np.abs(field) ** 2 * (pupil.cell_m**2 / wavelength_m) ** 2
    # An odd number of directions, so that one of them is the star's.
    first = 0 if n % 2 else 1
    return PointImage(intensity[first:, first:], wavelength_m / (n * pupil.cell_m))


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

    @property
    def mean_wavelength_m(self) -> float:
        """The mean wavelength of a spectrum, weighted by power, in metres."""
        return float(self.wavelength_m @ self.power / self.power.sum())

    def correlation(self, delay_s: npt.ArrayLike) -> npt.NDArray[np.complex128]:
        """The complex autocorrelation of light in time, e_hh(tau) = (1/2 pi) integral of S e^(j
        omega tau) d omega (2.22).
        """
        delay = np.asarray(delay_s, dtype=np.float64)
        total = np.zeros(delay.shape, dtype=np.complex128)
        for omega, power in zip(self.omega_rad_per_s, self.power, strict=True):
            total += power * np.exp(1j * omega * delay)
        return total / (2.0 * math.pi)


def monochromatic(wavelength_m: float) -> Spectrum:
    """The spectrum of light of one wavelength."""
    omega = 2.0 * math.pi * LIGHT_SPEED_M_PER_S / wavelength_m
    return Spectrum(np.array([omega]), np.array([1.0]))


def gaussian_line(
    wavelength_m: float, relative_width: float, colours: int = 201, reach: float = 6.0
) -> Spectrum:
    """The spectrum of a Gaussian line, exp(-(omega - omega0)² / 2 sigma²) with sigma =
    relative_width omega0 (report, 2.5).

    Sampled at `colours` frequencies out to `reach` sigma, as far as they are positive.
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
    """The spectrum of a black body within a sharply limited band."""
    ends = 2.0 * math.pi * LIGHT_SPEED_M_PER_S / np.array([longest_m, shortest_m])
    width = (ends[1] - ends[0]) / colours
    omega = ends[0] + width * (np.arange(colours) + 0.5)
    heat = PLANCK_OVER_BOLTZMANN_K_S * omega / temperature_k
    density = omega**3 / np.expm1(heat)
    return Spectrum(omega, density / density.sum())


def image_of(
    pupil: Pupil | Callable[[float], Pupil],
    spectrum: Spectrum,
    step_rad: float,
    reach: int,
    photons: bool = False,
) -> PointImage:
    """The image of an aperture in all colours of a spectrum, 2 reach + 1 directions each way.

    An aperture whose phase depends on the colour is passed as a function of the wavelength.
    `photons` weights by photon number, as a detector counts, instead of by energy.
    """
    angle = np.arange(-reach, reach + 1, dtype=np.float64) * step_rad
    total = np.zeros((2 * reach + 1, 2 * reach + 1))
    power = spectrum.power * (spectrum.wavelength_m if photons else 1.0)
    for wavelength, share in zip(spectrum.wavelength_m, power / power.sum(), strict=True):
        transparency = pupil(float(wavelength)) if callable(pupil) else pupil
        total += share * image_at(transparency, float(wavelength), angle, angle)
    return PointImage(total, step_rad)


def autocorrelation(pupil: Pupil) -> Array | npt.NDArray[np.complex128]:
    """The autocorrelation phi(D1, D2) of an aperture (2.13) at whole cells; (2n - 1, 2n - 1)."""
    n = pupil.transmission.shape[0]
    field = np.fft.fft2(pupil.transmission, (2 * n - 1, 2 * n - 1))
    phi = np.fft.fftshift(np.fft.ifft2(np.abs(field) ** 2)) * pupil.cell_m**2
    return phi if np.iscomplexobj(pupil.transmission) else np.asarray(phi.real)


def image_by_functional(
    phi: Array | npt.NDArray[np.complex128],
    cell_m: float,
    correlation: Callable[[Array], npt.NDArray[np.complex128]],
    p_rad: Array,
    q_rad: Array,
) -> Array:
    """The image of an aperture by the report's functional 2.23: 2 pi times the sum of phi e_hh(-(u
    D1 + v D2) / (c f)), at pairs (p, q).

    `phi` (odd, odd) at steps of `cell_m`. With the plain spectrum this is the report's form; with S
    / lambda² instead, the weights of the colours are correct up to a constant.
    """
    reach = phi.shape[0] // 2
    place = np.arange(-reach, reach + 1) * cell_m
    pairs = np.broadcast_arrays(np.asarray(p_rad), np.asarray(q_rad))
    found = np.empty(pairs[0].shape)
    for at in np.ndindex(pairs[0].shape):
        delay = -(pairs[0][at] * place[None, :] + pairs[1][at] * place[:, None])
        found[at] = np.sum(phi * correlation(delay / LIGHT_SPEED_M_PER_S)).real
    return 2.0 * math.pi * cell_m**2 * found
