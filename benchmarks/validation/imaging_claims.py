"""The systems IM-1 to IM-11 of the star image detection report, every claim within its bounds."""

from benchmarks.bounds import Bound, every
from benchmarks.record import IMAGING
from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.studies.star_image_report.claims import Row
from service.studies.star_image_report.command import ROWS, run_imaging


def _rows(quick: bool, seed: int) -> list[Row]:
    from os import devnull

    with open(devnull, "w", encoding="utf-8") as nowhere:
        return run_imaging(list(ROWS), seed, quick, out=nowhere)


def run(quick: bool, seed: int) -> Report:
    """Claims within their bounds by row."""
    measured = _rows(quick, seed)
    figures = {
        f"{row.name} {row.title}": f"{sum(c.holds for c in row.claims)} of {len(row.claims)}"
        for row in measured
    }
    return Report("imaging_claims", figures, bounds_of(measured))


def bounds_of(measured: list[Row]) -> list[Bound]:
    """Every claim is checked where it is measured; the bound of a row is that all hold."""
    return [
        bound
        for row in measured
        for bound in every(
            f"{row.name}: claims within their bounds",
            [Bound(f"{row.name}: {c.says}", c.ours, "the claim", c.holds) for c in row.claims],
        )
    ]


def write(quick: bool, seed: int) -> Written:
    """The section of the verification: one line a claim."""
    measured = _rows(quick, seed)
    lines = [
        (row.name, claim.section, claim.says, claim.ours, _mark(claim.verdict, claim.holds))
        for row in measured
        for claim in row.claims
    ]
    text = f"""
What the star image detection report claims, system by system, and what is measured here; with
pictures in [imaging.md](imaging.md). *Corrected* is a slip of the report that ours mends.

{table(("row", "section", "the report", "here", ""), [[_cell(x) for x in line] for line in lines])}
"""
    return Written(text, bounds_of(measured))


def _mark(verdict: str, holds: bool) -> str:
    return verdict if holds else f"**{verdict}: out of bounds**"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


SECTION = Section("Star images", write, IMAGING)
