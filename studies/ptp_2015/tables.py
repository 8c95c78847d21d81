"""Tables and figures of the PTP paper in Markdown, its numbers and ours."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from service.cli.markdown import markdown
from studies.ptp_2015 import projections
from studies.ptp_2015.comparison import Database, Tally
from studies.ptp_2015.plots import PlottedSeries
from studies.ptp_2015.printed import Ends, the_ptp_paper
from studies.ptp_2015.projections import Projections

TITLES: Mapping[str, str] = {
    "ptp-1": "Table 1. Projections of nine triangles",
    "ptp-2": "Table 2. The k-vector",
    "ptp-3": "Table 3. The sharing stars of four triangles",
    "figure-6": "Figure 6. Triangles on the projection axis",
    "figure-7": "Figure 7. Projection and index of the triangles",
    "ptp-5": "Table 5. The number of slave stars, no noise",
    "ptp-6": "Table 6. The algorithms compared, 1 px and 0.5 mag of noise",
    "figure-10": "Figure 10. Stars in the field of view",
    "figure-11": "Figure 11. Rate against the stars in the field, 0.5 px",
    "figure-12": "Figure 12. Rate against the noise of position",
    "figure-13": "Figure 13. Rate against the noise of magnitude, stars lost and added",
    "ptp-false": "Fields that are none: what sharing stars and the attitude check accept, 2 px",
}

OF_PROJECTIONS: Mapping[str, Callable[[Projections], str]] = {
    "ptp-1": projections.table_1,
    "ptp-2": projections.table_2,
    "ptp-3": projections.table_3,
    "figure-6": projections.figure_6,
    "figure-7": projections.figure_7,
}
"""Functions for tables of all triangles of the sky, which need no simulated fields."""

NOT_ON_THE_PAGE = (
    *("ptp-1", "ptp-2", "ptp-3", "figure-6", "figure-7"),
    *("figure-10", "figure-11", "figure-12", "figure-13"),
)
"""Tables whose rows only the command prints; the page has their notes and pictures."""

MB = 1e6
STARS_IN_FIELD = ((3, 3), (4, 4), (5, 5), (6, 6), (7, 7), (8, 8), (9, 10), (11, 15), (16, 99))
"""Ranges of the numbers of stars in a field, the columns of Figure 11."""

RATES = (
    "Shares of fields in percent, in brackets the 95 % interval. *Strict*: the algorithm names "
    "three stars or more, all rightly; *loose*: two or more, most of them rightly; *checked*: "
    "three or more behind the attitude check, all rightly; *wrong*: behind the check a star is "
    "misnamed. The paper does not say when it counts a field as identified. Its times are "
    "averages; ours are the median and, in brackets, the average of this machine."
)
ROWS = (
    "`acquire simulate paper --table ptp-1` or `figure-12`, for example, prints the rows left out."
)


@dataclass(frozen=True)
class Measurements:
    """Results of the comparison: tallies by table, star counts of Figure 10, databases."""

    scenes: int
    seed: int
    tallies: Mapping[str, Sequence[Tally]]
    stars: npt.NDArray[np.int64] | None = None
    databases: Sequence[Database] = field(default_factory=tuple)
    false_fields: Sequence[Mapping[str, str | int]] = ()
    projections: Projections | None = None
    """Projections of the sky's triangles, for Table 2 and Figures 6 and 7."""

    @property
    def drawn(self) -> PlottedSeries:
        """Measured series and tallies by figure of the paper, for the plots."""
        figures: PlottedSeries = {} if self.stars is None else {"figure-10": self.stars}
        if self.projections is not None:
            wanted = [name for name in self.tallies if name.startswith("figure")]
            figures |= {
                name: self.projections for name in wanted if name in ("figure-6", "figure-7")
            }
        return figures | {name: tallies for name, tallies in self.tallies.items() if tallies}


