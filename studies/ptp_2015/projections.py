"""Table 2 and Figures 6 and 7 of the PTP paper: distribution of triangle projections."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.cli.markdown import markdown
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.geometry.kvector import KVector, build_kvector
from service.sky.geometry.triangles import TriangleIndex, build_triangles
from service.vectors import Vector
from studies.ptp_2015.printed import the_ptp_paper
from studies.ptp_2015.rivals.proposed import proposed_by_votes

SHOWN_EVERY = 25
SIGMA_AT_1_PX = 2.87
"""Sigma of a projection by the paper's equation 13, at one pixel of 35.25 arcsec."""
COLORS = ("#0b5394", "#b45309")


@dataclass(frozen=True)
class Projections:
    """Guide triangles of the sky to V 6, in our database and as the printed tables suggest.

    `once` are the projections of triangles of four slave stars, each set of three stars once;
    `three` those of three slave stars.
    """

    triangles: TriangleIndex
    once: KVector
    three: KVector

    def rows(self, name: str) -> list[dict[str, Any]]:
        """Rows of a table or figure, for JSON."""
        if name == "ptp-1":
            return rows_of_table_1()
        if name == "ptp-3":
            return rows_of_table_3()
        if name == "figure-6":
            return [row_of_figure_6(self)]
        if name == "figure-7":
            return rows_of_figure_7(self)
        return [
            {"table": "ptp-2", "index": index, "paper": paper, "ours": ours, "three_slaves": three}
            for index, paper, ours, three in self.table_2()
        ]

    def table_2(self) -> list[tuple[int, int, int, int]]:
        """Rows of Table 2: limit index, K of the paper, ours, and ours with three slave stars."""
        ours = self.triangles.projection.below
        return [
            (index, paper, int(ours[index - 1]), int(self.three.below[index - 1]))
            for index, paper in the_ptp_paper().table_2
        ]


def projections_of(stars: RunCatalog) -> Projections:
    """Compute the projections of guide triangles for a list of stars."""
    four = build_triangles(stars.direction)
    return Projections(four, _once(four), _once(build_triangles(stars.direction, slaves=3)))


def _once(index: TriangleIndex) -> KVector:
    """Projections of triangles, each set of three stars once, with its brightest as master."""
    order = np.argsort(index.star[:, 0], kind="stable")
    _, first = np.unique(np.sort(index.star[order], axis=1), axis=0, return_index=True)
    return build_kvector(index.projection.value[np.sort(order[first])])


def recovered_axis() -> tuple[Vector, float]:
    """Axis and mean projection behind Table 1, from a least-squares fit of nine equations."""
    paper = the_ptp_paper()
    sides, printed = np.array(paper.table_1_sides), np.array([row[1] for row in paper.table_1])
    unknowns = np.linalg.lstsq(np.column_stack([sides, -np.ones(len(sides))]), printed)[0]
    return unknowns[:3], float(unknowns[3])


def rows_of_table_1() -> list[dict[str, Any]]:
    """Rows of Table 1: sides of a triangle, printed projection, and that by the recovered axis."""
    axis, mean = recovered_axis()
    paper = the_ptp_paper()
    return [
        {
            "table": "ptp-1",
            "index": index,
            "sides": list(sides),
            "paper": printed,
            "ours": float(np.dot(sides, axis) - mean),
        }
        for (index, printed), sides in zip(paper.table_1, paper.table_1_sides, strict=True)
    ]


def table_1(found: Projections) -> str:
    """Table 1 in Markdown: printed projections, and those of the sides on the recovered axis."""
    axis, mean = recovered_axis()
    lines = [
        (
            f"{row['index']:,}",
            *(f"{side:.5f}" for side in row["sides"]),
            f"{row['paper']:.5f}",
            f"{row['ours']:.5f}",
        )
        for row in rows_of_table_1()
    ]
    text = markdown(("index", "side 1", "side 2", "side 3", "paper: P", "P of the sides"), lines)
    worst = max(abs(row["ours"] - row["paper"]) for row in rows_of_table_1())
    shown = ", ".join(f"{part:.5f}" for part in axis)
    return (
        f"{text}\n\nThe axis is ({shown}) with |w| = {np.linalg.norm(axis):.6f}, the mean "
        f"projection {mean:.4f}; no row is farther off than {worst:.6f}."
    )


