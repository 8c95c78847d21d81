"""Command `acquire simulate paper`: all tables of the paper compared with our results."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from service.errors import BadInput, Fault
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import Identifier
from studies.documents import json_rows, links
from studies.paper_1994 import tables
from studies.paper_1994.experiments import run_experiments
from studies.paper_1994.plots import PICTURES, PLACES, draw
from studies.paper_1994.printed import the_paper
from studies.paper_1994.tables import Row, measure
from studies.paper_1994.tally import AMBIGUOUS, CORRECT, MISIDENTIFIED, UNMATCHED, Tally

ZONE_IDENTIFIERS: tuple[Identifier, ...] = tuple(
    name for name, entry in IDENTIFIERS.items() if entry.searches_zone
)
"""Identifiers that search within a zone, like the paper's."""
DEFAULT_STARS = 20_000

PAPER_IDENTIFIER: Identifier = "starid"
TIMES, PROPORTIONS = (11, 12), (13, 14)


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

    Each run has at least `stars` stars for each seed, in whole experiments of the paper's size;
    several seeds are pooled.  Tables 11 to 14 use the first seed.  `json_path` receives the rows:
    one per run and identifier, and those of Tables 11 to 14; the folder `plots` the pictures, and
    `report_path` a document with them and every table, instead of printing.  Raises `BadInput` for
    a table that the paper does not have.
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
        json_path.write_text(json_rows(rows), encoding="utf-8")
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
    if table is not None and table not in tables.TITLES:
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
    return list(tables.TITLES) if table is None else [table]


def rows_of(tallies: Sequence[Tally]) -> list[Row]:
    """Rows of results of Tables 2 to 10, one per run and identifier."""
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


def measured(wanted: Sequence[int], seed: int, identifier: Identifier) -> list[Row]:
    """Measure the rows of Tables 11 to 14 on this computer; 13 and 14 have no times."""
    rows: list[Row] = []
    for number, shares in zip(TIMES, PROPORTIONS, strict=True):
        if not {number, shares} & set(wanted):
            continue
        # Tables 13 and 14 use the zones of 11 and 12, measured once for both.
        cases = [each for each in the_paper().times if each.table == str(number)]
        zones = [(case, measure(case, seed, identifier)) for case in cases]
        if number in wanted:
            rows += [tables.time_row(*each, identifier) for each in zones]
        if shares in wanted:
            rows += [row for each in zones for row in tables.proportion_rows(shares, *each)]
    return rows


def report(
    tallies: Sequence[Tally],
    identifier: Identifier,
    wanted: Sequence[int],
    time_rows: Sequence[Row] = (),
) -> str:
    """Tables of one identifier as Markdown; `time_rows` are the result of `measured`."""
    mine = [tally for tally in tallies if tally.identifier == identifier]
    parts = [f"## Tables of Fink & Shoup 1994 by the identifier `{identifier}`"]
    is_paper = identifier == PAPER_IDENTIFIER
    if mine and is_paper:
        parts.append(
            "Not identified: ambiguous or unmatched. A printed run is inside when distance² "
            "<= 5.99. `!`: other than the reference."
        )
    for number in wanted:
        chosen = [tally for tally in mine if tally.run.number == number]
        if chosen:
            shown = tables.rates(chosen) if is_paper else tables.improvements(chosen)
            parts += [tables.heading(number), shown]
    if mine:
        parts.append(tables.summary(mine) if is_paper else tables.improvement_summary(mine))
    for number in wanted:
        rows = [row for row in time_rows if row["table"] == number]
        if rows and number in TIMES:
            limit = f"{tables.limit(rows)} {tables.ABOUT_TIMES}"
            parts += [tables.heading(number), tables.times(rows), limit]
        elif rows:
            note = "`!`: the zone holds more pairs than the approximation bounds."
            parts += [tables.heading(number), tables.proportions(rows), note]
    return "\n\n".join(parts) + "\n"


_RATE_TABLES = range(2, 11)

