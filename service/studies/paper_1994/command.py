"""`acquire simulate paper`: every table of the paper, theirs beside ours."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

from service.errors import BadInput, Fault
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import Identifier
from service.studies.paper_1994.document import document
from service.studies.paper_1994.experiments import run_experiments
from service.studies.paper_1994.plots import draw
from service.studies.paper_1994.printed import the_paper
from service.studies.paper_1994.report import PAPER_IDENTIFIER, PROPORTIONS, report
from service.studies.paper_1994.tables import TITLES
from service.studies.paper_1994.tally import AMBIGUOUS, CORRECT, MISIDENTIFIED, UNMATCHED, Tally

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
) -> list[Tally]:
    """Print one table, or all, with the paper's numbers and ours; the tallies of Tables 2 to 10.

    Each run sees at least `stars` stars for each seed, in whole experiments of
    the paper's size; several seeds are pooled.  `json_path` takes one row per
    run and identifier, the folder `plots` the pictures, `report_path` the
    document that shows them with every table, instead of printing the tables.
    Raises `BadInput` for a table that the paper has not.
    """
    wanted = _checked(table, stars, seeds, identifiers)
    out = out or sys.stdout
    runs = the_paper().runs_of(wanted)
    tallies = run_experiments(runs, stars, seeds, identifiers, processes) if runs else []
    if json_path is not None:
        write_json(tallies, json_path)
    if plots is not None:
        draw([tally for tally in tallies if tally.identifier == PAPER_IDENTIFIER], plots)
    if report_path is not None:
        text = document(tallies, seeds, plots or report_path.parent, report_path)
        report_path.write_text(text, encoding="utf-8")
        print(report_path, file=out)
        return tallies
    for identifier in identifiers:
        # A zone holds the same stars for every identifier.
        asked = [n for n in wanted if n not in PROPORTIONS or identifier == identifiers[0]]
        if asked:
            print(report(tallies, identifier, asked, seeds[0]), file=out)
    return tallies


def _checked(
    table: int | None, stars: int, seeds: Sequence[int], identifiers: Sequence[Identifier]
) -> Sequence[int]:
    faults = []
    if table is not None and table not in TITLES:
        faults.append(Fault("table", "must be from 2 to 14", str(table)))
    if stars < 1:
        faults.append(Fault("stars", "must be at least 1", str(stars)))
    faults += [Fault("seed", "must not be negative", str(seed)) for seed in seeds if seed < 0]
    faults += [
        Fault("identifier", f"must be one of {', '.join(ZONE_IDENTIFIERS)}", name)
        for name in identifiers
        if name not in ZONE_IDENTIFIERS
    ]
    if faults:
        raise BadInput(faults)
    return list(TITLES) if table is None else [table]


def rows_of(tallies: Sequence[Tally]) -> list[dict[str, Any]]:
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


def write_json(tallies: Sequence[Tally], path: Path) -> None:
    """Write the rows as a JSON array, one a line."""
    lines = ",\n".join(json.dumps(row, ensure_ascii=False) for row in rows_of(tallies))
    path.write_text(f"[\n{lines}\n]\n" if lines else "[]\n", encoding="utf-8")
