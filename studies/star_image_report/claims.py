"""Claims of the report beside this project's measured values, gathered in rows."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Verdict = Literal["confirmed", "corrected", "qualified", "added"]
"""Corrected: a slip of the report, mended.  Qualified: right within limits that ours shows."""


@dataclass(frozen=True)
class Claim:
    """A statement of the report in a section, the finding here, and whether that is in its bounds.

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
    """A figure of the documentation: its size in inches, what it shows, and how it is drawn."""

    caption: str
    size: tuple[float, float]
    draw: Callable[["Figure"], None]


@dataclass(frozen=True)
class Row:
    """One system of the report: `IM-4`, its title, its claims and pictures by name."""

    name: str
    title: str
    claims: tuple[Claim, ...]
    pictures: Mapping[str, Picture] = field(default_factory=dict)

    @property
    def holds(self) -> bool:
        """True if everything is within its bounds."""
        return all(claim.holds for claim in self.claims)


@dataclass(frozen=True)
class Study:
    """How the rows are measured: from which seed, and on samples how large."""

    seed: int
    quick: bool = False

    def rng(self, row: int) -> np.random.Generator:
        """Random numbers of one row: the same whether or not the others are measured."""
        return np.random.default_rng([self.seed, row])

    def trials(self, full: int) -> int:
        """The size of a sample."""
        return max(full // 10, 200) if self.quick else full

    def slack(self, trials: int, bound: float) -> float:
        """A bound on a scatter, with four standard errors of so many trials where they are few."""
        return max(bound, 4.0 / float(np.sqrt(2.0 * trials)))
