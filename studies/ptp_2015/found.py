"""Everything that some tables and figures show, as it was measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from studies.ptp_2015.comparison import Database
from studies.ptp_2015.plots import PlottedSeries
from studies.ptp_2015.projections import Projections
from studies.ptp_2015.tally import Tally


@dataclass(frozen=True)
class Measurements:
    """What was measured: tallies by table, the counts of Figure 10, the databases."""

    scenes: int
    seed: int
    tallies: Mapping[str, Sequence[Tally]]
    stars: npt.NDArray[np.int64] | None = None
    databases: Sequence[Database] = field(default_factory=tuple)
    false_fields: Sequence[Mapping[str, str | int]] = ()
    projections: Projections | None = None
    """Of the sky's triangles, for Table 2 and Figures 6 and 7."""

    @property
    def drawn(self) -> PlottedSeries:
        """The figures, for the plots."""
        figures: PlottedSeries = {} if self.stars is None else {"figure-10": self.stars}
        if self.projections is not None:
            wanted = [name for name in self.tallies if name.startswith("figure")]
            figures |= {
                name: self.projections for name in wanted if name in ("figure-6", "figure-7")
            }
        return figures | {name: tallies for name, tallies in self.tallies.items() if tallies}
