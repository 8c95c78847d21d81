"""Model of a sun tracker on the tails of a diffraction cross (report, 5.3).

A screen of wires diffracts the sun's disc along two tails.  A pair of detectors far out on the tail
along p measures the sun's error along q, and a pair on the other tail the other error: two signals
without moving parts, in harmless light.  Resolution does not improve: the tail is narrower than the
sun because its rim is faint.  Angles are in arcminutes.

Also a tracker with three apertures or photodiodes: one to acquire, two on the tails.  The report
considers pairs only for its signals X and Y; three single detectors suffice: the acquisition
detector sees the direct sun, shows its presence, and measures its brightness for the other two.
Angles are in arcminutes; a detector's place is (p, q).
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from service.features.pictures.centroids.window import Array
from studies.star_image_report.claims import Claim, Picture, Study
from studies.star_image_report.wires import INCH_M, Mesh

ARCMIN_PER_RADIAN = 180.0 * 60.0 / np.pi


@dataclass(frozen=True)
class SunTracker:
    """Parameters of a sun tracker: screen, band of light, sun, and places of the detector pairs.

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
        """Positions (arcmin, ascending) of all orders and wavelengths, and cumulative light."""
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
        """Brightness of the sun's cross on its tail, 1 for the direct sun.

        At distances from the middle of the sun, along the tail and across it.
        """
        places, total = self._orders
        across = np.abs(across_arcmin)
        half = np.sqrt(np.maximum(self.sun_radius_arcmin**2 - across**2, 0.0))
        low = np.searchsorted(places, along_arcmin - half)
        high = np.searchsorted(places, along_arcmin + half, side="right")
        return np.where(across < self.sun_radius_arcmin, total[high] - total[low], 0.0)

    def errors(self, p_arcmin: float, q_arcmin: float) -> tuple[float, float]:
        """Error signals e = (I+ - I-) / (I+ + I-) of both pairs for a sun displaced by (p, q)."""
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
        """Slope of the error signal at zero, per arcminute."""
        return (self.errors(step_arcmin, 0.0)[0] - self.errors(-step_arcmin, 0.0)[0]) / (
            2.0 * step_arcmin
        )

    def tail_width_arcmin(self) -> float:
        """Full width at half maximum of the tail, across it at the detectors, in arcminutes."""
        across = np.linspace(0.0, self.sun_radius_arcmin, 1601)
        out = np.array([self.out_arcmin])
        profile = np.array([float(self.tail_light(out, np.array([x]))[0]) for x in across])
        return 2.0 * float(across[np.argmax(profile < 0.5 * profile[0])])

    def attenuation(self) -> float:
        """Brightness of the tail at the detectors, relative to the direct image."""
        zero = np.zeros(1)
        tail = float(self.tail_light(np.array([self.out_arcmin]), zero)[0])
        return tail / float(self.tail_light(zero, zero)[0])


FIELD_ARCMIN = 600.0
"""Greatest angle from the axis at which a search begins, in arcminutes."""
STEPS = 40
GAIN = 0.6


@dataclass(frozen=True)
class ThreeDetectors:
    """Sun tracker with three square detectors: one in the middle, one on each tail's flank."""

    tracker: SunTracker = field(default_factory=SunTracker)
    acquire_arcmin: float = 48.0
    samples: int = 41
    threshold: float = 0.5
    """Share of the sun's light on the middle detector from which the sun counts as acquired."""

    @cached_property
    def nominal(self) -> tuple[float, float]:
        """Light on the middle detector and on a flank detector with a centred sun."""
        return self.acquired_light(0.0, 0.0), self.flank_light(0.0, 0.0)

    def acquired_light(self, p_arcmin: float, q_arcmin: float) -> float:
        """Mean light on the middle detector of the sun, p and q off its centre; 1 if covered."""
        edge = self.acquire_arcmin
        near = ((np.arange(self.samples) + 0.5) / self.samples - 0.5) * edge
        away = np.hypot(near[None, :] - p_arcmin, near[:, None] - q_arcmin)
        return float((away < self.tracker.sun_radius_arcmin).mean())

    def signals(self, p_arcmin: float, q_arcmin: float) -> tuple[float, float] | None:
        """Error signals along p and q, from one detector each; None unless the sun is acquired.

        The ratio of light on a flank and the middle detector, relative to a centred sun, less one:
        brightness of the sun and age of the screen cancel.
        """
        middle, flank = self.nominal
        acquired = self.acquired_light(p_arcmin, q_arcmin)
        if acquired < self.threshold * middle:
            return None
        # The tail along q tells p, and the other way round.
        return (
            self.flank_light(q_arcmin, p_arcmin) / flank * middle / acquired - 1.0,
            self.flank_light(p_arcmin, q_arcmin) / flank * middle / acquired - 1.0,
        )

    def slope_per_arcmin(self, step_arcmin: float = 0.5) -> float:
        """Slope of a signal at zero, per arcminute."""
        ahead, behind = (self.signals(sign * step_arcmin, 0.0) for sign in (1.0, -1.0))
        assert ahead is not None
        assert behind is not None
        return (ahead[0] - behind[0]) / (2.0 * step_arcmin)

    def direct_onflank_light(self) -> float:
        """Light of the direct sun on a flank detector, relative to its normal light."""
        tracker = self.tracker
        light = self.flank_light(tracker.out_arcmin, tracker.aside_arcmin)
        return light / self.nominal[1]

    def steered(self, p_arcmin: float, q_arcmin: float) -> tuple[float, float, int] | None:
        """Final error of the control loop for a sun at (p, q), and the number of searched places.

        A square spiral until the middle detector sees the sun, then steps along both signals.
        """
        reach = 0.5 * self.acquire_arcmin
        slope = self.slope_per_arcmin()
        for count, (u, v) in enumerate(_spiral(reach, FIELD_ARCMIN * 1.1), start=1):
            left = p_arcmin - u, q_arcmin - v
            if self.signals(*left) is None:
                continue
            p, q = left
            for _ in range(STEPS):
                error = self.signals(p, q)
                if error is None:
                    return None
                limit = 0.25 * reach
                p -= float(np.clip(GAIN * error[0] / slope, -limit, limit))
                q -= float(np.clip(GAIN * error[1] / slope, -limit, limit))
            return p, q, count
        return None

    def flank_light(self, along_arcmin: float, across_arcmin: float) -> float:
        """Mean light on a tail's detector, for a sun displaced along that tail and across it."""
        tracker = self.tracker
        near = (np.arange(tracker.samples) + 0.5) / tracker.samples - 0.5
        along = tracker.out_arcmin + near * tracker.side_arcmin - along_arcmin
        across = tracker.aside_arcmin + near * tracker.side_arcmin - across_arcmin
        return float(tracker.tail_light(along[None, :], across[:, None]).mean())


