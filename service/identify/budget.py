"""The limit on the work for one batch, counted instead of timed so that answers are reproducible.

One unit is the cost of one candidate pair of stars in the search for hypotheses, about 70
nanoseconds.
"""

MAX_WORK = 20_000_000
"""Units of work allowed for one batch with all its trackers and searches: about a second.

Batches of a few stars take some thousands, 250 real stars of one tracker 13 million. Hundreds of
false points with errors of arc minutes would take far more.
"""
COMPARISONS_PER_UNIT = 7
"""Number of comparisons of an observed pair with a candidate pair that cost a unit of work."""
NODES_PER_UNIT = 14
"""Number of nodes of the search for match groups that cost one unit of work."""


class WorkBudget:
    """A counter of the units of work left for a batch, or for a part of it."""

    def __init__(self, units: int = MAX_WORK, whole: "WorkBudget | None" = None) -> None:
        self.left = units
        self.was_hit = False
        """True once the budget, or any part of it, was used up."""
        self._whole = whole

    def share(self, part: int, of: int) -> "WorkBudget":
        """A budget with a share of the units left; what it spends also counts in the whole."""
        return WorkBudget(self.left * part // of, self)

    def spend(self, units: int) -> None:
        """Subtract used units of work; the remainder is never negative."""
        self.left = max(0, self.left - units)
        self.was_hit |= self.left == 0
        if self._whole is not None:
            self._whole.spend(units)
            self._whole.was_hit |= self.was_hit
