"""Bounds: a measured figure, the value required of it, and the verdict.

Every figure that a section of docs/verification.md or docs/performance.md claims has a bound; the
page shows the bounds as a table.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

UNLIKELY = 1e-4
"""Probability of a deviation by chance below which a count is out of bounds."""


@dataclass(frozen=True)
class Bound:
    """Measured figure with its requirement, both as they are shown."""

    figure: str
    measured: str
    asked: str
    holds: bool

    @property
    def fault(self) -> str:
        """Text of a fault: the figure with its measured value and the requirement."""
        return f"{self.figure}: {self.measured}, asked for is {self.asked}"

    def as_json(self) -> dict[str, object]:
        """Bound as JSON for a file of results."""
        return asdict(self)


def shown(value: object) -> str:
    """Text of a figure: whole numbers grouped, others to four digits."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def faults_of(bounds: Iterable[Bound]) -> list[str]:
    """Texts of the bounds that do not hold."""
    return [each.fault for each in bounds if not each.holds]


def at_most(figure: str, value: float, most: float, unit: str = "") -> Bound:
    """Bound of a figure with an upper limit."""
    return Bound(figure, _with(value, unit), f"at most {_with(most, unit)}", value <= most)


def at_least(figure: str, value: float, least: float, unit: str = "") -> Bound:
    """Bound of a figure with a lower limit."""
    return Bound(figure, _with(value, unit), f"at least {_with(least, unit)}", value >= least)


def between(figure: str, value: float, least: float, most: float, unit: str = "") -> Bound:
    """Bound of a figure with a lower and an upper limit."""
    asked = f"{shown(least)} to {_with(most, unit)}"
    return Bound(figure, _with(value, unit), asked, least <= value <= most)


def equal(figure: str, value: int, expected: int) -> Bound:
    """Bound of a count that must equal an expected one."""
    return Bound(figure, f"{value:,}", f"{expected:,}", value == expected)


def share_as_expected(figure: str, hits: int, of: int, expected: float) -> Bound:
    """Bound of a count of hits that must agree with a probability.

    The limits are the two-sided binomial ones at `UNLIKELY`.
    """
    from scipy.stats import binom

    least = int(binom.ppf(UNLIKELY / 2.0, of, expected))
    most = int(binom.isf(UNLIKELY / 2.0, of, expected))
    return Bound(
        figure,
        f"{hits:,} of {of:,}, {_percent(hits / of if of else 0.0)}",
        f"{_percent(expected)}: {least:,} to {most:,}",
        least <= hits <= most,
    )


def mean_as_expected(
    figure: str, values: Sequence[float], expected: float, variance: float
) -> Bound:
    """Bound of the mean of independent values: within four standard errors of the expected one.

    `variance` is the expected variance of a single value.
    """
    slack = 4.0 * (variance / len(values)) ** 0.5
    mean = sum(values) / len(values)
    low, high = expected - slack, expected + slack
    return Bound(figure, shown(mean), f"{low:.3f} to {high:.3f}", low <= mean <= high)


def every(figure: str, bounds: Sequence[Bound]) -> list[Bound]:
    """Count of the cases of one kind that keep their bounds, followed by each broken bound."""
    held = sum(each.holds for each in bounds)
    whole = Bound(figure, f"{held:,} of {len(bounds):,}", "all", 0 < held == len(bounds))
    return [whole, *(each for each in bounds if not each.holds)]


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %"


def _with(value: float, unit: str) -> str:
    return f"{shown(value)} {unit}".rstrip()
