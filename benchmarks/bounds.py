"""Bounds: a measured figure, what was asked of it, and whether it holds.

Every figure that a section of docs/verification.md or docs/performance.md claims
has one; the page shows them as a table.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

UNLIKELY = 1e-4
"""A count is out of bounds where chance alone gives one as far off less often than this."""


@dataclass(frozen=True)
class Bound:
    """A measured figure and what was asked of it, both as they are shown."""

    figure: str
    measured: str
    asked: str
    holds: bool

    @property
    def fault(self) -> str:
        """The figure as the fault that it is where it does not hold."""
        return f"{self.figure}: {self.measured}, asked for is {self.asked}"

    def as_json(self) -> dict[str, object]:
        """The bound for a file of results."""
        return asdict(self)


def shown(value: object) -> str:
    """A figure as text: whole numbers grouped, others to four digits."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def faults_of(bounds: Iterable[Bound]) -> list[str]:
    """The bounds that do not hold, in words."""
    return [each.fault for each in bounds if not each.holds]


def at_most(figure: str, value: float, most: float, unit: str = "") -> Bound:
    """A figure that may not exceed a bound."""
    return Bound(figure, _with(value, unit), f"at most {_with(most, unit)}", value <= most)


def at_least(figure: str, value: float, least: float, unit: str = "") -> Bound:
    """A figure that may not be less than a bound."""
    return Bound(figure, _with(value, unit), f"at least {_with(least, unit)}", value >= least)


def between(figure: str, value: float, least: float, most: float, unit: str = "") -> Bound:
    """A figure that lies between two bounds."""
    asked = f"{shown(least)} to {_with(most, unit)}"
    return Bound(figure, _with(value, unit), asked, least <= value <= most)


def equal(figure: str, value: int, expected: int) -> Bound:
    """A count that is exactly what was expected."""
    return Bound(figure, f"{value:,}", f"{expected:,}", value == expected)


def share_as_expected(figure: str, hits: int, of: int, expected: float) -> Bound:
    """A count out of so many, neither more nor fewer than a probability explains.

    The bounds are the two-sided binomial ones at `UNLIKELY`.
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
    """The mean of independent values within four standard errors of what was expected.

    `variance` is that which one value should have.
    """
    slack = 4.0 * (variance / len(values)) ** 0.5
    mean = sum(values) / len(values)
    low, high = expected - slack, expected + slack
    return Bound(figure, shown(mean), f"{low:.3f} to {high:.3f}", low <= mean <= high)


def every(figure: str, bounds: Sequence[Bound]) -> list[Bound]:
    """How many cases of one kind keep their bounds, and then each one that does not."""
    held = sum(each.holds for each in bounds)
    whole = Bound(figure, f"{held:,} of {len(bounds):,}", "all", 0 < held == len(bounds))
    return [whole, *(each for each in bounds if not each.holds)]


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %"


def _with(value: float, unit: str) -> str:
    return f"{shown(value)} {unit}".rstrip()
