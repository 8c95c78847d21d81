"""Cameras calibrated from ten drawn pictures of which nothing is known, held against the truth.

    python -m benchmarks.validation.pictures.calibrations --runs 100 --seed 5
    ... --write                        into docs/cameras.md

Every run draws a lens of 5 to 50 degrees with up to 3 % of distortion and its axis off the middle,
and ten pictures with it, JPEG of quality 70.  They are solved and the camera is fitted as
`acquire camera calibrate` does.  What is done is kept in a file: a run goes on from there.
"""

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import at_least, between
from benchmarks.record import record_of
from benchmarks.report import Report
from benchmarks.validation.pictures.document import SOURCES, write_part
from service.features.pictures.blind.lens import Lens
from service.features.pictures.blind.picture import PictureResult, blind_sky, solve_picture
from service.features.pictures.blind.solver import focal_px_of, rotation_between
from service.features.pictures.camera_calibration import CameraCalibration, calibrate_camera
from service.features.pictures.frames.frame import Frame
from service.sky.catalog.star_catalog import load_embedded
from tests.features.pictures.drawn import SIZES, DrawnPicture, draw_picture

RUNS, QUICK_RUNS, PICTURES, YEAR = 100, 3, 10, 2020
WITHIN_SIGMAS, WITHIN_LEAST = 3.0, 0.97


@dataclass(frozen=True)
class Calibrated:
    """A run: what was claimed, and what is so.

    `pull` is the error of the focal length over its sigma.  `noise_px` is the rms of the true
    errors of the places of stars, per axis, `residual_px` that of what the fit leaves of them,
    `told_px` of what was predicted.  `lens_px` is the rms, over the sensor, of the fitted
    lens's errors, the attitude freed.
    """

    number: int
    pictures: int
    stars: int
    focal_error: float
    pull: float
    noise_px: float
    residual_px: float
    told_px: float
    lens_px: float


def run(quick: bool, seed: int) -> Report:
    """The benchmark among the others."""
    return _report(calibrated(QUICK_RUNS if quick else RUNS, seed, None))


def calibrated(runs: int, seed: int, log: Path | None) -> list[Calibrated]:
    """All runs; those in the file `log` are not made again."""
    kept = log.read_text(encoding="utf-8") if log is not None and log.exists() else ""
    found = [Calibrated(**json.loads(line)) for line in kept.splitlines()]
    done = {each.number for each in found}
    for number in tqdm([each for each in range(runs) if each not in done], desc="calibrations"):
        found.append(_one(seed, number))
        if log is not None:
            with log.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(found[-1])) + "\n")
    return found


def _one(seed: int, number: int) -> Calibrated:
    rng = np.random.default_rng((seed, number))
    sky, solver = blind_sky(load_embedded(), YEAR)
    lens = _lens(rng)
    used, drawn = [], []
    guess_px = None
    for _ in range(PICTURES):
        picture = draw_picture(rng, sky, lens=lens)
        frame = Frame(picture.counts.astype(np.float32), "NPY", "sha256:0", 255.0)
        result = solve_picture(frame, sky, solver, guess_px)
        if result.attitude is not None:
            guess_px = guess_px or result.attitude.lens.focal_px
            used.append(result)
            drawn.append(picture)
    rows = [[star.row for star in each.attitude.stars] for each in used if each.attitude]
    found = calibrate_camera(used, [sky.direction[each] for each in rows])
    log_focal = math.log(found.lens.focal_px / lens.focal_px)
    return Calibrated(
        number=number,
        pictures=len(used),
        stars=len(found.place_px),
        focal_error=log_focal,
        pull=log_focal / found.sigma(0),
        noise_px=_noise_px(found, used, drawn, sky.direction),
        residual_px=found.rms_px[1],
        told_px=found.centroid_sigma_px,
        lens_px=_lens_error_px(found.lens, lens),
    )


