"""Records of the report's claims and this project's measured values."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Verdict = Literal["confirmed", "corrected", "qualified", "added"]
"""Verdicts on a claim; corrected: the report had an error; qualified: valid within limits."""


@dataclass(frozen=True)
class Claim:
    """A claim of a section of the report, our finding, and whether it is within its bounds.

    `figures` are the numbers behind `ours`, by name.
    """

    section: str
    says: str
    ours: str
    verdict: Verdict
    holds: bool
    figures: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Picture:
    """A figure of the documentation: caption, size in inches, and drawing function."""

    caption: str
    size: tuple[float, float]
    draw: Callable[["Figure"], None]


@dataclass(frozen=True)
class Row:
    """One system of the report, such as `IM-4`: title, claims, and pictures by name."""

    name: str
    title: str
    claims: tuple[Claim, ...]
    pictures: Mapping[str, Picture] = field(default_factory=dict)

    @property
    def holds(self) -> bool:
        """True if all claims are within their bounds."""
        return all(claim.holds for claim in self.claims)


@dataclass(frozen=True)
class Study:
    """Parameters of the measurements: random seed, and reduced sample sizes if quick."""

    seed: int
    quick: bool = False

    def rng(self, row: int) -> np.random.Generator:
        """Random generator of one row, independent of which other rows are measured."""
        return np.random.default_rng([self.seed, row])

    def trials(self, full: int) -> int:
        """Number of trials: `full`, or in a quick check a tenth of it, but at least 200."""
        return max(full // 10, 200) if self.quick else full

    def slack(self, trials: int, bound: float) -> float:
        """Bound on the ratio of two scatters, raised to four standard errors for few trials."""
        return max(bound, 4.0 / float(np.sqrt(2.0 * trials)))