def section(found: Measurements, name: str) -> str:
    """Markdown section of a table or figure, with a note on claims that cannot be reproduced."""
    tallies, paper = found.tallies[name], the_ptp_paper()
    note = NOT_REPRODUCED.get(name)
    if name in OF_PROJECTIONS:
        assert found.projections is not None
        shown = OF_PROJECTIONS[name](found.projections)
        note = projections.note_on_table_2(found.projections) if name == "ptp-2" else None
    elif name == "ptp-5":
        shown = table_5(tallies, found.databases)
    elif name == "ptp-6":
        shown = table_6(tallies, found.databases)
    elif name == "figure-10":
        assert found.stars is not None
        shown = figure_10(found.stars)
    elif name == "figure-11":
        shown = figure_11(tallies)
    elif name == "ptp-false":
        shown = false_fields(found.false_fields)
    elif name == "figure-12":
        shown = line_table(tallies, "position_px", "px", paper.figure_12)
    else:
        shown = line_table(tallies, "magnitude_sigma_mag", "mag", paper.figure_13)
    parts = [f"### {TITLES[name]}", shown, *([note] if note else [])]
    return "\n\n".join(parts)


def on_the_page(found: Measurements, name: str) -> str:
    """Markdown section for the page, without the rows that only the command prints."""
    whole = section(found, name)
    if name not in NOT_ON_THE_PAGE:
        return whole
    heading, *rest = whole.split("\n\n")
    return "\n\n".join([heading, *(part for part in rest if not part.startswith("|"))])


def table_5(tallies: Sequence[Tally], databases: Sequence[Database]) -> str:
    """Table 5 in Markdown: rates and database sizes by the number of slave stars."""
    size = {each.algorithm: each for each in databases}
    rows = []
    for printed in the_ptp_paper().table_5:
        tally = next(t for t in tallies if t.algorithm in _names(printed.slaves))
        database = size[tally.algorithm]
        rows.append(
            (
                str(printed.slaves),
                f"{printed.memory_mb:.3f}",
                f"{database.nbytes / MB:.3f}",
                f"{database.entries:,}",
                f"{printed.rate_pct:.2f}",
                *map(str, tally.rates),
                f"{printed.time_ms:.2f}",
                tally.times,
            )
        )
    header = (
        *("slaves", "paper: MB", "MB", "triangles", "paper: rate %"),
        *("strict", "loose", "checked", "wrong", "paper: ms", "ms alone / checked"),
    )
    return markdown(header, rows)


def _names(slaves: int) -> tuple[str, ...]:
    return ("PTP",) if slaves == 4 else (f"PTP, {slaves} slaves",)


def table_6(tallies: Sequence[Tally], databases: Sequence[Database]) -> str:
    """Table 6 in Markdown: algorithms at one pixel and half a magnitude of noise."""
    size = {each.algorithm: each for each in databases}
    printed = {row.algorithm: row for row in the_ptp_paper().table_6}
    rows = []
    for tally in tallies:
        of_paper = printed.get(tally.algorithm)
        rows.append(
            (
                tally.algorithm,
                "lost and added" if tally.case.adds else "lost alone",
                f"{of_paper.rate_pct:.2f}" if of_paper else "",
                *map(str, tally.rates),
                f"{of_paper.time_ms:.2f}" if of_paper else "",
                tally.times,
                f"{of_paper.memory_mb:g}" if of_paper else "",
                f"{size[tally.algorithm].nbytes / MB:.2f}",
            )
        )
    header = (
        *("algorithm", "stars are", "paper: rate %", "strict", "loose", "checked", "wrong"),
        *("paper: ms", "ms alone / checked", "paper: MB", "MB"),
    )
    return markdown(header, rows)


def database_table(databases: Iterable[Database]) -> str:
    """Table of each algorithm's database for the sky to V 6: rows, size, building time."""
    printed = {row.algorithm: row.memory_mb for row in the_ptp_paper().table_6}
    rows = (
        (
            each.algorithm,
            f"{each.entries:,}",
            f"{each.nbytes / MB:.2f}",
            f"{printed[each.algorithm]:g}" if each.algorithm in printed else "",
            f"{each.build_s:.3f}",
        )
        for each in databases
    )
    return markdown(("algorithm", "rows", "MB", "paper: MB", "build s"), rows)


def figure_10(stars: npt.NDArray[np.int64]) -> str:
    """Figure 10 as a Markdown table: stars in the field of view."""
    printed = the_ptp_paper().figure_10
    rows = (
        ("mean", f"{printed.mean:.2f}", f"{stars.mean():.2f}"),
        ("least", str(printed.least), str(stars.min())),
        ("most", str(printed.most), str(stars.max())),
        (
            "more than eight, %",
            f"{printed.more_than_8_pct:.2f}",
            f"{100.0 * (stars > 8).mean():.2f}",
        ),
    )
    return markdown((f"of {len(stars):,} fields", "paper", "ours"), rows)


