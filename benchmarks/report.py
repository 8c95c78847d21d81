"""What a benchmark gives back: figures by name, and whether they are within bounds."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Report:
    """Figures in the order in which they are shown; `faults` says what is out of bounds.

    `curves` are drawn rather than shown: values by name, one for each step of a run.
    """

    name: str
    figures: dict[str, Any]
    passed: bool
    faults: list[str] = field(default_factory=list)
    curves: dict[str, list[float]] = field(default_factory=dict)

    def text(self) -> str:
        """The report as it is printed."""
        lines = [f"{self.name}: {'within bounds' if self.passed else 'OUT OF BOUNDS'}"]
        lines += [f"  {name:<52} {shown(value)}" for name, value in self.figures.items()]
        return "\n".join(lines + [f"  ! {fault}" for fault in self.faults])


def shown(value: object) -> str:
    """A figure as text: whole numbers grouped, others to four digits."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
