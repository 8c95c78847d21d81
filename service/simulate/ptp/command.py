"""`acquire simulate paper --table ptp-5` and its like: Zhou & Ye 2015 beside ours."""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault
from service.simulate.ptp import claims, tables
from service.simulate.ptp.comparison import (
    COMPARED,
    OF_THE_PAPER,
    Case,
    Database,
    compare,
    databases,
    stars_in_fields,
)
from service.simulate.ptp.plots import Drawn, draw
from service.simulate.ptp.printed import the_ptp_paper
from service.simulate.ptp.tally import Tally

DEFAULT_SCENES = 10_000
SLAVES = ("PTP, 3 slaves", "PTP", "PTP, 5 slaves", "PTP, 6 slaves")
TITLES: Mapping[str, str] = {
    "ptp-5": "Table 5. The number of slave stars, no noise",
    "ptp-6": "Table 6. The algorithms compared, 1 px and 0.5 mag of noise",
    "figure-10": "Figure 10. Stars in the field of view",
    "figure-11": "Figure 11. Rate against the stars in the field, 0.5 px",
    "figure-12": "Figure 12. Rate against the noise of position",
    "figure-13": "Figure 13. Rate against the noise of magnitude, stars lost and added",
}
ALL = "ptp"
"""Names every table and figure together."""

CASES: Mapping[str, Sequence[Case]] = {
    "ptp-5": [Case("ptp-5", SLAVES, 0.0)],
    "ptp-6": [Case("ptp-6", COMPARED, 1.0, 0.5, adds=adds) for adds in (False, True)],
    "figure-10": [],
    "figure-11": [Case("figure-11", COMPARED, 0.5, fewest=3)],
    "figure-12": [Case("figure-12", COMPARED, px) for px in (0.0, 0.5, 1.0, 1.5, 2.0)],
    "figure-13": [
        Case("figure-13", OF_THE_PAPER, 0.0, mag) for mag in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    ],
}


@dataclass(frozen=True)
class Found:
    """What was measured: tallies by table, the counts of Figure 10, the databases."""

    scenes: int
    seed: int
    tallies: Mapping[str, Sequence[Tally]]
    stars: npt.NDArray[np.int64] | None = None
    databases: Sequence[Database] = field(default_factory=tuple)

    @property
    def drawn(self) -> Drawn:
        """The figures, for the plots."""
        figures: Drawn = {} if self.stars is None else {"figure-10": self.stars}
        return figures | {name: tallies for name, tallies in self.tallies.items() if tallies}


def run_ptp(
    table: str = ALL,
    scenes: int = DEFAULT_SCENES,
    seed: int = 1,
    json_path: Path | None = None,
    processes: int | None = None,
    plots: Path | None = None,
    report_path: Path | None = None,
    out: TextIO | None = None,
) -> Found:
    """Print one table or figure of the PTP paper, or all (`ptp`), its numbers beside ours.

    `scenes` fields are drawn for each condition.  `json_path` takes one row per
    condition and algorithm, the folder `plots` the pictures, `report_path` the
    document, instead of printing.  Raises `BadInput` for a table there is not.
    """
    wanted = _checked(table, scenes, seed)
    out = out or sys.stdout
    found = measured(wanted, scenes, seed, processes)
    if json_path is not None:
        write_json(found, json_path)
    if plots is not None:
        draw(found.drawn, plots)
    if report_path is not None:
        from service.simulate.ptp.document import document

        report_path.write_text(document(found, plots or report_path.parent, report_path), "utf-8")
        print(report_path, file=out)
    else:
        print("\n\n".join(section(found, name) for name in wanted), file=out)
    return found


def _checked(table: str, scenes: int, seed: int) -> Sequence[str]:
    faults = []
    if table != ALL and table not in TITLES:
        faults.append(Fault("table", f"must be one of {', '.join((ALL, *TITLES))}", table))
    if scenes < 1:
        faults.append(Fault("scenes", "must be at least 1", str(scenes)))
    if seed < 0:
        faults.append(Fault("seed", "must not be negative", str(seed)))
    if faults:
        raise BadInput(faults)
    return list(TITLES) if table == ALL else [table]


def measured(wanted: Sequence[str], scenes: int, seed: int, processes: int | None = None) -> Found:
    """Everything that some tables and figures show."""
    cases = [case for name in wanted for case in CASES[name]]
    tallies = compare(cases, scenes, seed, processes) if cases else []
    names = dict.fromkeys(t.algorithm for t in tallies if t.case.name.startswith("ptp-"))
    return Found(
        scenes,
        seed,
        {name: [tally for tally in tallies if tally.case.name == name] for name in wanted},
        stars_in_fields(scenes, seed) if "figure-10" in wanted else None,
        databases(list(names)),
    )


def section(found: Found, name: str) -> str:
    """A table or figure with its heading, and what the paper claims of it that cannot be."""
    tallies, paper = found.tallies[name], the_ptp_paper()
    if name == "ptp-5":
        shown = tables.table_5(tallies, found.databases)
    elif name == "ptp-6":
        shown = tables.table_6(tallies, found.databases)
    elif name == "figure-10":
        assert found.stars is not None
        shown = tables.figure_10(found.stars)
    elif name == "figure-11":
        shown = tables.figure_11(tallies)
    elif name == "figure-12":
        shown = tables.line_table(tallies, "position_px", "px", paper.figure_12)
    else:
        shown = tables.line_table(tallies, "magnitude_sigma_mag", "mag", paper.figure_13)
    note = claims.NOT_REPRODUCED.get(name)
    parts = [f"### {TITLES[name]}", shown, *([note] if note else [])]
    return "\n\n".join(parts)


def rows_of(found: Found) -> list[dict[str, Any]]:
    """One row per condition and algorithm, and one of Figure 10."""
    rows = [tally.row() for tallies in found.tallies.values() for tally in tallies]
    if found.stars is not None:
        rows.append(
            {
                "table": "figure-10",
                "scenes": len(found.stars),
                "mean": float(found.stars.mean()),
                "least": int(found.stars.min()),
                "most": int(found.stars.max()),
                "more_than_8": int((found.stars > 8).sum()),
            }
        )
    return rows


def write_json(found: Found, path: Path) -> None:
    """Write the rows as a JSON array, one a line."""
    lines = ",\n".join(json.dumps(row, ensure_ascii=False) for row in rows_of(found))
    path.write_text(f"[\n{lines}\n]\n" if lines else "[]\n", encoding="utf-8")
