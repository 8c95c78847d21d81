"""Command `acquire simulate imaging`: claims of the star image detection report and our results."""

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TextIO

from tqdm import tqdm

from service.errors import BadInput, Fault
from studies.documents import json_rows, links, pictures_in
from studies.star_image_report import estimating, locating, mesh, optics, recognising, scanning
from studies.star_image_report.claims import Claim, Row, Study

ROWS: Mapping[str, Callable[[Study], Row]] = {
    "IM-1": optics.transfer,
    "IM-2": optics.example,
    "IM-3": locating.correlation,
    "IM-4": mesh.mesh,
    "IM-5": locating.sun,
    "IM-6": locating.fifteen_arcsec,
    "IM-7": estimating.sequential,
    "IM-8": scanning.centroid,
    "IM-9": scanning.two_stars,
    "IM-10": scanning.noise,
    "IM-11": recognising.patterns,
}

_INTRODUCTION = """\
For optical engineers who know the star image detection report: each of its claims, checked.
Apertures, spectra, images and centroids are in `service/features/pictures/centroids`, scans
in `service/observations/scans`, the other systems in `studies/star_image_report`. A claim
is *confirmed* where ours agrees, *corrected* where the report has a slip that ours mends,
*qualified* where it is right within limits that are measured here, *added* where ours goes beyond
the report.

`acquire simulate imaging --plots docs/plots --report docs/imaging.md` makes this page again, with
a `--seed` of your choice; `--row IM-4` prints one row.
"""

_LEFT_OUT = """\
## Parts of the report that this project leaves out or does differently

- 1.1, kinds of trackers, a field of view that adapts, and the trade of field of view, optics and
  detection: no study compares or joins them.
- 2.5, 7.1, colours: in these claims every star and its background have one spectrum. The cameras'
  images `airy` and `cross` are of one colour, or of the camera's `band_nm` with a colour for each
  star ([missions.md](missions.md#light-of-many-colours)).
- 3.3, the synthesis of a filter from a wanted correlation: the report names three steps and gives
  none; nothing is made of it.
- 4.2, a filter behind the lens: tails shrink with the distance to the sensor and nothing else is
  claimed; the signal to noise of shorter tails is not measured. Pinhole, film and shutter are not
  modelled, and the advice on lenses and shutters is of hardware.
- Figure 4-2: ten wires each way, as the printed pitch gives for this aperture, not the drawing's
  eight, which have fainter orders.
- 4.4, eight and two wires: the light of all tails together is compared, not each tail.
- 4.5, Vega: the report's photograph through 18 meshes does show dots, against its own rule and
  IM-4, by which only a band of colours blurs them; its exposure and band are not told.
- 5.4, the negative is cut at 1 % of the peak, without a film's curve or a scan's lines.
- 6.3, 6.12, 6.4: the learned quantity is one variance of the noise, and Q is diagonal.
- 7.5, a detector's threshold against the size of the image is not measured.
- 7.8, recognition by K is the study's and no identifier: K alone is right too seldom (IM-11).
"""


def run_imaging(
    wanted: Sequence[str] = (),
    seed: int = 1,
    quick: bool = False,
    json_path: Path | None = None,
    plots_folder: Path | None = None,
    report_path: Path | None = None,
    out: TextIO | None = None,
) -> list[Row]:
    """Check some rows of claims, or all, print them with our results, and return the rows.

    `json_path` receives the claims with their figures, `plots_folder` the pictures, `report_path` a
    page with everything, instead of printing.  Raises `BadInput` for an unknown row.
    """
    names = list(dict.fromkeys(name.upper() for name in wanted)) or list(ROWS)
    faults = [
        Fault("row", f"must be one of {', '.join(ROWS)}", name)
        for name in names
        if name not in ROWS
    ]
    if seed < 0:
        faults.append(Fault("seed", "must not be negative", str(seed)))
    if faults:
        raise BadInput(faults)
    out = out or sys.stdout
    study = Study(seed, quick)
    bar = tqdm(names, desc="imaging", unit="row", disable=not sys.stderr.isatty())
    rows = [ROWS[name](study) for name in bar]
    if json_path is not None:
        json_path.write_text(as_json(rows), encoding="utf-8")
    if plots_folder is not None:
        draw(rows, plots_folder)
    if report_path is None:
        print("\n\n".join(table(row) for row in rows), file=out)
    else:
        folder = plots_folder or report_path.parent
        report_path.write_text(document(rows, seed, folder, report_path), encoding="utf-8")
        print(report_path, file=out)
    return rows


def table(row: Row) -> str:
    """Markdown table of the claims of one row."""
    lines = ["| section | the report | here | |", "|---|---|---|---|"]
    lines += [
        f"| {claim.section} | {_cell(claim.says)} | {_cell(claim.ours)} | {_mark(claim)} |"
        for claim in row.claims
    ]
    return f"## {row.name} {row.title}\n\n" + "\n".join(lines)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _mark(claim: Claim) -> str:
    return claim.verdict if claim.holds else f"**{claim.verdict}: out of bounds**"


def document(rows: Sequence[Row], seed: int, folder: Path, file: Path) -> str:
    """Markdown page of all rows, pictures linked relative to the page `file`."""
    total = sum(len(row.claims) for row in rows)
    held = sum(claim.holds for row in rows for claim in row.claims)
    parts = [
        "# The star image detection report, claim by claim",
        _INTRODUCTION.strip(),
        f"Seed {seed}; {held} of {total} claims are within their bounds.",
    ]
    if len(rows) == len(ROWS):
        parts.append(_LEFT_OUT.strip())
    for row in rows:
        parts.append(table(row))
        shown = [
            f"- {link.removeprefix('!')}: {picture.caption}"
            for name, picture in row.pictures.items()
            for link in links(name, folder / f"{name}.svg", file)
        ]
        parts += ["\n".join(shown)] if shown else []
    return "\n\n".join(parts) + "\n"


def as_json(rows: Sequence[Row]) -> str:
    """JSON with one claim per line, and its figures."""
    return json_rows(
        {
            "row": row.name,
            "section": claim.section,
            "report": claim.says,
            "here": claim.ours,
            "verdict": claim.verdict,
            "holds": bool(claim.holds),
            "figures": claim.figures,
        }
        for row in rows
        for claim in row.claims
    )


def draw(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Draw all pictures of the rows; returns the files written.

    Raises `NotAvailable` without matplotlib.
    """
    with pictures_in(folder, "imaging") as pictures:
        for row in rows:
            for name, picture in row.pictures.items():
                figure = pictures.figure(*picture.size)
                picture.draw(figure)
                pictures.save(figure, name)
    return pictures.written
