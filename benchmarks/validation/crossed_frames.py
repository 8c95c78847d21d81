"""Frames of a camera behind crossed wires, through the core of the service, held against truth.

    python -m benchmarks.validation.crossed_frames --frames 200 --seed 3    a quarter of an hour
    python -m benchmarks.validation.crossed_frames --write                  into docs/frames.md

The frames are those of `benchmarks.validation.frames`, through two wires each way, and the
mission's camera says so.  A tenth of them is measured once more by a camera that takes its
stars for Gaussian.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, at_most, between
from benchmarks.record import CORE, IMAGING, record_of
from benchmarks.report import Report
from benchmarks.sections import bounds_table, tables_of
from benchmarks.validation.frames import (
    CROSSED,
    DOCUMENT,
    FOUND_PX,
    PRIORS,
    SEPARATE_PX,
    SPACECRAFT,
    Measured,
    measured_frame,
)
from service.features.pictures.centroids.centroid import METHODS
from service.features.pictures.detection.detect import detect
from service.features.pictures.detection.measure import measure
from service.features.pictures.detection.star_images import psf_of
from service.features.pictures.frames.frame import Frame
from service.features.pictures.tracker.simulated import DrawnFrame, FrameSettings, draw_frames
from service.missions.camera import CentroidMethod, PsfKind
from service.missions.mission import Mission, load_missions
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel

FRAMES, QUICK_FRAMES = 200, 3
CHUNK = 2
COMPARED_EVERY = 10
FOUND_LEAST = 0.99
SPREAD = (0.9, 1.1)
SOURCES = (
    *CORE,
    *IMAGING,
    "service/features/pictures/tracker/simulated.py",
    "benchmarks/validation/frames.py",
)

Errors = dict[str, list[float]]


@dataclass
class CrossedFrame:
    """Result of one frame: figures of the core, and positions by each method.

    `errors` are errors along u and v of separate stars over their sigmas.  `naive_errors_px` are
    those of a camera without a model of the wires, in pixels.
    """

    whole: Measured
    errors: Errors
    naive_missed: int | None = None
    naive_stars: int = 0
    naive_errors_px: list[float] | None = None


@cache
def _sky() -> SkyModel:
    return SkyModel(load_embedded(), LruCache(256 << 20))


def mission_with(psf: PsfKind) -> Mission:
    """Shipped mission with another point spread function."""
    mission = load_missions()[SPACECRAFT]
    tracker, camera = mission.camera_tracker(None, "tracker")
    other = tracker.model_copy(update={"camera": camera.model_copy(update={"psf": psf})})
    return mission.model_copy(update={"trackers": (other,)})


def run(quick: bool, seed: int) -> Report:
    """Benchmark of frames behind crossed wires."""
    return measured_report(QUICK_FRAMES if quick else FRAMES, seed, os.cpu_count() or 1)


def measured_report(frames: int, seed: int, processes: int) -> Report:
    """All figures, and their bounds."""
    starts = range(0, frames, CHUNK)
    tasks = [(seed, frames, list(range(k, min(k + CHUNK, frames)))) for k in starts]
    found: list[CrossedFrame] = []
    with (
        ProcessPoolExecutor(min(processes, len(tasks)), get_context("spawn")) as pool,
        tqdm(total=frames, desc="crossed frames", unit="frame") as bar,
    ):
        for chunk in pool.map(_chunk, tasks):
            found += chunk
            bar.update(len(chunk))
    return _report(found)


def _chunk(task: tuple[int, int, list[int]]) -> list[CrossedFrame]:
    seed, frames, numbers = task
    mission = mission_with("cross")
    drawn = draw_frames(mission, _sky(), FrameSettings(frames=frames, seed=seed), numbers)
    return [
        _measured(each, mission, number % COMPARED_EVERY == 0)
        for number, each in zip(numbers, drawn, strict=True)
    ]


def _measured(drawn: DrawnFrame, mission: Mission, compared: bool) -> CrossedFrame:
    whole = measured_frame(drawn, mission, _sky(), timed=False)
    errors: Errors = {}
    for method, (_, placed) in _placed(drawn, mission, METHODS).items():
        errors[method] = (placed[:, :2] / placed[:, 2:]).ravel().tolist()
    found = CrossedFrame(whole, errors)
    if compared:
        # Use all candidates: a camera without wires has no reason to reject any.
        (missed, placed), *_ = _placed(drawn, mission_with("gaussian"), ("scan",)).values()
        found.naive_missed = missed
        found.naive_stars = whole.stars - whole.hidden
        found.naive_errors_px = np.hypot(placed[:, 0], placed[:, 1]).tolist()
    return found


def _placed(
    drawn: DrawnFrame, mission: Mission, methods: Sequence[CentroidMethod]
) -> dict[str, tuple[int, np.ndarray]]:
    """Number of stars missed or without position, and errors of separate stars, by method.

    Errors in u and v and their sigmas, (n, 4) in pixels.
    """
    tracker, camera = mission.camera_tracker(None, "tracker")
    frame = Frame(drawn.counts.astype(np.float32), "FITS", "sha256:0", 65535.0)
    rates = np.array(drawn.known["body_rates_deg_per_s"])
    found = detect(frame, camera, psf_of(camera, tracker, rates, drawn.exposure_s))
    u, v, magnitude = (
        np.array([star[name] for star in drawn.truth["stars"]])
        for name in ("u_px", "v_px", "magnitude")
    )
    inside = (u >= 0) & (u <= camera.width_px - 1) & (v >= 0) & (v <= camera.height_px - 1)
    near = np.hypot(u - u[:, None], v - v[:, None]) < SEPARATE_PX
    hidden = (near & (magnitude[None, :] < magnitude[:, None])).any(axis=1)
    limit = mission.catalog.magnitude_limit_mag
    asked = inside & ~hidden & (magnitude <= limit)
    told = {}
    for method in methods:
        stars = measure(frame, found, tracker, camera, rates, method, limit + 0.5)
        records = [star.record for star in stars if star.left_out is None]
        at_u = np.array([record.u_px for record in records])
        at_v = np.array([record.v_px for record in records])
        away = np.hypot(at_u - u[:, None], at_v - v[:, None])
        missed = int(np.count_nonzero(away.min(axis=1, initial=1e9)[asked] > FOUND_PX))
        rows = []
        for record in records:
            apart = np.hypot(u - record.u_px, v - record.v_px)
            k = int(apart.argmin())
            alone = np.count_nonzero(apart < 2.0 * SEPARATE_PX) == 1
            if apart[k] <= FOUND_PX and alone and not record.flags:
                rows.append(
                    (record.u_px - u[k], record.v_px - v[k], record.sigma_u_px, record.sigma_v_px)
                )
        told[str(method)] = missed, np.array(rows).reshape(-1, 4)
    return told


def _report(found: Sequence[CrossedFrame]) -> Report:
    whole = [each.whole for each in found]
    stars, hidden = (sum(getattr(each, name) for each in whole) for name in ("stars", "hidden"))
    missed = sum(len(each.missed) for each in whole)
    share = 1.0 - missed / max(stars - hidden, 1)
    figures: dict[str, object] = {
        "frames": len(found),
        "stars to V 6.5 that are not part of a brighter one's image": stars - hidden,
        "missed": missed,
        "stars in batches": sum(each.used for each in whole),
        "of these no star, or a piece of a tail": sum(each.false for each in whole),
    }
    bounds: list[Bound] = [at_least("share of the stars found", share, FOUND_LEAST)]
    for method in METHODS:
        errors = np.concatenate([each.errors[method] for each in found])
        figures[f"{method}: stars that stand alone"] = len(errors) // 2
        figures[f"{method}: error over sigma, central 68.3 %"] = float(
            np.quantile(np.abs(errors), 0.6827)
        )
        spread = float(np.sqrt((errors**2).mean()))
        bounds.append(between(f"{method}: error over sigma, rms", spread, *_slack(len(errors))))
    for prior in PRIORS:
        solved = [each.solved[prior] for each in whole if prior in each.solved]
        right = sum(each.right and not each.suspect for each in solved)
        figures[f"prior {prior}: good attitude, and right"] = f"{right} of {len(solved)}"
        figures[f"prior {prior}: stars named, and wrongly"] = (
            f"{sum(each.unique for each in solved):,}, {sum(each.misnamed for each in solved)}"
        )
        bounds.append(at_least(f"prior {prior}: right", right, len(solved)))
        wrong = sum(each.attitude and not each.suspect and not each.right for each in solved)
        bounds.append(at_most(f"prior {prior}: good, and wrong", wrong, 0))
    return Report("crossed_frames", figures | _naive(found), bounds)


def _slack(errors: int) -> tuple[float, float]:
    """Limits of the spread, wider by four standard errors if there are few errors."""
    more = max(0.0, 4.0 / np.sqrt(2.0 * errors) - 0.1)
    return SPREAD[0] - more, SPREAD[1] + more


def _naive(found: Sequence[CrossedFrame]) -> dict[str, object]:
    """Figures of a camera that takes its stars for Gaussian."""
    compared = [each for each in found if each.naive_errors_px is not None]
    stars = sum(each.naive_stars for each in compared)
    missed = sum(each.naive_missed or 0 for each in compared)
    errors = np.concatenate([each.naive_errors_px or [] for each in compared])
    return {
        "of a camera that says gaussian, `scan`: stars without a place": (
            f"{missed} of {stars} on {len(compared)} frames"
        ),
        "the same: largest error, arcsec": float(errors.max(initial=0.0)) * 35.2,
    }


def document(report: Report, seed: int) -> str:
    """Section of docs/frames.md."""
    verdict = "Everything is within its bounds." if report.passed else "**Out of bounds.**"
    record = record_of(SOURCES)
    frames = report.figures["frames"]
    return f"""## Frames behind crossed wires

