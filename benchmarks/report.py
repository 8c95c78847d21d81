"""Result of a benchmark: figures by name, and their bounds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks.bounds import Bound, faults_of, shown


@dataclass(frozen=True)
class Report:
    """Figures in the order in which they are shown, and their bounds.

    `curves` are drawn instead of shown: values by name, one for each step of a run.
    """

    name: str
    figures: Mapping[str, Any]
    bounds: Sequence[Bound]
    curves: Mapping[str, list[float]] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """True if there are bounds, and all figures are within them."""
        return bool(self.bounds) and not self.faults

    @property
    def faults(self) -> list[str]:
        """Texts of the bounds that do not hold."""
        return faults_of(self.bounds)

    def text(self) -> str:
        """Printed text of the report."""
        lines = [f"{self.name}: {'within bounds' if self.passed else 'OUT OF BOUNDS'}"]
        lines += [f"  {name:<52} {shown(value)}" for name, value in self.figures.items()]
        lines += [
            f"  {'=' if b.holds else '!'} {b.figure}: {b.measured} ({b.asked})" for b in self.bounds
        ]
        return "\n".join(lines)