def figure_11(tallies: Sequence[Tally]) -> str:
    """Figure 11 as a Markdown table: strict and checked rates by the stars in the field."""
    rows = []
    for tally in tallies:
        parts = [tally.of_fields_with(least, most) for least, most in STARS_IN_FIELD]
        for word in ("strict", "checked"):
            rates = [getattr(part, word) for part in parts]
            rows.append((f"{tally.algorithm}, {word}", *(f"{rate.percent:.1f}" for rate in rates)))
        if tally is tallies[-1]:
            rows.append(("fields", *(str(len(part.rows)) for part in parts)))
    columns = (f"{a}" if a == b else f"{a}+" if b == 99 else f"{a}-{b}" for a, b in STARS_IN_FIELD)
    return markdown(("stars in the field", *columns), rows)


def false_fields(rows: Sequence[Mapping[str, str | int]]) -> str:
    """Table of mirrored skies and random fields in which three stars or more are named."""
    header = ("fields", "of", "by sharing stars (section 2.3)", "behind the attitude check")
    names = ("fields", "scenes", "sharing", "checked")
    return markdown(header, [tuple(f"{row[name]}" for name in names) for row in rows])


def line_table(tallies: Sequence[Tally], axis: str, unit: str, printed: Ends) -> str:
    """Figures 12 and 13 as Markdown tables: rates against the noise in the case's field `axis`."""
    values = sorted({getattr(tally.case, axis) for tally in tallies})
    rows = []
    for tally in sorted(tallies, key=lambda t: getattr(t.case, axis)):
        value = getattr(tally.case, axis)
        ends = printed.get(tally.algorithm)
        of_paper = ""
        if ends and value in (values[0], values[-1]):
            of_paper = f"{ends[0] if value == values[0] else ends[1]:.1f}"
        rows.append(
            (
                f"{value:g} {unit}",
                tally.algorithm,
                of_paper,
                *map(str, tally.rates),
                tally.times,
                f"{len(tally.rows):,}",
            )
        )
    header = (
        *("noise", "algorithm", "paper: rate %", "strict", "loose", "checked", "wrong"),
        *("ms alone / checked", "fields"),
    )
    return markdown(header, rows)


NOT_REPRODUCED: Mapping[str, str] = {
    "ptp-6": (
        "**Not reproducible as printed: 96.79 %.** The rate is reached, behind the attitude check, "
        "only if the noise of magnitude takes stars away and adds none. A star of V 6.2 that is "
        "measured half a magnitude too bright is as real to a detector as any other, stands in no "
        "guide triangle, and changes who is nearest to whom: rows *lost and added*."
    ),
    "figure-10": (
        "**Not reproducible.** Fields of 10 by 10 degrees spread evenly over the sphere hold fewer "
        "stars to V 6 than is printed, and far fewer of them hold more than eight. The printed "
        "numbers do not fit each other either: stars scattered evenly at the printed mean would "
        "leave 94 % of fields with more than eight, and real stars crowd, which leaves less."
    ),
    "figure-11": (
        "**Not reproduced.** The paper has the P-vector at about 100 % above seven stars, and PTP "
        "above it everywhere. On our fields the P-vector's two brightest neighbours leave the "
        "field at its edge whatever it holds, and of three or four stars PTP has too few "
        "triangles for two to share a star."
    ),
    "figure-12": (
        "**The ends are not reproduced.** *Strict*, PTP and the P-vector fall faster than printed "
        "(99.3 to 95.5, 98.9 to 93.7 %), the planar triangle less (99.1 to 92.1 %). The paper "
        "does not say what counts as identified, nor how wide its search is: ours widens with the "
        "noise, one misnamed star spoils a field, and behind the check PTP's loss is gone. "
        "The P-vector's ends, 98.9 and 93.7, are printed for noise of position here and once more "
        "for noise of magnitude with Figure 13: one of the two is a copy."
    ),
    "figure-13": (
        "**The ends are not reproduced**: *strict*, the P-vector falls far below 93.7 %. "
        "The P-vector's ends are those of Figure 12, printed again. It is the algorithm that "
        "depends on magnitudes, and the two noises have nothing in common."
    ),
}