Written by
`python -m benchmarks.validation.crossed_frames --frames {frames} --seed {seed} --write`;
its figures are not edited by hand. {verdict}
{record.sentence}
<!-- {record} -->

The frames are those above with one difference: two wires each way, a tenth of
the aperture wide, stand before the lens, and every star is a cross whose arms reach 90 pixels far.
The mission's camera has `psf = "cross"` ([missions.md](missions.md#the-image-of-a-star)); its stars
are taken off the frame one behind the other before the next ones are looked for, and each is placed
by the shape of the cross, with the arms of all others as its background. All light is of one
colour, which the camera assumes too; for light of many colours a camera has a `band_nm`
([missions.md](missions.md#light-of-many-colours) has the figures).

{tables_of(report.figures)}

{bounds_table(report.bounds)}
"""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.validation.crossed_frames",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--frames", type=int, default=FRAMES, metavar="N", help="default 200")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="default 1")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="N")
    parser.add_argument("--write", action="store_true", help="write it into docs/frames.md")
    asked = parser.parse_args(arguments)
    report = measured_report(asked.frames, asked.seed, asked.processes)
    print(report.text())
    if asked.write:
        above = DOCUMENT.read_text("utf-8").partition(CROSSED)[0]
        text = f"{above}{CROSSED}\n{document(report, asked.seed)}"
        DOCUMENT.write_text(text, encoding="utf-8")
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
