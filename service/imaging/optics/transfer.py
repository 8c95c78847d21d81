"""The transfer functional (report, part II): from an aperture and a spectrum to a star's image.

The image of a point of light is the transform of the aperture's autocorrelation in
space, taken with the light's autocorrelation in time (2.23).  Its forms below give the
same numbers; directions p = u / f and q = v / f are in radians, so that one answer
serves any focal length f, which is taken to be the same for all colours.

The report's 2.9 has no 1/(lambda f).  Without it the image of each colour holds
(lambda f)² times the open area, and red is weighted too high.  Here an image is
irradiance per direction: it holds the open area, whatever the colour.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.imaging.centroids.window import Array
from service.imaging.optics.pupil import Pupil
from service.imaging.optics.spectrum import LIGHT_SPEED_M_PER_S, Spectrum


@dataclass(frozen=True)
class PointImage:
    """The image of a star: `intensity` (rows along q, columns along p), odd, the star amid it.

    The sum of intensity times `step_rad`² is the light held, in m² of open aperture.
    """

    intensity: Array
    step_rad: float

    @property
    def held_m2(self) -> float:
        """The light within the image."""
        return float(self.intensity.sum()) * self.step_rad**2

    @property
    def angles_rad(self) -> Array:
        """P of the columns, and q of the rows."""
        reach = self.intensity.shape[0] // 2
        return np.arange(-reach, reach + 1) * self.step_rad


def image_by_fft(pupil: Pupil, wavelength_m: float) -> PointImage:
    """One colour's image over all directions that the grid of the pupil resolves.

    The step is lambda over the width of the grid, which should be at least twice the
    pupil: half the step that an image of that pupil needs.
    """
    n = pupil.transmission.shape[0]
    field = np.fft.fftshift(np.fft.fft2(pupil.transmission))
    intensity = np.abs(field) ** 2 * (pupil.cell_m**2 / wavelength_m) ** 2
    # An odd number of directions, so that the star is on one of them.
    first = 0 if n % 2 else 1
    return PointImage(intensity[first:, first:], wavelength_m / (n * pupil.cell_m))


def image_at(pupil: Pupil, wavelength_m: float, p_rad: Array, q_rad: Array) -> Array:
    """One colour's intensity (len(q), len(p)) in any directions, by the transform itself."""
    place = pupil.places_m
    turn = -2j * math.pi / wavelength_m
    along_p = np.exp(turn * np.outer(place, p_rad))
    along_q = np.exp(turn * np.outer(q_rad, place))
    field = along_q @ pupil.transmission @ along_p
    return np.asarray(np.abs(field) ** 2 * (pupil.cell_m**2 / wavelength_m) ** 2)


def image_of(
    pupil: Pupil | Callable[[float], Pupil],
    spectrum: Spectrum,
    step_rad: float,
    reach: int,
    photons: bool = False,
) -> PointImage:
    """The image in all colours of a spectrum, 2 reach + 1 directions each way.

    A transparency whose phase depends on the colour is given as a function of the
    wavelength.  `photons` weighs by number, as a detector counts, instead of by energy.
    """
    angle = np.arange(-reach, reach + 1, dtype=np.float64) * step_rad
    total = np.zeros((2 * reach + 1, 2 * reach + 1))
    power = spectrum.power * (spectrum.wavelength_m if photons else 1.0)
    for wavelength, share in zip(spectrum.wavelength_m, power / power.sum(), strict=True):
        here = pupil(float(wavelength)) if callable(pupil) else pupil
        total += share * image_at(here, float(wavelength), angle, angle)
    return PointImage(total, step_rad)


def autocorrelation(pupil: Pupil) -> Array | npt.NDArray[np.complex128]:
    """phi(D1, D2) (2.13) at whole cells, (2n - 1, 2n - 1), no displacement in its middle."""
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
    """2.23 itself: 2 pi times the sum of phi e_hh(-(u D1 + v D2) / (c f)), at pairs (p, q).

    `phi` (odd, odd) at steps of `cell_m`.  Of the plain spectrum this is the report's
    form; with S / lambda² in its place it is right in colour, up to a constant.
    """
    reach = phi.shape[0] // 2
    place = np.arange(-reach, reach + 1) * cell_m
    pairs = np.broadcast_arrays(np.asarray(p_rad), np.asarray(q_rad))
    found = np.empty(pairs[0].shape)
    for at in np.ndindex(pairs[0].shape):
        delay = -(pairs[0][at] * place[None, :] + pairs[1][at] * place[:, None])
        found[at] = np.sum(phi * correlation(delay / LIGHT_SPEED_M_PER_S)).real
    return 2.0 * math.pi * cell_m**2 * found
