"""`acquire simulate paper`: every table of the paper, theirs beside ours."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from service.errors import BadInput, Fault
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import Identifier
from studies.paper_1994.document import document
from studies.paper_1994.experiments import run_experiments
from studies.paper_1994.plots import draw
from studies.paper_1994.printed import the_paper
from studies.paper_1994.report import (
    PAPER_IDENTIFIER,
    PROPORTIONS,
    TIMES,
    measured,
    report,
)
from studies.paper_1994.tables import TITLES
from studies.paper_1994.tally import AMBIGUOUS, CORRECT, MISIDENTIFIED, UNMATCHED, Tally
from studies.paper_1994.time_tables import Row

ZONE_IDENTIFIERS: tuple[Identifier, ...] = tuple(
    name for name, entry in IDENTIFIERS.items() if entry.searches_zone
)
"""The identifiers that search a zone, as the paper's does."""
DEFAULT_STARS = 20_000


def run_paper(
    table: int | None = None,
    stars: int = DEFAULT_STARS,
    seeds: Sequence[int] = (1,),
    json_path: Path | None = None,
    identifiers: Sequence[Identifier] = ZONE_IDENTIFIERS,
    processes: int | None = None,
    plots: Path | None = None,
    report_path: Path | None = None,
    out: TextIO | None = None,
) -> list[Row]:
    """Print one table, or all, with the paper's numbers and ours, and return the rows.

    Each run sees at least `stars` stars for each seed, in whole experiments of
    the paper's size; several seeds are pooled.  Tables 11 to 14 use the
    first seed.  `json_path` takes the rows: one per run and identifier, and those of
    Tables 11 to 14; the folder `plots` the pictures, `report_path` the
    document that shows them with every table, instead of printing the tables.
    Raises `BadInput` for a table that the paper has not.
    """
    wanted = _checked(table, stars, seeds, identifiers)
    out = out or sys.stdout
    runs = the_paper().runs_of(wanted)
    tallies = run_experiments(runs, stars, seeds, identifiers, processes) if runs else []
    # A zone holds the same stars for every identifier.
    asked = {
        name: [n for n in wanted if n not in PROPORTIONS or name == identifiers[0]]
        for name in identifiers
    }
    # The page shows the times of the paper's own identifier alone.
    timed = [PAPER_IDENTIFIER] if report_path is not None else identifiers
    times = {name: measured(asked[name], seeds[0], name) for name in timed if name in identifiers}
    rows = rows_of(tallies) + [row for of_one in times.values() for row in of_one]
    if json_path is not None:
        write_json(rows, json_path)
    if plots is not None:
        draw([tally for tally in tallies if tally.identifier == PAPER_IDENTIFIER], plots)
    if report_path is not None:
        time_rows = times.get(PAPER_IDENTIFIER, [])
        text = document(tallies, seeds, time_rows, plots or report_path.parent, report_path)
        report_path.write_text(text, encoding="utf-8")
        print(report_path, file=out)
        return rows
    for name in identifiers:
        if asked[name]:
            print(report(tallies, name, asked[name], times[name]), file=out)
    return rows


def _checked(
    table: int | None, stars: int, seeds: Sequence[int], identifiers: Sequence[Identifier]
) -> Sequence[int]:
    faults = []
    if table is not None and table not in TITLES:
        faults.append(Fault("table", "must be from 2 to 14", str(table)))
    if stars < 1:
        faults.append(Fault("stars", "must be at least 1", str(stars)))
    if table in (*TIMES, *PROPORTIONS) and len(seeds) > 1:
        faults.append(Fault("seed", f"is one with table {table}", str(list(seeds))))
    faults += [Fault("seed", "must not be negative", str(seed)) for seed in seeds if seed < 0]
    faults += [
        Fault("identifier", f"must be one of {', '.join(ZONE_IDENTIFIERS)}", name)
        for name in identifiers
        if name not in ZONE_IDENTIFIERS
    ]
    if faults:
        raise BadInput(faults)
    return list(TITLES) if table is None else [table]


def rows_of(tallies: Sequence[Tally]) -> list[Row]:
    """One row per run and identifier, Tables 2 to 10."""
    return [
        {
            "table": tally.run.table,
            "run": tally.run.run,
            "identifier": tally.identifier,
            "stars": tally.stars,
            "ambiguous": tally.total(AMBIGUOUS),
            "unmatched": tally.total(UNMATCHED),
            "correct": tally.total(CORRECT),
            "misidentified": tally.total(MISIDENTIFIED),
        }
        for tally in tallies
    ]


def write_json(rows: Sequence[Row], path: Path) -> None:
    """Write rows as a JSON array, one a line."""
    lines = ",\n".join(json.dumps(row, ensure_ascii=False) for row in rows)
    path.write_text(f"[\n{lines}\n]\n" if lines else "[]\n", encoding="utf-8")
