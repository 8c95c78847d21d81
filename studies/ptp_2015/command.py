"""Command `acquire simulate paper --table ptp-5` and similar: Zhou & Ye 2015 and our results."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from service.cli.markdown import markdown
from service.errors import BadInput, Fault
from service.missions.mission import RunCatalogSettings
from service.sky.catalog.run_catalog import build_run_catalog
from service.sky.catalog.star_catalog import load_embedded
from service.sky.geometry.triangles import build_triangles
from studies.documents import json_rows, links
from studies.ptp_2015 import comparison, tables
from studies.ptp_2015.comparison import Case
from studies.ptp_2015.plots import draw
from studies.ptp_2015.printed import the_ptp_paper
from studies.ptp_2015.tables import OF_PROJECTIONS, TITLES, Measurements, section

DEFAULT_SCENES = 10_000
SLAVES = ("PTP, 3 slaves", "PTP", "PTP, 5 slaves", "PTP, 6 slaves")
ALL = "ptp"
"""Name that selects all tables and figures."""

CASES: Mapping[str, Sequence[Case]] = {
    "ptp-1": [],
    "ptp-2": [],
    "ptp-3": [],
    "figure-6": [],
    "figure-7": [],
    "ptp-5": [Case("ptp-5", SLAVES, 0.0)],
    "ptp-6": [Case("ptp-6", comparison.COMPARED, 1.0, 0.5, adds=adds) for adds in (False, True)],
    "figure-10": [],
    "figure-11": [Case("figure-11", comparison.COMPARED, 0.5, fewest=3)],
    "figure-12": [Case("figure-12", comparison.COMPARED, px) for px in (0.0, 0.5, 1.0, 1.5, 2.0)],
    "figure-13": [
        Case("figure-13", comparison.OF_THE_PAPER, 0.0, mag)
        for mag in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
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
    """Print one table or figure of the PTP paper, or all (`ptp`), with its numbers and ours.

    `scenes` fields are drawn for each condition.  `json_path` receives one row per condition and
    algorithm, the folder `plots` the pictures, `report_path` the document, instead of printing.
    Raises `BadInput` for an unknown table.
    """
    wanted = _checked(table, scenes, seed)
    out = out or sys.stdout
    found = measured(wanted, scenes, seed, processes)
    if json_path is not None:
        json_path.write_text(json_rows(rows_of(found)), encoding="utf-8")
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
    """Compute all results that the requested tables and figures show."""
    cases = [case for name in wanted for case in CASES[name]]
    tallies = comparison.compare(cases, scenes, seed, processes) if cases else []
    names = dict.fromkeys(t.algorithm for t in tallies if t.case.name.startswith("ptp-"))
    return Measurements(
        scenes,
        seed,
        {name: [tally for tally in tallies if tally.case.name == name] for name in wanted},
        comparison.stars_in_fields(scenes, seed) if "figure-10" in wanted else None,
        comparison.databases(list(names)),
        comparison.false_fields(scenes, seed) if "ptp-false" in wanted else (),
        comparison.all_projections() if any(name in OF_PROJECTIONS for name in wanted) else None,
    )


def rows_of(found: Measurements) -> list[dict[str, Any]]:
    """Result rows, one per condition and algorithm, and those of the projection tables."""
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


_INTRODUCTION = """\
F. Zhou & T. Ye, *Lost-in-Space Star Identification Using Planar Triangle Principal Component
Analysis Algorithm*, Mathematical Problems in Engineering 2015, 982420. The identifier `ptp`
proposes stars as the paper does, by sections 2.1 and 2.2; the validation by sharing stars (2.3)
does not decide its answer, an attitude check does (below). Here both are measured: *strict* and
*loose* are the paper's way, *checked* is the identifier's. The rivals live beside the simulator and
are no identifiers of the service. `acquire simulate paper --table ptp --plots docs/plots --report
docs/ptp.md` makes this page again, with `--scenes` and `--seed` of your choice.

Fields are those of the paper's camera: 1,024 pixels over 10 degrees at attitudes spread evenly over
all rotations, stars to V 6, more than five of them. Noise of magnitude both drops stars and lifts
fainter ones into the field, unless a row says otherwise. Algorithms are told the noise of position,
a quarter of a pixel at least, and every one sees the same fields.

How the paper was read, where it leaves a choice:

- of four slaves five triangles are made, those with the nearest or the second nearest slave: of the
  six ways to leave one out only this gives the axis that Table 1 was made with;
- sides are compared within three of their own standard deviations, which follow from the same
  covariance as that of the projection;
- a sharing star carries the same name in two different sets of three observed stars, one set seen
  from two of its corners counting once; the name with the most votes counts, a tie for none;
- the angle of 5 degrees is a chord of 872.39, not 872.8 as printed; the sides stand in columns 6 to
  8 of Table 1, not 6 to 9.

What differs from the paper:

- the star catalog is Hipparcos and Tycho-2, ordered by magnitude; its column of SAO numbers is
  empty, so that the triangles of Table 1 are compared by their sides. The axis below is of single
  stars, as the SAO catalog lists them; databases and fields are of stars merged within 60
  arcseconds, as the service keeps them;
