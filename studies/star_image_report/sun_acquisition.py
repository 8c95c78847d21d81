"""The sun tracker with three apertures or photodiodes: one to acquire, two on the tails (5.3).

The report has pairs in mind only for its signals X and Y; three single detectors do as well:
that of acquisition sees the direct sun, says that it is there, and is the measure of its
brightness for the two others.  Angles are in arcminutes; a detector's place is (p, q).
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from studies.star_image_report.claims import Claim, Picture, Study
from studies.star_image_report.sun_tracker import SunTracker

FIELD_ARCMIN = 600.0
"""Farthest from the axis that a search begins."""
STEPS = 40
GAIN = 0.6


@dataclass(frozen=True)
class ThreeDetectors:
    """Squares: `acquire_arcmin` wide in the middle, and one on the flank of each tail."""

    tracker: SunTracker = field(default_factory=SunTracker)
    acquire_arcmin: float = 48.0
    samples: int = 41
    threshold: float = 0.5
    """The share of the sun's light in the middle from which on the sun counts as acquired."""

    @cached_property
    def nominal(self) -> tuple[float, float]:
        """Light on the middle detector and on one of the others, the sun in the middle."""
        return self.acquired_light(0.0, 0.0), self.flank_light(0.0, 0.0)

    def acquired_light(self, p_arcmin: float, q_arcmin: float) -> float:
        """The mean light of the direct sun on the middle detector, 1 for a sun that covers it."""
        edge = self.acquire_arcmin
        near = ((np.arange(self.samples) + 0.5) / self.samples - 0.5) * edge
        away = np.hypot(near[None, :] - p_arcmin, near[:, None] - q_arcmin)
        return float((away < self.tracker.sun_radius_arcmin).mean())

    def signals(self, p_arcmin: float, q_arcmin: float) -> tuple[float, float] | None:
        """The errors along p and q, of one detector each; None unless the sun is acquired.

        The light on a flank over that on the middle detector, by the same for a centred sun,
        less one: brightness of the sun and age of the screen cancel.
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
        """How fast a signal grows about zero."""
        ahead, behind = (self.signals(sign * step_arcmin, 0.0) for sign in (1.0, -1.0))
        assert ahead is not None
        assert behind is not None
        return (ahead[0] - behind[0]) / (2.0 * step_arcmin)

    def direct_onflank_light(self) -> float:
        """Light on a flank's detector from a sun that shines on it directly, over its own light."""
        tracker = self.tracker
        light = self.flank_light(tracker.out_arcmin, tracker.aside_arcmin)
        return light / self.nominal[1]

    def steered(self, p_arcmin: float, q_arcmin: float) -> tuple[float, float, int] | None:
        """The place where the loop leaves a sun at (p, q), and the number of places searched.

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
        """The mean light on a tail's detector, the sun so far off along that tail and across."""
        tracker = self.tracker
        near = (np.arange(tracker.samples) + 0.5) / tracker.samples - 0.5
        along = tracker.out_arcmin + near * tracker.side_arcmin - along_arcmin
        across = tracker.aside_arcmin + near * tracker.side_arcmin - across_arcmin
        return float(tracker.tail_light(along[None, :], across[:, None]).mean())


def _spiral(step_arcmin: float, reach_arcmin: float) -> list[tuple[float, float]]:
    """Places of a square grid, ring by ring from the middle."""
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
    """The claims of 5.3."""
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
    """The figures of 5.3."""
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