def _spiral(step_arcmin: float, reach_arcmin: float) -> list[tuple[float, float]]:
    """Points of a square grid, ring by ring from the middle."""
    rings = math.ceil(reach_arcmin / step_arcmin)
    places = [(0.0, 0.0)]
    for ring in range(1, rings + 1):
        side = range(-ring, ring)
        edge = [
            *((i, -ring) for i in side), *((ring, i) for i in side),
            *((-i, ring) for i in side), *((-ring, -i) for i in side),
        ]  # fmt: skip
        places += [(step_arcmin * i, step_arcmin * j) for i, j in edge]
    return places


def claims(study: Study) -> tuple[Claim, ...]:
    """Check the claims of section 5.3 with three detectors."""
    rng = study.rng(53)
    three = ThreeDetectors()
    slope = three.slope_per_arcmin()
    line = (three.signals(4.0, 0.0) or (math.nan, 0.0))[0] / (4.0 * slope)
    cross = max(abs((three.signals(0.0, float(q)) or (9.0, 0.0))[0]) for q in range(5))
    starts = 10 if study.quick else 200
    ends = []
    looked = []
    for _ in range(starts):
        radius, angle = FIELD_ARCMIN * math.sqrt(rng.random()), math.tau * rng.random()
        found = three.steered(radius * math.cos(angle), radius * math.sin(angle))
        ends.append(math.inf if found is None else math.hypot(found[0], found[1]))
        looked.append(0 if found is None else found[2])
    bright = three.direct_onflank_light()
    return (
        Claim(
            "5.3",
            "an aperture acquires the sun, two more on the tails give separate X and Y signals",
            f"from {starts} places up to {FIELD_ARCMIN / 60.0:.0f}° off the sun is found in "
            f"{max(looked)} looks at most and centred to {max(ends):.1e}′; a sun that shines on a "
            f"detector directly gives it {bright:,.0f} times its light, which the middle one tells "
            "from a signal",
            "confirmed",
            max(ends) < 0.1 and bright > 300.0,
            {"worst end (arcmin)": max(ends), "direct over tail": bright},
        ),
        Claim(
            "5.3",
            "an even simpler system has a lens, a filter and three photodiodes",
            f"one detector each, divided by the middle one: {slope:.3f} per arcmin (a pair has "
            f"{three.tracker.slope_per_arcmin():.3f}), at 4′ {line:.2f} of the straight line; but "
            f"the tail fades along itself, so that 4′ along it look like {cross / slope:.1f}′ "
            "across it, where a pair shows nothing; the loop settles at zero all the same",
            "qualified",
            slope > 0.05 and 0.05 < cross < 0.3 and abs(line - 1.0) < 0.2,
            {"slope per arcmin": slope, "crosstalk": cross},
        ),
    )


def pictures() -> dict[str, Picture]:
    """Figures of section 5.3 with three detectors."""
    return {
        "imaging-three-detectors": Picture(
            "Three photodiodes: the two signals as the sun moves along p. They end where the "
            "middle detector has lost half of the sun.",
            (5.6, 3.0),
            _draw,
        )
    }


def _draw(figure: Any) -> None:
    three, axis = ThreeDetectors(), figure.subplots()
    off = np.linspace(-30.0, 30.0, 121)
    errors_pq = [three.signals(float(p), 0.0) or (math.nan, math.nan) for p in off]
    for name, color, signals in zip(
        "pq", ("#0b5394", "#b45309"), zip(*errors_pq, strict=True), strict=True
    ):
        axis.plot(off, signals, color=color, label=f"signal of {name}")
    light = [three.acquired_light(float(p), 0.0) / three.nominal[0] for p in off]
    axis.plot(off, light, color="0.6", lw=0.8, ls="--", label="light in the middle")
    axis.set(xlabel="sun off along p (′)", ylabel="signal")
    axis.legend(fontsize=7)
