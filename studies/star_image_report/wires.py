"""Wire meshes in front of the lens, which make a diffraction cross of each star (part IV).

Wires along y diffract light along x, into a tail of dashes.  Angles are in radians, p along x and q
along y; lengths in metres.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.features.pictures.centroids.optics import Pupil, disc, image_at
from service.features.pictures.centroids.window import Array
from studies.star_image_report.transfer import between_wires, image_by_fft

INCH_M = 0.0254
Wires = Sequence[tuple[float, float]]
"""Parallel wires as (place, diameter) in metres."""


@dataclass(frozen=True)
class Mesh:
    """Square wire mesh: wires every `pitch_m` metres, `wire_m` thick."""

    pitch_m: float
    wire_m: float

    @property
    def opening_m(self) -> float:
        """Width of the opening between two wires, s = d - wire, in metres."""
        return self.pitch_m - self.wire_m

    @property
    def blocked(self) -> float:
        """Share of an axis covered by wires, e = 1 - s / d."""
        return self.wire_m / self.pitch_m

    def wires(self, number: int) -> Wires:
        """Given number of adjacent wires about the middle of a mesh: (place, width) in m."""
        places = (np.arange(number) - (number - 1) / 2.0) * self.pitch_m
        return [(float(place), self.wire_m) for place in places]

    def across(self, diameter_m: float) -> Wires:
        """Wires across an aperture with an opening in its middle."""
        return self.wires(2 * math.floor(diameter_m / (2.0 * self.pitch_m) + 0.5))

    def shares(self) -> tuple[float, float, float]:
        """Shares of transmitted light in the middle, on the tails and off them, for a full mesh.

        (1 - e)², 2 e (1 - e), e²: the scattered light grows as the product of the shares covered on
        both axes.  In the report it depends on the total number of wires, which is equivalent if
        that total is split evenly.
        """
        e = self.blocked
        return (1.0 - e) ** 2, 2.0 * e * (1.0 - e), e**2


def filtered(
    diameter_m: float, across_x: Wires, across_y: Wires, cells: int = 1500, width: float = 1.0
) -> Pupil:
    """Circular aperture behind wires at given places along x and y.

    `cells` per diameter: a tenth of the thinnest wire, or finer.  The grid is `width` diameters
    wide; twice or more for `image_by_fft`.
    """
    cell = diameter_m / cells
    clear = disc(2 * math.ceil(width * cells / 2), cell, diameter_m / 2.0)
    place = clear.places_m
    return clear.behind(
        between_wires(place, cell, across_y)[:, None]
        * between_wires(place, cell, across_x)[None, :]
    )


def mesh_intensity(
    p_rad: npt.ArrayLike,
    q_rad: npt.ArrayLike,
    wavelength_m: float,
    mesh: Mesh,
    openings: int,
) -> Array:
    """Diffraction by N x N openings (report, 4.1), as irradiance per direction.

    C [sin(N k d p / 2) / sin(k d p / 2)]² [sin(k s p / 2) / (k s p / 2)]² and the same for q.  In
    the report C grows with s^4, the aperture's diameter and 1 / lambda; correct is s^4 / lambda²
    (over f² per area), N^4 being in the first factors.
    """
    scale = mesh.opening_m**4 / wavelength_m**2
    return (
        scale
        * _factor(p_rad, wavelength_m, mesh, openings)
        * _factor(q_rad, wavelength_m, mesh, openings)
    )


def _factor(angle_rad: npt.ArrayLike, wavelength_m: float, mesh: Mesh, openings: int) -> Array:
    angle = np.asarray(angle_rad, dtype=np.float64)
    half = math.pi * mesh.pitch_m * angle / wavelength_m
    # sin(N x) / sin(x) is +-N where x is a multiple of pi.
    sine = np.sin(half)
    at_order = np.abs(sine) < 1e-9
    array = np.where(
        at_order, float(openings), np.sin(openings * half) / np.where(at_order, 1.0, sine)
    )
    return np.asarray((array * np.sinc(mesh.opening_m * angle / wavelength_m)) ** 2)


def along_p(pupil: Pupil, wavelength_m: float, p_rad: Array) -> Array:
    """Intensity along the tail of wires across x, relative to the star."""
    intensity = image_at(pupil, wavelength_m, np.concatenate([[0.0], p_rad]), np.zeros(1))[0]
    return np.asarray(intensity[1:] / intensity[0])


def tail(
    pupil: Pupil, wavelength_m: float, p_rad: Array, fringe_rad: float, samples: int = 9
) -> Array:
    """Tail intensity averaged over a fringe, without its fine structure.

    A fringe is lambda / D for one wire, and lambda over their separation for two.
    """
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    fine = np.asarray(p_rad)[:, None] + fringe_rad * steps[None, :]
    return np.asarray(along_p(pupil, wavelength_m, fine.ravel()).reshape(fine.shape).mean(axis=1))


def first_tail_null_rad(
    pupil: Pupil, wavelength_m: float, diameter_m: float, low_rad: float, high_rad: float
) -> float:
    """Angle of the darkest place of a tail between two angles, to a small part of a fringe."""
    p = np.linspace(low_rad, high_rad, 241)
    light = tail(pupil, wavelength_m, p, wavelength_m / diameter_m)
    at = int(np.clip(np.argmin(light), 1, len(p) - 2))
    before, lowest, after = light[at - 1 : at + 2]
    bend = before - 2.0 * lowest + after
    return float(p[at] + (0.5 * (before - after) / bend if bend > 0.0 else 0.0) * (p[1] - p[0]))


def shares_of_light(
    pupil: Pupil, wavelength_m: float, half_width_rad: float
) -> tuple[float, float, float]:
    """Shares of transmitted light in the middle of an image, on both tails, and off them.

    The middle is the square within `half_width_rad` (half of lambda / d parts the orders
    of a mesh), the tails are the bands of that width about both axes.
    """
    image = image_by_fft(pupil, wavelength_m)
    near = np.abs(image.angles_rad) <= half_width_rad
    light = image.intensity / image.intensity.sum()
    middle = float(light[np.ix_(near, near)].sum())
    tails = float(light[near, :].sum() + light[:, near].sum()) - 2.0 * middle
    return middle, tails, 1.0 - middle - tails


def order_angle_rad(order: int, wavelength_m: float, mesh: Mesh) -> float:
    """Angle of a principal maximum of the mesh, m lambda / d, in radians."""
    return order * wavelength_m / mesh.pitch_m
