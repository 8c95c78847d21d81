"""Frames through the whole service's core: found, placed, identified, solved, held against truth.

    python -m benchmarks.validation.frames --frames 1000 --seed 3    ten minutes on two cores
    python -m benchmarks.validation.frames --write                   docs/frames.md, its picture

Every frame is drawn from the real sky with all its noise (`pictures.tracker.simulated`), written
as FITS and read again.  The batch made of it goes through the pipeline twice: with an a priori
attitude good to 1 deg, and with none.
"""

import argparse
import contextlib
import io
import json
import math
import os
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from multiprocessing import get_context
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, at_most, between
from benchmarks.record import CORE, IMAGING, ROOT, record_of
from benchmarks.report import Report
from benchmarks.sections import bounds_table, tables_of
from service.acquire import Acquisition, acquire
from service.errors import NotAvailable
from service.features.pictures.detection.detect import detect, detection_kernel
from service.features.pictures.frames.files import frame_digest, read_frame
from service.features.pictures.frames.frame import Frame, FrameLimits
from service.features.pictures.tracker.overlay import draw_overlay, marks_of
from service.features.pictures.tracker.simulated import (
    DrawnFrame,
    FrameSettings,
    draw_frames,
    frame_bytes,
)
from service.features.pictures.tracker.submit import read_known, submission_of_frame
from service.missions.camera import Camera
from service.missions.mission import Mission, load_missions
from service.observations.schema import Submission, submission_from_json
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.storage.recording.answer import answer_of
from service.vectors import attitude_error_arcsec, matrix_from_quaternion

SPACECRAFT = "IMAGER"
FRAMES, QUICK_FRAMES = 1000, 10
CHUNK = 5
TIMED_EVERY = 20
REPEATS = 5
PRIORS = ("within 1 deg", "none")

FOUND_PX = 2.0
"""Greatest distance in pixels between a candidate and the true position of its star."""
SEPARATE_PX = 3.0
"""Distance in pixels below which a brighter star hides a star: both are one image."""
RIGHT_ARCSEC = (30.0, 30.0, 300.0)
"""Greatest error of a right attitude about the frame's axes and its boresight."""

COMPLETE_LEAST = 0.999
RIGHT_LEAST = 0.995
SPREAD = (0.85, 1.15)
DETECTION_MOST = 1.5

DOCUMENT = ROOT / "docs" / "frames.md"
CROSSED = "\n<!-- crossed wires -->\n"
"""Line of the page before the section that `crossed_frames` writes."""
PICTURE = ROOT / "docs" / "images" / "overlay.png"


SOURCES = (*CORE, *IMAGING, "service/features/pictures/tracker/simulated.py")


@dataclass
class Solved:
    """Result of one frame with one kind of a priori knowledge."""

    attitude: bool = False
    suspect: bool = False
    right: bool = False
    unique: int = 0
    misnamed: int = 0
    identify_us: int = 0
    normalised: list[float] = field(default_factory=list)
    """Errors about the three axes over their predicted sigmas."""
    square: float = 0.0
    """Value of e^T P^-1 e of the attitude."""
    taste: float = 0.0
    freedom: int = 0


@dataclass
class Measured:
    """Result of one frame."""

    stars: int
    hidden: int
    missed: list[float]
    false: int
    used: int
    placed: list[tuple[float, float, float]]
    """Errors of each separate star: u and v over sigma, and magnitude."""
    steps_us: Mapping[str, int]
    solved: Mapping[str, Solved]
    ratio: float | None = None


def run(quick: bool, seed: int) -> Report:
    """Benchmark of frames."""
    return measured_report(QUICK_FRAMES if quick else FRAMES, seed, os.cpu_count() or 1)


def measured_report(frames: int, seed: int, processes: int) -> Report:
    """All figures, and their bounds."""
    starts = range(0, frames, CHUNK)
    tasks = [(seed, frames, list(range(k, min(k + CHUNK, frames)))) for k in starts]
    found: list[Measured] = []
    with (
        ProcessPoolExecutor(min(processes, len(tasks)), get_context("spawn")) as pool,
        tqdm(total=frames, desc="frames", unit="frame") as bar,
    ):
        for chunk in pool.map(_chunk, tasks):
            found += chunk
            bar.update(len(chunk))
    return _report(found)


@cache
def _house() -> tuple[SkyModel, Mission]:
    return SkyModel(load_embedded(), LruCache(256 << 20)), load_missions()[SPACECRAFT]


