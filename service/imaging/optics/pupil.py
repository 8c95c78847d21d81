"""What stands in the aperture: open discs, wires, glass of any thickness.

An aperture is a square grid of complex transmissions P = p e^(j alpha) (report, 2.5),
centred between the middle cells; edges are weighted by the area they cover.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault
from service.imaging.centroids.window import Array

PupilField = npt.NDArray[np.complex128] | npt.NDArray[np.float64]


@dataclass(frozen=True)
class Pupil:
    """Transmission (n, n), rows along y, columns along x; `cell_m` is a cell's side."""

    transmission: PupilField
    cell_m: float

    @property
    def open_area_m2(self) -> float:
        """What it lets through of a uniform light: the integral of |P|²."""
        return float(np.sum(np.abs(self.transmission) ** 2)) * self.cell_m**2

    @property
    def places_m(self) -> Array:
        """Middles of the cells along either axis, symmetric about zero."""
        return centres(self.transmission.shape[0], self.cell_m)

    def behind(self, transmission: PupilField) -> "Pupil":
        """With a further transparency before or after it."""
        return Pupil(self.transmission * transmission, self.cell_m)

    def with_plate(self, thickness_m: Array, index: float, wavelength_m: float) -> "Pupil":
        """With a glass of this thickness: alpha = 2 pi (n1 - 1) gamma / lambda (2.5).

        The phase, and where the glass disperses the index, belong to one wavelength.
        """
        alpha = 2.0 * math.pi * (index - 1.0) * thickness_m / wavelength_m
        return self.behind(np.exp(1j * alpha))

    def is_even(self) -> bool:
        """Whether f(x, y) = f(-x, y) = f(x, -y), which makes the image even (7.10 to 7.16)."""
        f = self.transmission
        tight = 1e-12 * float(np.abs(f).max())
        return bool(np.allclose(f, f[::-1], 0, tight) and np.allclose(f, f[:, ::-1], 0, tight))


def centres(number: int, cell_m: float) -> Array:
    """Middles of `number` cells in a row, symmetric about zero."""
    return np.asarray((np.arange(number) - (number - 1) / 2.0) * cell_m, dtype=np.float64)


def disc(number: int, cell_m: float, radius_m: float, obscuration: float = 0.0) -> Pupil:
    """An open circle on a grid of number x number cells; a central part of it may be dark.

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
    """The open share of every cell in a row, behind parallel wires (middle, diameter) in metres."""
    covered = np.zeros_like(places_m)
    for middle, diameter in wires:
        low = np.maximum(places_m - cell_m / 2.0, middle - diameter / 2.0)
        high = np.minimum(places_m + cell_m / 2.0, middle + diameter / 2.0)
        covered += np.maximum(high - low, 0.0) / cell_m
    return np.asarray(np.maximum(1.0 - covered, 0.0))


def behind_wires(pupil: Pupil, wires: Sequence[tuple[float, float, float]]) -> Pupil:
    """The pupil behind straight wires in any directions.

    Each is (direction that it runs in, rad from x towards y; how far its middle is from that of
    the pupil, along the direction turned by a right angle, m; diameter, m).
    """
    x, y = pupil.places_m[None, :], pupil.places_m[:, None]
    found = pupil
    for direction, offset, diameter in wires:
        across = y * math.cos(direction) - x * math.sin(direction) - offset
        low = np.maximum(across - pupil.cell_m / 2.0, -diameter / 2.0)
        high = np.minimum(across + pupil.cell_m / 2.0, diameter / 2.0)
        found = found.behind(1.0 - np.maximum(high - low, 0.0) / pupil.cell_m)
    return found
