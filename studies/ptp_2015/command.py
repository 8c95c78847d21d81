"""`acquire simulate paper --table ptp-5` and its like: Zhou & Ye 2015 beside ours."""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from service.errors import BadInput, Fault
from studies.ptp_2015.case import Case
from studies.ptp_2015.comparison import (
    COMPARED,
    OF_THE_PAPER,
    all_projections,
    compare,
    databases,
    false_fields,
    stars_in_fields,
)
from studies.ptp_2015.document import document
from studies.ptp_2015.found import Measurements
from studies.ptp_2015.plots import draw
from studies.ptp_2015.tables import OF_PROJECTIONS, TITLES, section

DEFAULT_SCENES = 10_000
SLAVES = ("PTP, 3 slaves", "PTP", "PTP, 5 slaves", "PTP, 6 slaves")
ALL = "ptp"
"""Names every table and figure together."""

CASES: Mapping[str, Sequence[Case]] = {
    "ptp-1": [],
    "ptp-2": [],
    "ptp-3": [],
    "figure-6": [],
    "figure-7": [],
    "ptp-5": [Case("ptp-5", SLAVES, 0.0)],
    "ptp-6": [Case("ptp-6", COMPARED, 1.0, 0.5, adds=adds) for adds in (False, True)],
    "figure-10": [],
    "figure-11": [Case("figure-11", COMPARED, 0.5, fewest=3)],
    "figure-12": [Case("figure-12", COMPARED, px) for px in (0.0, 0.5, 1.0, 1.5, 2.0)],
    "figure-13": [
        Case("figure-13", OF_THE_PAPER, 0.0, mag) for mag in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    ],
    "ptp-false": [],
}


def run_ptp(
    table: str = ALL,
    scenes: int = DEFAULT_SCENES,
    seed: int = 1,
    json_path: Path | None = None,
    processes: int | None = None,
    plots: Path | None = None,
    report_path: Path | None = None,
    out: TextIO | None = None,
) -> Measurements:
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


def measured(
    wanted: Sequence[str], scenes: int, seed: int, processes: int | None = None
) -> Measurements:
    """Everything that some tables and figures show."""
    cases = [case for name in wanted for case in CASES[name]]
    tallies = compare(cases, scenes, seed, processes) if cases else []
    names = dict.fromkeys(t.algorithm for t in tallies if t.case.name.startswith("ptp-"))
    return Measurements(
        scenes,
        seed,
        {name: [tally for tally in tallies if tally.case.name == name] for name in wanted},
        stars_in_fields(scenes, seed) if "figure-10" in wanted else None,
        databases(list(names)),
        false_fields(scenes, seed) if "ptp-false" in wanted else (),
        all_projections() if any(name in OF_PROJECTIONS for name in wanted) else None,
    )


def rows_of(found: Measurements) -> list[dict[str, Any]]:
    """One row per condition and algorithm, and those of the tables of projections."""
    rows: list[dict[str, Any]] = [
        tally.row() for tallies in found.tallies.values() for tally in tallies
    ]
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
    rows += map(dict, found.false_fields)
    if found.projections is not None:
        for name in OF_PROJECTIONS:
            rows += found.projections.rows(name) if name in found.tallies else []
    return rows


def write_json(found: Measurements, path: Path) -> None:
    """Write the rows as a JSON array, one a line."""
    lines = ",\n".join(json.dumps(row, ensure_ascii=False) for row in rows_of(found))
    path.write_text(f"[\n{lines}\n]\n" if lines else "[]\n", encoding="utf-8")
