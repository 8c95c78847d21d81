"""A sun tracker on the tails of the cross (report, 5.3).

A screen of wires throws the sun's disc along two tails.  A pair of detectors far out on
the tail along p sees how far the sun is off along q, and a pair on the other tail the
other error: two signals without moving parts, in light that burns nothing.  There is no
gain of resolution: the tail is narrower than the sun because its rim is faint.
Angles are in arcminutes.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from service.imaging.centroids.window import Array
from studies.star_image_report.wires import INCH_M, Mesh

ARCMIN_PER_RADIAN = 180.0 * 60.0 / np.pi


@dataclass(frozen=True)
class SunTracker:
    """The screen, the band of light, the sun, and where the pairs of detectors stand.

    A detector is a square of side `side_arcmin`, `out_arcmin` along its tail and
    +-`aside_arcmin` across it.  The faint dots off the tails are left out.
    """

    mesh: Mesh = field(default_factory=lambda: Mesh(INCH_M / 20.0, 0.011 * INCH_M))
    shortest_m: float = 450e-9
    longest_m: float = 700e-9
    colours: int = 26
    sun_radius_arcmin: float = 16.0
    out_arcmin: float = 60.0
    aside_arcmin: float = 12.0
    side_arcmin: float = 17.0
    samples: int = 35

    @cached_property
    def _orders(self) -> tuple[Array, Array]:
        """Places (arcmin, rising) of all orders and colours on a tail, and sums of their light."""
        wavelengths = np.linspace(self.shortest_m, self.longest_m, self.colours)
        reach = (self.out_arcmin + 4.0 * self.sun_radius_arcmin) / ARCMIN_PER_RADIAN
        most = int(np.ceil(reach * self.mesh.pitch_m / self.shortest_m))
        order = np.arange(-most, most + 1)
        # The orders of 4.1 by the openings' own pattern; the zero order is 1.
        light = np.sinc(order * self.mesh.opening_m / self.mesh.pitch_m) ** 2 / self.colours
        places = np.outer(wavelengths, order / self.mesh.pitch_m).ravel() * ARCMIN_PER_RADIAN
        rank = np.argsort(places, kind="stable")
        total = np.cumsum(np.tile(light, self.colours)[rank])
        return places[rank], np.concatenate([[0.0], total])

    def tail_light(self, along_arcmin: Array, across_arcmin: Array) -> Array:
        """Brightness of the sun's cross, on the tail only, 1 for the direct sun.

        At distances from where the middle of the sun stands, along the tail and across it.
        """
        places, total = self._orders
        across = np.abs(across_arcmin)
        half = np.sqrt(np.maximum(self.sun_radius_arcmin**2 - across**2, 0.0))
        low = np.searchsorted(places, along_arcmin - half)
        high = np.searchsorted(places, along_arcmin + half, side="right")
        return np.where(across < self.sun_radius_arcmin, total[high] - total[low], 0.0)

    def errors(self, p_arcmin: float, q_arcmin: float) -> tuple[float, float]:
        """The two signals e = (I+ - I-) / (I+ + I-) for a sun off by (p, q)."""
        # The tail along q tells p, and the other way round.
        return self._signal(q_arcmin, p_arcmin), self._signal(p_arcmin, q_arcmin)

    def _signal(self, along_arcmin: float, across_arcmin: float) -> float:
        near = (np.arange(self.samples) + 0.5) / self.samples - 0.5
        along = self.out_arcmin + near * self.side_arcmin - along_arcmin
        light = []
        for side in (1.0, -1.0):
            across = side * self.aside_arcmin + near * self.side_arcmin - across_arcmin
            light.append(float(self.tail_light(along[None, :], across[:, None]).sum()))
        return (light[0] - light[1]) / (light[0] + light[1]) if sum(light) > 0.0 else 0.0

    def slope_per_arcmin(self, step_arcmin: float = 0.5) -> float:
        """How fast the signal grows about zero."""
        return (self.errors(step_arcmin, 0.0)[0] - self.errors(-step_arcmin, 0.0)[0]) / (
            2.0 * step_arcmin
        )

    def tail_width_arcmin(self) -> float:
        """Full width at half of the maximum, across the tail where the detectors stand."""
        across = np.linspace(0.0, self.sun_radius_arcmin, 1601)
        out = np.array([self.out_arcmin])
        profile = np.array([float(self.tail_light(out, np.array([x]))[0]) for x in across])
        return 2.0 * float(across[np.argmax(profile < 0.5 * profile[0])])

    def attenuation(self) -> float:
        """Brightness on the tail at the detectors, over that of the direct image."""
        zero = np.zeros(1)
        tail = float(self.tail_light(np.array([self.out_arcmin]), zero)[0])
        return tail / float(self.tail_light(zero, zero)[0])