def _chunk(task: tuple[int, int, list[int]]) -> list[Measured]:
    seed, frames, numbers = task
    sky, mission = _house()
    settings = FrameSettings(frames=frames, seed=seed)
    drawn = draw_frames(mission, sky, settings, numbers)
    return [
        measured_frame(each, mission, sky, number % TIMED_EVERY == 0)
        for number, each in zip(numbers, drawn, strict=True)
    ]


def measured_frame(drawn: DrawnFrame, mission: Mission, sky: SkyModel, timed: bool) -> Measured:
    _, camera = mission.camera_tracker(None, "tracker")
    file = io.BytesIO(frame_bytes(drawn))
    frame = read_frame(file, FrameLimits(camera.width_px * camera.height_px))
    found = detect(frame, camera)
    truth = [np.array([star[name] for star in drawn.truth["stars"]]) for name in _TRUTH]
    u, v, magnitude = truth
    inside = (u >= 0) & (u <= camera.width_px - 1) & (v >= 0) & (v <= camera.height_px - 1)
    asked = inside & (magnitude <= mission.catalog.magnitude_limit_mag)
    hidden = asked & _hidden(u, v, magnitude)
    nearest = np.hypot(found.u_px - u[:, None], found.v_px - v[:, None]).min(axis=1, initial=1e9)
    missed = asked & ~hidden & (nearest > FOUND_PX)

    known = read_known(drawn.known)
    pixels = camera.width_px * camera.height_px
    submission = submission_of_frame(file, frame_digest(file), known, mission, pixels)
    assert submission.frame is not None
    used = [star for star in submission.frame.stars if star["used"]]
    placed, false = _against_truth(used, u, v, magnitude)
    solved = {PRIORS[0]: _solved(submission, mission, sky, drawn, used)}
    with contextlib.suppress(NotAvailable):
        solved[PRIORS[1]] = _solved(_without_prior(submission), mission, sky, drawn, used)
    return Measured(
        stars=int(asked.sum()),
        hidden=int(hidden.sum()),
        missed=magnitude[missed].tolist(),
        false=false,
        used=len(used),
        placed=placed,
        steps_us=submission.frame.timings_us,
        solved=solved,
        ratio=_ratio_to_sep(frame, camera) if timed else None,
    )


_TRUTH = ("u_px", "v_px", "magnitude")


def _hidden(u: Any, v: Any, magnitude: Any) -> Any:
    """Mask of the stars whose image is part of a brighter one's."""
    near = np.hypot(u - u[:, None], v - v[:, None]) < SEPARATE_PX
    brighter = magnitude[None, :] < magnitude[:, None]
    return (near & brighter).any(axis=1)


def _against_truth(
    used: Sequence[Mapping[str, Any]], u: Any, v: Any, magnitude: Any
) -> tuple[list[tuple[float, float, float]], int]:
    """Normalised errors of separate stars, and number of detections without a true star."""
    placed, false = [], 0
    for star in used:
        away = np.hypot(u - star["u_px"], v - star["v_px"])
        nearest = int(np.argmin(away))
        if away[nearest] > FOUND_PX:
            false += 1
        elif np.count_nonzero(away < 2.0 * SEPARATE_PX) == 1 and not star["flags"]:
            placed.append(
                (
                    float(star["u_px"] - u[nearest]) / star["sigma_u_px"],
                    float(star["v_px"] - v[nearest]) / star["sigma_v_px"],
                    float(star["magnitude"] - magnitude[nearest]),
                )
            )
    return placed, false


def _without_prior(submission: Submission) -> Submission:
    told = json.loads(submission.text) | {"a_priori": None}
    return submission_from_json(json.dumps(told))


def _solved(
    submission: Submission,
    mission: Mission,
    sky: SkyModel,
    drawn: DrawnFrame,
    used: Sequence[Mapping[str, Any]],
) -> Solved:
    acquisition = acquire(submission.batch, mission, sky)
    solved = Solved(
        unique=acquisition.counts["unique"],
        misnamed=_misnamed(acquisition, drawn, used),
        identify_us=acquisition.timings_us["identify"],
    )
    solution = acquisition.solution
    if solution is None:
        return solved
    solved.attitude, solved.suspect = True, solution.suspect
    error = attitude_error_arcsec(
        matrix_from_quaternion(solution.quaternion),
        matrix_from_quaternion(drawn.truth["quaternion"]),
    )
    solved.right = bool((np.abs(error) <= RIGHT_ARCSEC).all())
    covariance = solution.covariance_arcsec2
    solved.normalised = (error / np.sqrt(np.diag(covariance))).tolist()
    solved.square = float(error @ np.linalg.solve(covariance, error))
    solved.taste, solved.freedom = solution.taste, solution.degrees_of_freedom
    return solved