def _lens(rng: np.random.Generator) -> Lens:
    width, height = SIZES[rng.integers(len(SIZES))]
    focal_px = focal_px_of(width, float(np.exp(rng.uniform(np.log(5.0), np.log(50.0)))))
    return Lens(width, height, focal_px, rng.uniform(-0.03, 0.03), *rng.normal(0.0, 0.01, 2))


def _noise_px(
    found: CameraCalibration,
    used: Sequence[PictureResult],
    drawn: Sequence[DrawnPicture],
    direction: Any,
) -> float:
    """The rms per axis of the errors of the places of the stars that the fit kept."""
    kept = {(u, v) for u, v in found.place_px.tolist()}
    errors = []
    for result, picture in zip(used, drawn, strict=True):
        stars = result.attitude.stars if result.attitude else ()
        true = picture.lens.places(direction[[star.row for star in stars]] @ picture.attitude.T)
        for star, u, v in zip(stars, *(each.tolist() for each in true), strict=True):
            if (star.u_px, star.v_px) in kept:
                errors += [star.u_px - u, star.v_px - v]
    return float(np.sqrt(np.mean(np.square(errors))))


def _lens_error_px(found: Lens, truth: Lens) -> float:
    across, down = np.linspace(0, truth.width_px - 1, 12), np.linspace(0, truth.height_px - 1, 12)
    u, v = (each.ravel() for each in np.meshgrid(across, down))
    seen, true = found.directions(u, v), truth.directions(u, v)
    apart = seen - true @ rotation_between(seen, true).T
    return float(np.sqrt((apart**2).sum(axis=1).mean() / 2.0)) * truth.focal_px


def _report(found: Sequence[Calibrated]) -> Report:
    def column(name: str) -> Any:
        return np.array([getattr(each, name) for each in found], dtype=float)

    within = np.abs(column("pull")) < WITHIN_SIGMAS
    residual = column("residual_px") / column("noise_px")
    figures = {
        "cameras": len(found),
        "pictures used of each, least and mean": "{:.0f}, {:.1f}".format(
            column("pictures").min(), column("pictures").mean()
        ),
        "stars of each, median": round(float(np.median(column("stars")))),
        "focal length off, median and 90 %": _percent(np.abs(column("focal_error"))),
        "focal length off over its sigma, rms": float(np.sqrt(np.mean(column("pull") ** 2))),
        "focal length within 3 claimed sigmas": f"{within.sum()} of {len(found)}",
        "errors of places, px rms, median": float(np.median(column("noise_px"))),
        "residuals, px rms, median": float(np.median(column("residual_px"))),
        "predicted errors of places, px rms, median": float(np.median(column("told_px"))),
        "residuals over errors of places, least, median, most": ", ".join(
            f"{each:.3f}" for each in (residual.min(), np.median(residual), residual.max())
        ),
        "fitted lens over the sensor, px rms, median and most": "{:.3f}, {:.3f}".format(
            np.median(column("lens_px")), column("lens_px").max()
        ),
    }
    bounds = [
        at_least("focal length within 3 claimed sigmas", float(within.mean()), WITHIN_LEAST),
        between("residuals over errors of places, median", float(np.median(residual)), 0.9, 1.05),
    ]
    return Report("camera calibration", figures, bounds)


def _percent(values: Any) -> str:
    return "{:.4f} %, {:.4f} %".format(*(100.0 * np.quantile(values, [0.5, 0.9])))


def main() -> int:
    """Measure, print, and write the page if asked to; 1 where a figure is out of bounds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--log", type=Path, help="what is done; default: by the code's digest")
    parser.add_argument("--write", action="store_true", help="the section of docs/cameras.md")
    parsed = parser.parse_args()
    digest = record_of(SOURCES).sources
    log = parsed.log or Path(tempfile.gettempdir()) / f"cameras-{parsed.seed}-{digest}.jsonl"
    report = _report(calibrated(parsed.runs, parsed.seed, log))
    print(report.text())
    if parsed.write:
        write_part("calibrations", report, f"--runs {parsed.runs} --seed {parsed.seed}")
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
