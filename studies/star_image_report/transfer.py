"""Images of stars by the report's own ways, beside the direct transform of `imaging.optics`.

Apertures, images and spectra are those of `imaging.optics`; the functional is the report's 2.23.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.features.pictures.centroids.optics import (
    LIGHT_SPEED_M_PER_S,
    Pupil,
    Spectrum,
    image_at,
)
from service.features.pictures.centroids.window import Array


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


def behind_plate(pupil: Pupil, thickness_m: Array, index: float, wavelength_m: float) -> Pupil:
    """An aperture behind a glass plate of varying thickness: alpha = 2 pi (n1 - 1) gamma / lambda
    (2.5).

    The phase, and the index where the glass is dispersive, hold for one wavelength.
    """
    alpha = 2.0 * math.pi * (index - 1.0) * thickness_m / wavelength_m
    return pupil.behind(np.exp(1j * alpha))


def is_even(pupil: Pupil) -> bool:
    """True if f(x, y) = f(-x, y) = f(x, -y) for an aperture, so that its image is even (7.10 to
    7.16).
    """
    f = pupil.transmission
    tight = 1e-12 * float(np.abs(f).max())
    return bool(np.allclose(f, f[::-1], 0, tight) and np.allclose(f, f[:, ::-1], 0, tight))


def between_wires(places_m: Array, cell_m: float, wires: Sequence[tuple[float, float]]) -> Array:
    """Uncovered share of every cell in a row behind parallel wires (middle, diameter) in metres."""
    covered = np.zeros_like(places_m)
    for middle, diameter in wires:
        low = np.maximum(places_m - cell_m / 2.0, middle - diameter / 2.0)
        high = np.minimum(places_m + cell_m / 2.0, middle + diameter / 2.0)
        covered += np.maximum(high - low, 0.0) / cell_m
    return np.asarray(np.maximum(1.0 - covered, 0.0))


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


def mean_wavelength_m(spectrum: Spectrum) -> float:
    """The mean wavelength of a spectrum, weighted by power, in metres."""
    return float(spectrum.wavelength_m @ spectrum.power / spectrum.power.sum())


def correlation(spectrum: Spectrum, delay_s: npt.ArrayLike) -> npt.NDArray[np.complex128]:
    """The complex autocorrelation of light in time, e_hh(tau) = (1/2 pi) integral of S e^(j omega
    tau) d omega (2.22).
    """
    delay = np.asarray(delay_s, dtype=np.float64)
    total = np.zeros(delay.shape, dtype=np.complex128)
    for omega, power in zip(spectrum.omega_rad_per_s, spectrum.power, strict=True):
        total += power * np.exp(1j * omega * delay)
    return total / (2.0 * math.pi)


def monochromatic(wavelength_m: float) -> Spectrum:
    """The spectrum of light of one wavelength."""
    omega = 2.0 * math.pi * LIGHT_SPEED_M_PER_S / wavelength_m
    return Spectrum(np.array([omega]), np.array([1.0]))


def gaussian_line(wavelength_m: float, relative_width: float, colours: int = 201) -> Spectrum:
    """The spectrum of a Gaussian line, exp(-(omega - omega0)² / 2 sigma²) with sigma =
    relative_width omega0 (report, 2.5).

    Sampled at `colours` frequencies out to 6 sigma, as far as they are positive.
    """
    omega0 = 2.0 * math.pi * LIGHT_SPEED_M_PER_S / wavelength_m
    sigma = relative_width * omega0
    low, high = max(omega0 - 6.0 * sigma, 1e-3 * omega0), omega0 + 6.0 * sigma
    omega = np.linspace(low, high, colours)
    density = np.exp(-0.5 * ((omega - omega0) / sigma) ** 2)
    return Spectrum(omega, density * (omega[1] - omega[0]))


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
