"""Everything that some tables and figures show, as it was measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from service.studies.ptp_2015.comparison import Database
from service.studies.ptp_2015.plots import PlottedSeries
from service.studies.ptp_2015.tally import Tally


@dataclass(frozen=True)
class Measurements:
    """What was measured: tallies by table, the counts of Figure 10, the databases."""

    scenes: int
    seed: int
    tallies: Mapping[str, Sequence[Tally]]
    stars: npt.NDArray[np.int64] | None = None
    databases: Sequence[Database] = field(default_factory=tuple)

    @property
    def drawn(self) -> PlottedSeries:
        """The figures, for the plots."""
        figures: PlottedSeries = {} if self.stars is None else {"figure-10": self.stars}
        return figures | {name: tallies for name, tallies in self.tallies.items() if tallies}
