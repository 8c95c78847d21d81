"""Tables 2 to 14 together, as one identifier fills them."""

from collections.abc import Sequence

from service.missions.mission import Identifier
from service.studies.paper_1994 import tables, time_tables
from service.studies.paper_1994.printed import the_paper
from service.studies.paper_1994.tally import Tally
from service.studies.paper_1994.timings import measure

PAPER_IDENTIFIER: Identifier = "starid"
TIMES, PROPORTIONS = (11, 12), (13, 14)


def report(
    tallies: Sequence[Tally], identifier: Identifier, wanted: Sequence[int], seed: int
) -> str:
    """The tables of one identifier as Markdown."""
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
    # Tables 13 and 14 are of the zones of 11 and 12, measured once for both.
    measured = {
        number: [
            (case, measure(case, seed, identifier))
            for case in the_paper().times
            if case.table == str(number)
        ]
        for number, shares in zip(TIMES, PROPORTIONS, strict=True)
        if {number, shares} & set(wanted)
    }
    for number in wanted:
        if number in TIMES:
            parts += [tables.heading(number), time_tables.times(measured[number])]
        elif number in PROPORTIONS:
            written = time_tables.proportions(measured[number - 2])
            note = "`!`: the zone holds more pairs than the approximation bounds."
            parts += [tables.heading(number), written, note]
    return "\n\n".join(parts) + "\n"
