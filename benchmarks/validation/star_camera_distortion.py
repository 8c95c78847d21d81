"""Chandra's aspect camera calibrated from guide stars that were observed in flight.

    python -m benchmarks.validation.star_camera_distortion --folder FOLDER
    ... --write                        into docs/calibration.md

FOLDER holds `star_obs_2020.fits.gz` of sot/chandra_aca (BSD-3-Clause): places of stars on the
CCD, the angles where they should be, and the camera's temperature.  Attitudes are known, so
nothing but the camera is fitted.  Folds are of rows.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.bounds import Bound, at_most
from benchmarks.record import ROOT, record_of
from benchmarks.report import Report
from benchmarks.sections import pictures_of, table
from service.features.calibration.estimate import Calibration, calibrate
from service.features.calibration.linearise import (
    Model,
    directions,
    prepared,
    residuals,
    unknowns_of,
)
from service.features.calibration.stars import IdentifiedStars
from service.missions.mission import Tracker
from service.vectors import ARCSEC_PER_RADIAN
from studies.documents import Folder

Array = npt.NDArray[np.float64]

FILE = "star_obs_2020.fits.gz"
DOCUMENT = ROOT / "docs" / "calibration.md"
PLOTS = ROOT / "docs" / "plots"
SOURCES = ("service/features/calibration", "service/vectors.py")
MODULE = "benchmarks.validation.star_camera_distortion"

ROUGH_ARCSEC_PER_PX = 4.97
"""Approximate scale at the start; the fit finds the exact one."""
SIGMA_ARCSEC, FOLDS, RUNS = 0.2, 10, 10
MOST_ARCSEC = {"y angle": 0.20, "z angle": 0.21}
STEPS = (
    ("linear", 1, False),
    ("cubic", 3, False),
    ("cubic, linear in temperature", 3, True),
    ("quintic, linear in temperature", 5, True),
)
CAMERA = Tracker(
    name="ACA",
    x_axis_body=(1.0, 0.0, 0.0),
    y_axis_body=(0.0, 1.0, 0.0),
    z_axis_body=(0.0, 0.0, 1.0),
    field_of_view_radius_deg=512 * ROUGH_ARCSEC_PER_PX / 3600.0,
    sigma_arcsec=SIGMA_ARCSEC,
    magnitude_sigma_mag=0.1,
)


@dataclass(frozen=True)
class Step:
    """Model with its held-out residuals (runs, n, 2) in arcsec, and the fit to all rows."""

    name: str
    unknowns: int
    held_out_arcsec: Array
    fitted: Calibration

    @property
    def rms_arcsec(self) -> Array:
        """Rms of held-out residuals of the y angle and of the z angle."""
        return np.asarray(np.sqrt(np.mean(self.held_out_arcsec**2, axis=(0, 1))))


def observed(folder: Path) -> IdentifiedStars:
    """Rows of the file as stars with known attitudes, one batch each."""
    from astropy.io import fits

    with fits.open(folder / FILE) as file:
        rows = {name: np.asarray(file[1].data[name], np.float64) for name in file[1].data.names}
    count = len(rows["row_obs"])
    measured = ROUGH_ARCSEC_PER_PX * np.column_stack([-rows["row_obs"], rows["col_obs"]])
    angles = measured / ARCSEC_PER_RADIAN
    true = np.column_stack([rows["yag_star"], rows["zag_star"]]) / ARCSEC_PER_RADIAN
    return IdentifiedStars(
        trackers=(CAMERA,),
        batch=np.arange(count),
        tracker=np.zeros(count, np.int64),
        measured_rad=angles,
        angles_rad=angles,
        reference=directions(true),
        sigma_rad=np.full(count, SIGMA_ARCSEC / ARCSEC_PER_RADIAN),
        time_offset_s=np.zeros(count),
        temperature_c=rows["t_aca"],
        time_s=np.zeros(count),
        attitude=np.tile(np.eye(3), (count, 1, 1)),
        rates_rad_per_s=np.zeros((count, 3)),
    )


def measured_step(
    stars: IdentifiedStars, name: str, degree: int, warm: bool, runs: int, seed: int
) -> Step:
    """Result of one model: every row predicted by a fit to the other folds, `runs` times."""
    reference_c = float(stars.temperature_c.mean()) if warm else None
    model = Model(degree=degree, reference_temperature_c=reference_c, attitudes_known=True)
    rng = np.random.default_rng(seed)
    found = np.empty((runs, len(stars), 2))
    for each in found:
        fold = rng.permutation(len(stars)) % FOLDS
        for number in range(FOLDS):
            fitted = calibrate(stars.chosen(fold != number), model)
            each[fold == number] = _predicted(stars.chosen(fold == number), model, fitted)
    whole = calibrate(stars, model)
    return Step(name, len(whole.unknowns), found, whole)


def _predicted(stars: IdentifiedStars, model: Model, fitted: Calibration) -> Array:
    """Residuals (n, 2) in arcsec of stars that were not in the fit."""
    unknowns = unknowns_of(stars.trackers, model)
    values = {each.name: v for each, v in zip(fitted.unknowns, fitted.value, strict=True)}
    inside = np.array([values.get(each.name, 0.0) * each.per_unit for each in unknowns])
    (part,) = prepared(stars, unknowns, model.reference_temperature_c)
    return np.asarray(residuals(part, inside, stars.attitude).T * SIGMA_ARCSEC)


def measured(folder: Path, runs: int, seed: int) -> list[Step]:
    """Results of all models in `STEPS`."""
    stars = observed(folder)
    return [measured_step(stars, *step, runs, seed) for step in STEPS]


def bounds_of(steps: list[Step]) -> list[Bound]:
    """Bounds of the cubic model with temperature."""
    (best,) = (each for each in steps if each.name == STEPS[2][0])
    return [
        at_most(f"{best.name}: held-out rms of {angle}", float(rms), most, "arcsec")
        for (angle, most), rms in zip(MOST_ARCSEC.items(), best.rms_arcsec, strict=True)
    ]


def text_of(steps: list[Step], count: int, seed: int) -> str:
    """Text of the measured part of the page."""
    rows = [
        (
            each.name,
            str(each.unknowns),
            *(f"{value:.3f}" for value in each.rms_arcsec),
            str(int(np.sum(~each.fitted.used))),
        )
        for each in steps
    ]
    head = ("model", "unknowns", "y angle, arcsec", "z angle, arcsec", "left out as wrong")
    record = record_of(SOURCES)
    return f"""{table(head, rows, numbers=4)}

