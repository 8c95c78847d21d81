"""Detection of tolerances that are too tight or too wide for the measured differences.

A tolerance is compared with the differences of pairs that are known to be the same stars.  A
tolerance is too tight if it certainly loses more than 1 % of the true pairs, and too wide if it is
certainly more than WIDE times the value needed: false pairs then pass unnecessarily.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from service.features.advice.evidence import Evidence
from service.intervals import Interval, quantile, share_of
from service.missions.mission import Band, Mission
from service.vectors import Vector

KEPT = 0.99
"""Share of true pairs that a tolerance should accept."""
MARGIN = 1.2
"""Factor between needed and recommended tolerance: later data may be worse than the sample."""
WIDE = 4.0
LEAST_BATCHES = 20
LEAST_DIFFERENCES = 100

ToleranceVerdict = Literal["too_tight", "fits", "too_wide", "no_verdict", "not_used"]
Confidence = Literal["high", "moderate", "low", "none"]
Differences = Callable[[Evidence], tuple[Vector, npt.NDArray[np.int64]]]


@dataclass(frozen=True)
class Tolerance:
    """Description of a tolerance: names, unit, test, largest value, and differences it bounds."""

    name: str
    symbol: str
    symbol_in_bands: str
    unit: Literal["deg", "mag"]
    what: str
    test: str | None
    """Name of the switch in the mission's `tests` for the tolerance; None: always active."""
    in_caps: bool
    most: float
    """Largest value of the tolerance that a mission file accepts."""
    differences: Differences
    loses: str = "loses {share} of the true {what}"
    """Text for the consequence of a tolerance that is too small."""


TOLERANCES: tuple[Tolerance, ...] = (
    Tolerance(
        "separation_deg",
        "SEPTOL",
        "SEPTOL",
        "deg",
        "separations of pairs",
        None,
        True,
        5.0,
        lambda e: (e.pairs.separation_deg, e.pairs.batch),
    ),
    Tolerance(
        "magnitude_mag",
        "XMTOL",
        "XMTOL",
        "mag",
        "magnitudes of stars",
        "magnitude",
        True,
        30.0,
        lambda e: (e.stars.observed_mag - e.stars.catalog_mag, e.stars.batch),
    ),
    Tolerance(
        "magnitude_order_mag",
        "TMAGMX",
        "TMAGMX",
        "mag",
        "differences of magnitude in pairs",
        "magnitude",
        True,
        30.0,
        lambda e: (e.pairs.magnitude_difference_mag, e.pairs.batch),
        "orders stars by brightness though {share} of the {what} are off by more",
    ),
    Tolerance(
        "cross_product_deg",
        "CAPMAX",
        "BANMAX",
        "deg",
        "directions of pairs",
        "cross_product",
        True,
        180.0,
        lambda e: (e.pairs.cross_product_deg, e.pairs.batch),
    ),
    Tolerance(
        "pole_difference_deg",
        "BANTOL1",
        "BANTOL1",
        "deg",
        "differences of the angles to the pole",
        "pole",
        False,
        180.0,
        lambda e: (e.pairs.pole_difference_deg, e.pairs.batch),
    ),
    Tolerance(
        "pole_angle_deg",
        "BANTOL2",
        "BANTOL2",
        "deg",
        "angles to the pole",
        "pole",
        False,
        180.0,
        lambda e: (e.stars.pole_angle_deg, e.stars.batch),
    ),
)


@dataclass(frozen=True)
class ToleranceFinding:
    """Judgement of one tolerance from the differences of true pairs.

    `needed` is the value that lets KEPT of the true pairs pass; `beyond` is the
    share that the present value loses.  Both are None without data.
    `recommended` is None where there is nothing to recommend.
    """

    tolerance: Tolerance
    symbol: str
    now: float
    verdict: ToleranceVerdict
    confidence: Confidence
    differences: int
    batches: int
    needed: Interval | None
    beyond: Interval | None
    recommended: float | None


def tolerance_findings(mission: Mission, evidence: Evidence) -> list[ToleranceFinding]:
    """Judge every tolerance that applies to the mission's kind of zone."""
    in_band = isinstance(mission.zone, Band)
    return [
        _finding(tolerance, mission, evidence, in_band)
        for tolerance in TOLERANCES
        if tolerance.in_caps or in_band
    ]


def _finding(
    tolerance: Tolerance, mission: Mission, evidence: Evidence, in_band: bool
) -> ToleranceFinding:
    now = float(getattr(mission.tolerances, tolerance.name))
    symbol = tolerance.symbol_in_bands if in_band else tolerance.symbol
    differences, batch = tolerance.differences(evidence)
    known = np.isfinite(differences)
    differences, batch = np.abs(differences[known]), batch[known]
    batches = len(np.unique(batch))
    used = tolerance.test is None or bool(getattr(mission.tests, tolerance.test))
    needed = beyond = recommended = None
    verdict: ToleranceVerdict = "no_verdict" if used else "not_used"
    if len(differences):
        needed = quantile(differences, batch, KEPT)
        beyond = share_of(differences > now, batch)
    if needed and beyond and used and batches >= LEAST_BATCHES:
        verdict = _verdict(now, needed, beyond, len(differences))
        if verdict in ("too_tight", "too_wide"):
            bound = needed.high if math.isfinite(needed.high) else needed.value
            recommended = min(rounded_up(MARGIN * bound), tolerance.most)
    return ToleranceFinding(
        tolerance,
        symbol,
        now,
        verdict,
        _confidence(verdict, needed),
        len(differences),
        batches,
        needed,
        beyond,
        recommended,
    )


def _verdict(now: float, needed: Interval, beyond: Interval, differences: int) -> ToleranceVerdict:
    if beyond.low > 1.0 - KEPT:
        return "too_tight"
    if differences < LEAST_DIFFERENCES or not math.isfinite(needed.high):
        return "no_verdict"
    if now > WIDE * needed.high:
        return "too_wide"
    # Neither is certain: "fits" if the needed value is known at least to a factor of two.
    return "fits" if beyond.high <= 1.0 - KEPT or needed.high <= 2.0 * needed.low else "no_verdict"


def _confidence(verdict: ToleranceVerdict, needed: Interval | None) -> Confidence:
    if needed is None or verdict in ("no_verdict", "not_used"):
        return "none"
    if not math.isfinite(needed.high) or needed.value == 0.0:
        return "low"
    width = (needed.high - needed.low) / (2.0 * needed.value)
    return "high" if width <= 0.15 else "moderate" if width <= 0.4 else "low"


def rounded_up(value: float) -> float:
    """Round a value up to two significant digits, for a mission file."""
    if value <= 0.0:
        return 0.0
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(round(value / step, 9)) * step:.12g}")
