"""Tables 2 to 14 together, as one identifier fills them."""

from collections.abc import Sequence

from service.missions.mission import Identifier
from studies.paper_1994 import tables, time_tables
from studies.paper_1994.printed import the_paper
from studies.paper_1994.tally import Tally
from studies.paper_1994.time_tables import Row, measure

PAPER_IDENTIFIER: Identifier = "starid"
TIMES, PROPORTIONS = (11, 12), (13, 14)


def measured(wanted: Sequence[int], seed: int, identifier: Identifier) -> list[Row]:
    """The rows of Tables 11 to 14, measured here and now; those of 13 and 14 without times."""
    rows: list[Row] = []
    for number, shares in zip(TIMES, PROPORTIONS, strict=True):
        if not {number, shares} & set(wanted):
            continue
        # Tables 13 and 14 are of the zones of 11 and 12, measured once for both.
        cases = [each for each in the_paper().times if each.table == str(number)]
        zones = [(case, measure(case, seed, identifier)) for case in cases]
        if number in wanted:
            rows += [time_tables.time_row(*each, identifier) for each in zones]
        if shares in wanted:
            rows += [row for each in zones for row in time_tables.proportion_rows(shares, *each)]
    return rows


def report(
    tallies: Sequence[Tally],
    identifier: Identifier,
    wanted: Sequence[int],
    time_rows: Sequence[Row] = (),
) -> str:
    """The tables of one identifier as Markdown; `time_rows` are those of `measured`."""
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
            parts += [tables.heading(number), time_tables.times(rows), time_tables.limit(rows)]
        elif rows:
            note = "`!`: the zone holds more pairs than the approximation bounds."
            parts += [tables.heading(number), time_tables.proportions(rows), note]
    return "\n\n".join(parts) + "\n"