def _misnamed(
    acquisition: Acquisition, drawn: DrawnFrame, used: Sequence[Mapping[str, Any]]
) -> int:
    """Number of stars identified as unique whose true position is far away."""
    (tracker,) = acquisition.trackers
    names = {star["id"]: (star["u_px"], star["v_px"]) for star in drawn.truth["stars"]}
    wrong = 0
    for k in np.flatnonzero(tracker.identification.unique).tolist():
        name = acquisition.run_catalog.star_id[int(tracker.identification.star[k])]
        at = names.get(name)
        star = used[k]
        near = at and math.hypot(at[0] - star["u_px"], at[1] - star["v_px"]) < SEPARATE_PX
        wrong += not near
    return wrong


def _ratio_to_sep(frame: Frame, camera: Camera) -> float:
    """Processor time of the service's detection over SEP's on the same frame, least of several."""
    import sep

    ours, theirs = [], []
    kernel = detection_kernel(camera)
    for _ in range(REPEATS):
        began = time.process_time()
        detect(frame, camera)
        ours.append(time.process_time() - began)
        began = time.process_time()
        light = frame.counts.copy()
        background = sep.Background(light)
        background.subfrom(light)
        sep.extract(
            light,
            camera.threshold_sigma,
            err=background.globalrms,
            minarea=3,
            filter_kernel=kernel,
        )
        theirs.append(time.process_time() - began)
    return min(ours) / min(theirs)


def _report(found: Sequence[Measured]) -> Report:
    figures: dict[str, Any] = {"frames": len(found)}
    bounds: list[Bound] = []
    stars = sum(each.stars for each in found)
    hidden = sum(each.hidden for each in found)
    missed = sum(len(each.missed) for each in found)
    complete = 1.0 - missed / max(stars - hidden, 1)
    figures |= {
        "stars to V 6.5 on them": stars,
        "of these part of a brighter star's image": hidden,
        "of the others found": stars - hidden - missed,
        "missed": missed,
        "stars in batches": sum(each.used for each in found),
        "of these hot pixels, cosmic rays or noise": sum(each.false for each in found),
    }
    bounds.append(at_least("share of the stars found", complete, COMPLETE_LEAST))
    placed = np.array([star for each in found for star in each.placed])
    errors = np.sqrt((placed[:, :2] ** 2).mean())
    figures |= {
        "stars that stand alone": len(placed),
        "their place's error over its sigma, rms": float(errors),
        "the same, central 68.3 %": float(np.quantile(np.abs(placed[:, :2]), 0.6827)),
        "their magnitude's error, rms": float(np.sqrt((placed[:, 2] ** 2).mean())),
    }
    bounds.append(between("their place's error over its sigma, rms", float(errors), *SPREAD))
    for prior in found[0].solved:
        _add_attitudes(figures, bounds, prior, [each.solved[prior] for each in found])
    _add_times(figures, bounds, found)
    return Report("frames", figures, bounds)


def _add_attitudes(
    figures: dict[str, Any], bounds: list[Bound], prior: str, solved: Sequence[Solved]
) -> None:
    count = len(solved)
    good = [each for each in solved if each.attitude and not each.suspect]
    right = sum(each.right for each in good) / count
    wrong = sum(not each.right for each in good)
    about = f"prior {prior}"
    figures |= {
        f"{about}: good attitude, and right": f"{right:.2%}",
        f"{about}: good attitude, and wrong": wrong,
        f"{about}: suspect": sum(each.suspect for each in solved),
        f"{about}: none": sum(not each.attitude for each in solved),
        f"{about}: stars named, and wrongly": (
            f"{sum(each.unique for each in solved):,}, {sum(each.misnamed for each in solved)}"
        ),
    }
    bounds.append(at_least(f"{about}: good attitude, and right, share", right, RIGHT_LEAST))
    bounds.append(at_most(f"{about}: good attitude, and wrong", wrong, 0))
    if good:
        normalised = np.array([each.normalised for each in good])
        spread = np.sqrt((normalised**2).mean(axis=0))
        square = float(np.mean([each.square for each in good])) / 3.0
        taste = sum(each.taste for each in good) / sum(each.freedom for each in good)
        figures |= {
            f"{about}: errors about x, y, z over their sigmas, rms": " ".join(
                f"{each:.3f}" for each in spread
            ),
            f"{about}: e^T P^-1 e over 3": square,
            f"{about}: TASTE over its degrees of freedom": taste,
        }
        # Of a thousand values of chi-square with three degrees the mean scatters by 2.6 %.
        slack = 4.0 * math.sqrt(2.0 / 3.0 / len(good))
        within = SPREAD[0] ** 2 - slack, SPREAD[1] ** 2 + slack
        bounds.append(between(f"{about}: e^T P^-1 e over 3", square, *within))
    figures[f"{about}: identify, median ms"] = (
        float(np.median([each.identify_us for each in solved])) / 1000.0
    )