def rows_of_table_3() -> list[dict[str, Any]]:
    """Rows of Table 3: each star with the SAO number that sharing stars validate, or None."""
    triangles = the_ptp_paper().table_3["triangles"]
    sao = sorted({number for each in triangles for number in each["sao"]})
    image = np.array([each["stars"] for each in triangles], np.int32)
    star = np.array([[sao.index(n) for n in each["sao"]] for each in triangles], np.int32)
    count = int(the_ptp_paper().table_3["stars_in_field"]) + 1
    match = proposed_by_votes(image, star, len(sao), count, shared=True).match.tolist()
    return [
        {"table": "ptp-3", "star": k, "sao": sao[match[k]] if match[k] >= 0 else None}
        for k in range(1, count)
    ]


def table_3(found: Projections) -> str:
    """Table 3 in Markdown: stars of the printed triangles that sharing stars validate."""
    printed = the_ptp_paper().table_3["identified"]
    lines = [
        (
            str(row["star"]),
            "identified" if row["star"] in printed else "",
            "" if row["sao"] is None else f"SAO {row['sao']}",
        )
        for row in rows_of_table_3()
    ]
    return markdown(("star of the field", "paper", "ours"), lines)


def table_2(found: Projections) -> str:
    """Table 2 in Markdown: the k-vector at the printed limit indices."""
    rows = [[f"{cell:,}" for cell in row] for row in found.table_2()]
    four, three = found.triangles.projection, found.three
    rows.append(["triangles", "", f"{len(four.value):,}", f"{len(three.value):,}"])
    rows.append(["one index, in P", "", f"{four.slope:.4f}", f"{three.slope:.4f}"])
    header = ("limit index", "paper: K", "K, four slaves", "K, three slaves, each once")
    return markdown(header, rows)


def printed_slope(found: Projections) -> float:
    """Step of P per limit index, if Tables 1 and 2 are of one database.

    K of the first row of Table 2 is the row of a triangle whose P is extrapolated from the rows of
    Table 1, 90 rows before, with their density.
    """
    index, count = the_ptp_paper().table_2[0]
    rows = the_ptp_paper().table_1
    density = (rows[-1][0] - rows[0][0]) / (rows[-1][1] - rows[0][1])
    projection = rows[-1][1] + (count - rows[-1][0]) / density
    return (projection - float(found.triangles.projection.value[0])) / (index - 1)


def note_on_table_2(found: Projections) -> str:
    """Note on the size of the database that the printed numbers imply."""
    slope = printed_slope(found)
    value = found.triangles.projection.value
    implied = (float(value[-1]) - float(value[0])) / slope + 1.0
    return (
        "**An illustration.** With the rows of Table 1, which stand just before, Table 2 has one "
        f"limit index for every {slope:.3f} of P: a database of about {implied:,.0f} triangles, as "
        f"many as three slaves give with each triangle once ({len(found.three.value):,}), not the "
        "four slaves that the paper settles on."
    )


def row_of_figure_6(found: Projections) -> dict[str, Any]:
    """Row of Figure 6: distribution of the triangles along the axis."""
    value = found.triangles.projection.value
    gap = np.diff(value)
    return {
        "table": "figure-6",
        "triangles": len(value),
        "ends": [float(value[0]), float(value[-1])],
        "explained": [float(share) for share in found.triangles.explained],
        "gap_median": float(np.median(gap)),
        "nearer_than_sigma": float(np.mean(gap < SIGMA_AT_1_PX)),
        "within_3_sigma_median": float(np.median(_within(value, 3.0 * SIGMA_AT_1_PX))),
    }