- Table 4: fields are lists of stars with Gaussian errors of position; no image is drawn;
- real pictures (section 4, to come): told the focal length, with the sixteen brightest points and
  stars to V 7, `ptp` finds the attitude of two of the three pictures in `tests/features/pictures`,
  and none of the one where a tree covers the sky (`tests/identify/test_ptp_pipeline.py`); the
  solver for pictures of any camera solves all three ([cameras.md](cameras.md)).

The attitude check is ours and replaces the validation, because sharing stars accept fields that are
none: sides are the same in a mirror, so that they accept a mirrored sky nearly always, and at two
pixels of noise most fields of random points (the last table). The check asks for a proper rotation
that carries proposals to the field, and for so many stars on their places that chance would not do
it in the whole sky.
"""

_ORDER = """\
The paper finds PTP ahead of the P-vector, and that ahead of the planar triangle. On equal fields,
each rival with an honest search of its own, the last two change places: triangles of the two
brightest neighbours break at the edge of the field and with every magnitude misjudged, while a
database of all triangles, or of all pairs, knows every field. What PTP has for itself is the
smallest database that still names nearly every field behind the check.
"""

_RIVALS = """\
The rivals as they were made: the **P-vector** (Yang, Zhang & Jiang 2007) has one triangle a star,
with its two brightest neighbours within 5 degrees, and believes what a unique match names. The
**planar triangle** (Cole & Crassidis 2006) has every triangle of the sky by area and polar moment
and pivots among those of the 20 brightest stars; it answers with three stars. **Liebe's triangles**
(1992) are a star's distances to two of its four nearest and the angle between them, sharing stars
deciding. The **pyramid** (Mortari et al. 2004) is a triangle with a fourth star, found by
separations; it answers with four stars. Nothing was tuned beyond that.
"""


def document(found: Measurements, plots: Path, file: Path) -> str:
    """Markdown document: interpretation of the paper, its axis and ours, databases, tables,
    figures.

    The pictures are those of `plots.draw` in the folder `plots`, linked relative to the document
    `file`.
    """
    parts = [
        "# PTP and its rivals: Zhou & Ye 2015",
        (
            "For astronomers who know the paper, or who choose an identifier without a prior.\n"
            f"Seed {found.seed}, {found.scenes:,} fields a condition."
        ),
        _INTRODUCTION,
        *_in_short(found),
        "## The axis",
        _axis(),
        *(
            ["## Databases", _RIVALS, tables.database_table(_not_of_table_5(found.databases))]
            if found.databases
            else []
        ),
        "## Tables and figures",
        tables.RATES,
        tables.ROWS,
    ]
    for name in tables.TITLES:
        if name in found.tallies:
            parts.append(tables.on_the_page(found, name))
            parts += links(tables.TITLES[name], plots / f"ptp-{name}.svg", file)
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _not_of_table_5(databases: Sequence[comparison.Database]) -> list[comparison.Database]:
    return [each for each in databases if not each.algorithm.startswith("PTP, ")]


def _in_short(found: Measurements) -> list[str]:
    """Summary table of the algorithms at one and at two pixels, the best strict rate first."""
    # At one pixel and half a magnitude; the claim is about the order of the rates.
    printed = {row.algorithm: row.rate_pct for row in the_ptp_paper().table_6}
    rows = []
    for px in (1.0, 2.0):
        tallies = [t for t in found.tallies.get("figure-12", ()) if t.case.position_px == px]
        for tally in sorted(tallies, key=lambda each: -each.strict.count):
            of_paper = f"{printed[tally.algorithm]:.2f}" if tally.algorithm in printed else ""
            rates = (tally.strict, tally.checked, tally.wrong)
            rows.append((f"{px:g} px", tally.algorithm, of_paper, *map(str, rates)))
    if not rows:
        return []
    header = ("noise", "algorithm", "paper: Table 6 %", "strict", "checked", "wrong")
    return ["## In short", _ORDER, markdown(header, rows)]


def _axis() -> str:
    """Table of the principal axis of triangle sides: the paper's, from its Table 1, and ours."""
    paper = the_ptp_paper()
    rows = [("paper, from Table 1", f"{paper.catalog_stars:,}", "", *_numbers(paper.axis))]
    rows[0] = (*rows[0], f"{paper.mean_projection:.2f}")
    for limit_mag in (6.0, 6.01):
        settings = RunCatalogSettings(magnitude_limit_mag=limit_mag, merge_within_arcsec=0.0)
        stars = build_run_catalog(load_embedded(), settings, 2000.0)
        index = build_triangles(stars.direction)
        rows.append(
            (
                f"ours, V to {limit_mag:g}",
                f"{len(stars):,}",
                f"{index.count:,}",
                *_numbers(index.axis),
                f"{index.axis @ index.mean:.2f}",
            )
        )
    text = markdown(("", "stars", "triangles", "w1", "w2", "w3", "mean projection"), rows)
    shares = ", ".join(f"{100.0 * share:.0f} %" for share in index.explained)
    return (
        "Nine rows of sides and projections fix the four unknowns of P = w . (x - mean), with "
        "residuals below 0.00001 and |w| = 1.000001. Ours comes of another star catalog.\n\n"
        f"{text}\n\nThe three principal axes explain {shares} of the variance: one number does "
        "not separate triangles well. The k-vector gives speed, the sides selectivity, the votes "
        "safety."
    )


def _numbers(values: "tuple[float, ...] | np.typing.NDArray[np.float64]") -> tuple[str, ...]:
    return tuple(f"{float(value):.5f}" for value in values)