def _add_times(figures: dict[str, Any], bounds: list[Bound], found: Sequence[Measured]) -> None:
    for step in ("read", "detect", "centroid"):
        median = float(np.median([each.steps_us[step] for each in found])) / 1000.0
        figures[f"{step}, median ms"] = median
    ratios = [each.ratio for each in found if each.ratio is not None]
    ratio = float(np.median(ratios))
    figures["detection over SEP's own on the same frame"] = ratio
    bounds.append(at_most("detection over SEP's own on the same frame", ratio, DETECTION_MOST))


def document(report: Report, seed: int) -> str:
    """Text of docs/frames.md."""
    verdict = "Everything is within its bounds." if report.passed else "**Out of bounds.**"
    lost = ", and once more lost in space" if f"prior {PRIORS[1]}: none" in report.figures else ""
    record = record_of(SOURCES)
    return f"""# Frames

For engineers who send frames: how well stars are found, placed and identified on simulated ones.
Written by
`python -m benchmarks.validation.frames --frames {report.figures["frames"]} --seed {seed} --write`;
its figures are not edited by hand. {verdict}
{record.sentence}
<!-- {record} -->

Each frame is drawn from the real sky as the shipped mission IMAGER sees it: 1024 x 1024 pixels of
35 arcsec, 10 deg a side. Every star of the catalog shines, to V 9, at its own place and time, with
proper motion, parallax and aberration, through a distorting lens, drawn out by the body's rates (up
to 0.02 deg/s about each axis). To that come the uneven response of the pixels, photon noise of
stars, sky and dark current, 200 hot pixels, cosmic rays, the noise of reading, full pixels, and
whole counts. The frame is written as FITS and read again, its stars are found, placed (`matched`)
and made a batch, and the batch goes through the pipeline: with an a priori attitude that is up to
1 deg off{lost}.

A star to V 6.5 counts as found where a candidate lies within {FOUND_PX:g} pixels of its true place,
unless its image is part of a brighter star's (nearer than {SEPARATE_PX:g} pixels). An attitude is
right within {RIGHT_ARCSEC[0]:g} arcsec across the boresight and {RIGHT_ARCSEC[2]:g} about it: some
hundred sigmas, and far less than any false star would move it by.

{tables_of(report.figures)}

{bounds_table(report.bounds)}

![A frame with its stars, their names and residual arrows](images/overlay.png)
"""


def picture(seed: int, frames: int) -> bytes:
    """Image of the first frame's overlay."""
    sky, mission = _house()
    tracker, camera = mission.camera_tracker(None, "tracker")
    (drawn,) = draw_frames(mission, sky, FrameSettings(frames=frames, seed=seed), [0])
    file = io.BytesIO(frame_bytes(drawn))
    known = read_known(drawn.known)
    pixels = camera.width_px * camera.height_px
    submission = submission_of_frame(file, frame_digest(file), known, mission, pixels)
    record = submission.frame
    assert record is not None
    answer = answer_of(acquire(submission.batch, mission, sky), id=None)
    detections = {"stars": list(record.stars), "hot_or_cosmic_px": record.sharp}
    run_catalog = sky.run_catalog(mission, submission.batch.time)
    marks = marks_of(answer, submission.batch, tracker, camera, detections, run_catalog)
    title = f"{mission.name} {tracker.name}  {submission.batch.batch}  {submission.batch.time.text}"
    return draw_overlay(record.preview, record.preview_step, marks, title)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.validation.frames",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--frames", type=int, default=FRAMES, metavar="N", help="default 1000")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="default 1")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="N")
    parser.add_argument("--write", action="store_true", help="write docs/frames.md")
    asked = parser.parse_args(arguments)
    report = measured_report(asked.frames, asked.seed, asked.processes)
    print(report.text())
    if asked.write:
        crossed = "".join(DOCUMENT.read_text("utf-8").partition(CROSSED)[1:])
        DOCUMENT.write_text(document(report, asked.seed) + crossed, encoding="utf-8")
        PICTURE.write_bytes(picture(asked.seed, asked.frames))
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