_INTRODUCTION = """\
The simulator of the paper, made anew, sends its views through the same code as any batch: a view
is a batch whose a priori attitude has its boresight (cap) or its pole (band) on the zone's axis.
Every run of a table sees the same zones, stars and draws, as in the paper; only the errors differ.
`acquire simulate paper --identifier starid --plots docs/plots --report docs/paper.md` makes this
page again, with `--seed` and `--stars` of your choice; with `--table N` it prints the rows of a
table. [verification.md](verification.md#the-runs-of-the-paper) has the worst rates of each table.

How the paper was read, where it leaves a choice:

- the position error is one Gaussian radius in a random direction, not two Gaussian axes;
- the attitude error turns phi about Z first, theta about Y, psi about X last, in body axes; in a
  cap body X is the tracker's boresight, in a band it is the pole and Z the boresight;
- where the magnitudes of a pair do not tell its order, no magnitude is compared at all;
- where the angles to the pole tell the order, no cross product follows;
- where both orders of a pair pass the cross product, which needs a CAPMAX or BANMAX above 90 deg,
  a vote is cast for each pairing;
- a magnitude error beyond RCMAG is drawn again, not cut to it;
- SEPTOL is applied at the search, in an index of exact separations; the prototype also had it in
  its hashing tables, whose "invalid indexing" is not repeated;
- the prototype computes in REAL*4, the service in double precision but for the differences of the
  angles to the pole (single, widened for its rounding), without a visible effect;
- the views come of numpy's PCG64 generator, not of the paper's linear congruential one;
- Table 8: 24 zones an experiment, about the Sun at seven dates by turns, not six fixed bands in
  four runs;
- one vote is enough; the paper's "ambiguous" counts stars without any vote;
- the prototype read "all stars down to" a magnitude: of a double only components that bright are
  merged. The service lets fainter ones add their light, as a tracker sees it (of a double star of
  V 8.2 and 8.4 the light of V 7.5), and applies the magnitude limit after that.

Misprints taken as such: the angles of Table 2 that are not varied are 40, 40 and 60 arcsec, not
degrees; in Table 9 the desert at 12 arcsec has 1820 stars right, not 1803; runs 3 and 4 of Table 7
do not add up to 495 stars and are compared by their ambiguous and misidentified stars.

A printed run is *inside* when its counts of stars not identified and misidentified lie in the 95 %
region of experiments of the paper's size, drawn from our rates. The *reference* is an independent
implementation of the same reading, 40 such experiments a run. The runs of a table share their
stars, so that they fall inside or outside together.
"""

_OUTSIDE = """\
The printed counts are one draw, so that about 1 run in 20 is expected outside even if everything
were the same. The run catalogs of 1994 are not at hand, and ours differ from them by some percent
of the stars and pairs ([The sky](verification.md#the-sky)). The reference is outside as well for
Table 3 (4, 4, 90), Table 9 (desert phi 100°, forest 12 arcsec) and Table 10 (desert nominal, forest
magnitude .3). Of the rates a few differ from the reference's by more than three standard errors; no
cause other than chance was found. The lines *Outside* and *Other than the reference* above name the
runs.
"""


def document(
    tallies: Sequence[Tally],
    seeds: Sequence[int],
    time_rows: Sequence[Row],
    plots: Path,
    file: Path,
) -> str:
    """Markdown document: interpretation of the paper, pictures of Tables 2 to 10, and differences.

    The pictures are those of `plots.draw` in the folder `plots`, linked relative to the document
    `file`.  `time_rows` are those of Tables 11 to 14.  Tables 2 to 10 of further identifiers
    follow.
    """
    mine = [tally for tally in tallies if tally.identifier == PAPER_IDENTIFIER]
    if not mine:
        return _beyond(tallies, seeds)
    # The page has neither the report's own heading nor the note on its tables.
    whole = report(mine, PAPER_IDENTIFIER, [])
    without_heading = whole.split("\n\n", 2)[2]
    shown = [
        link
        for name in (*PICTURES, PLACES)
        for link in links("Rates against errors", plots / f"{name}.svg", file)
    ]
    written = (
        "For astronomers who know the paper: how it was read, and its rates beside ours.\n"
        f"Seeds {', '.join(map(str, seeds))}, {len(mine)} runs, from {_least(mine):,} stars each."
    )
    parts = ["# The tables of Fink & Shoup 1994", written, _INTRODUCTION, *shown, without_heading]
    for number in TIMES:
        rows = [row for row in time_rows if row["table"] == number]
        parts += [f"Table {number}. {tables.limit(rows)}"] if rows else []
    if mine:
        parts.append(_OUTSIDE)
    parts += [report(tallies, name, _RATE_TABLES) for name in _others(tallies)]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _beyond(tallies: Sequence[Tally], seeds: Sequence[int]) -> str:
    """Markdown page of identifiers that the paper does not have."""
    names = _others(tallies)
    command = f"acquire simulate paper --identifier {' '.join(names)}"
    parts = [
        "# The runs of Fink & Shoup 1994, verified",
        (
            f"Seeds {', '.join(map(str, seeds))}, from {_least(tallies):,} stars a run: the views "
            "that [paper.md](paper.md) shows for the votes, and what the paper printed for them. "
            f"`{command} --report FILE` makes this page."
        ),
        *(report(tallies, name, _RATE_TABLES) for name in names),
    ]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _others(tallies: Sequence[Tally]) -> list[Identifier]:
    names = dict.fromkeys(tally.identifier for tally in tallies)
    return [name for name in names if name != PAPER_IDENTIFIER]


def _least(tallies: Sequence[Tally]) -> int:
    return min((tally.stars for tally in tallies), default=0)