{count} rows of 2020; rms of residuals of rows that the fit had not seen, {FOLDS} folds,
{RUNS} times with other folds. "Left out as wrong": by the fit to all rows.

![Residuals before and after](plots/star-camera.svg)

**What this does not show.** Folds are of rows, and the file does not say which rows are of one
observation. Rows of one observation share an attitude, and that attitude came from this very
camera: what the stars of an observation have in common is in the attitude already. The residuals
are smaller than those against an independent attitude would be.

{record.sentence}
Seed {seed}; again: `python -m {MODULE} --folder FOLDER --write`."""


def paint(folder: Folder, steps: list[Step]) -> None:
    """Draw the residuals over the field: linear, cubic, and with temperature."""
    shown = steps[:3]
    figure = folder.figure(9.0, 4.0)
    axes = figure.subplots(1, len(shown), sharey=True)
    for axis, each, arrow_arcsec in zip(axes, shown, (5.0, 0.5, 0.5), strict=True):
        place = np.degrees(each.fitted.stars.measured_rad)
        off = each.fitted.residual * SIGMA_ARCSEC
        axis.quiver(
            *place.T,
            *off.T,
            angles="xy",
            scale=arrow_arcsec / 0.12,
            scale_units="xy",
            width=0.002,
            rasterized=True,
            color="#2a6f97",
        )
        axis.set_title(f"{each.name}\n(0.12 deg is {arrow_arcsec} arcsec)", fontsize=10)
        axis.set_xlabel("y angle, deg")
        axis.set_aspect("equal")
    axes[0].set_ylabel("z angle, deg")
    folder.save(figure, "star-camera")


def write(text: str, steps: list[Step]) -> None:
    """Write the measured part into the page, and the picture."""
    start, end = f"<!-- measured by {MODULE} -->", "<!-- end of star camera -->"
    before, _, rest = DOCUMENT.read_text(encoding="utf-8").partition(start)
    part = f"{start}\n\n{text}\n\n{end}"
    DOCUMENT.write_text(before + part + rest.partition(end)[2], encoding="utf-8")
    for name, picture in pictures_of("star camera", lambda into: paint(into, steps)).items():
        (PLOTS / name).write_text(picture, encoding="utf-8")


def main() -> int:
    """Command that measures, prints, and writes the page on request; 1 if out of bounds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help=f"holds {FILE}")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--write", action="store_true", help="the section of docs/calibration.md")
    parsed = parser.parse_args()
    steps = measured(parsed.folder, RUNS, parsed.seed)
    figures: dict[str, Any] = {
        each.name: ", ".join(f"{value:.4f}" for value in each.rms_arcsec) for each in steps
    }
    report = Report("star camera distortion", figures, bounds_of(steps))
    print(report.text())
    if parsed.write:
        write(text_of(steps, len(steps[0].fitted.stars), parsed.seed), steps)
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