def figure_6(found: Projections) -> str:
    """Figure 6 as a Markdown table: distribution of the triangles along the axis."""
    row = row_of_figure_6(found)
    shares = ", ".join(f"{100.0 * share:.0f} %" for share in row["explained"])
    rows = (
        ("triangles", f"{row['triangles']:,}"),
        ("least and greatest projection", f"{row['ends'][0]:.1f}, {row['ends'][1]:.1f}"),
        ("variance along the axis and across it", shares),
        ("gap between neighbours, median", f"{row['gap_median']:.4f}"),
        ("neighbours nearer than a sigma at 1 px", f"{100.0 * row['nearer_than_sigma']:.2f} %"),
        ("triangles within 3 sigma at 1 px, median", f"{row['within_3_sigma_median']:.0f}"),
    )
    text = markdown(("projections on the axis", "ours"), rows)
    return (
        f"{text}\n\nThe paper says of its two pictures that the points are too close, and that "
        "principal components do not separate triangles well. So it is: the sides and the votes "
        "tell apart what one number cannot."
    )


def figure_7(found: Projections) -> str:
    """Figure 7 as a Markdown table: index of a triangle by projection, at the rows of Table 1."""
    rows = [
        (f"{row['projection']:.5f}", *(f"{row[name]:,}" for name in ("paper", "ours", "once")))
        for row in rows_of_figure_7(found)
    ]
    return markdown(("projection", "paper: index", "ours", "ours, each triangle once"), rows)


def rows_of_figure_7(found: Projections) -> list[dict[str, Any]]:
    """Rows of Figure 7: projection, printed index, ours, and ours with each triangle once."""
    return [
        {
            "table": "figure-7",
            "projection": projection,
            "paper": index,
            "ours": _index_of(found.triangles.projection, projection),
            "once": _index_of(found.once, projection),
        }
        for index, projection in the_ptp_paper().table_1
    ]


def _index_of(column: KVector, projection: float) -> int:
    return int(np.searchsorted(column.value, projection)) + 1


def _within(value: Vector, reach: float) -> npt.NDArray[np.int64]:
    low, high = (np.searchsorted(value, value + side * reach) for side in (-1.0, 1.0))
    return np.asarray(high - low, dtype=np.int64)


def draw_figure_6(figure: Any, found: Projections) -> None:
    """Draw the sides of triangles with the axis of their projections, and a histogram."""
    index = found.triangles
    left = figure.add_subplot(1, 2, 1, projection="3d")
    sides = index.side[::SHOWN_EVERY]
    left.scatter(*sides.T, s=2, color=COLORS[0], alpha=0.4, linewidths=0)
    ends = np.array([index.projection.value[0], index.projection.value[-1]])
    line = index.mean + ends[:, None] * index.axis
    left.plot(*line.T, color=COLORS[1], lw=2)
    left.set(xlabel="side 1", ylabel="side 2", title="Figure 6: the three sides, the axis")
    right = figure.add_subplot(1, 2, 2)
    right.hist(index.projection.value, 80, color=COLORS[0])
    right.set(xlabel="projection", ylabel="triangles")


def draw_figure_7(figure: Any, found: Projections) -> None:
    """Draw projections against their index: ours, and the nine printed in the paper."""
    axis = figure.subplots()
    named: Sequence[tuple[str, KVector, str]] = (
        ("ours", found.triangles.projection, COLORS[0]),
        ("ours, each triangle once", found.once, "0.5"),
    )
    for label, column, color in named:
        at = np.arange(0, len(column.value), SHOWN_EVERY)
        axis.plot(at + 1, column.value[at], color=color, label=label)
    printed = np.array(the_ptp_paper().table_1)
    axis.plot(*printed.T, "o", mfc="none", color=COLORS[1], label="paper, Table 1")
    axis.set(xlabel="index", ylabel="projection", title="Figure 7: projections by their index")
    axis.legend(fontsize=7)
