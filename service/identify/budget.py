"""The work that one batch may cause: counted, so that no answer depends on the clock.

One unit is what a candidate pair of stars costs that the search for hypotheses looks at,
about 70 nanoseconds.
"""

MAX_WORK = 20_000_000
"""Units for one batch, all its trackers and every search together: about a second.

Batches of a few stars take some thousands, 250 real stars of one tracker 13 million.
Hundreds of points with errors of minutes of arc that are no stars would take far more.
"""
COMPARISONS_PER_UNIT = 7
"""Comparisons of one observed pair with one candidate pair that cost one unit of work."""
NODES_PER_UNIT = 14
"""Nodes of the search for match groups that cost one unit of work."""


class WorkBudget:
    """The units of work that are left to a batch, or to a part of it."""

    def __init__(self, units: int = MAX_WORK, whole: "WorkBudget | None" = None) -> None:
        self.left = units
        self.was_hit = False
        """True once any part of the budget was used up."""
        self._whole = whole

    def share(self, part: int, of: int) -> "WorkBudget":
        """A part of what is left; what is spent of it is spent of the whole."""
        return WorkBudget(self.left * part // of, self)

    def spend(self, units: int) -> None:
        """Take away what was used; nothing is left where that was more."""
        self.left = max(0, self.left - units)
        self.was_hit |= self.left == 0
        if self._whole is not None:
            self._whole.spend(units)
            self._whole.was_hit |= self.was_hit
