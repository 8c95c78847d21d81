"""What a focal length told wrong costs, and whether an answer is given where there is none.

    python -m benchmarks.validation.pictures.offsets --pictures 500 --seed 77
    ... --folder real-data/pictures    real ones too, whose truth is in truth.json
    ... --write                        into docs/cameras.md

Every drawn or real picture is solved without a focal length, and with one that is off by up to
10 %.  No attitude explains its mirror image, nor points that gather in clusters, along lines and
horizons, in grids and in pairs: each answer to these is a wrong one.
"""

import argparse
import math
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import at_most
from benchmarks.report import Report
from benchmarks.validation.pictures.blind import PICTURES, drawn_picture, is_right, real_pictures
from benchmarks.validation.pictures.document import write_part
from benchmarks.validation.pictures.peers import YEAR, focal_px
from service.features.pictures.blind.picture import blind_sky, solve_picture
from service.features.pictures.blind.solver import WIDEST_FIELD_DEG, FocalRange
from service.features.pictures.blind.verify import Points
from service.features.pictures.frames.frame import Frame
from service.sky.catalog.star_catalog import load_embedded
from service.vectors import Vector, attitude_error_arcsec

MIRRORED = "answers to mirrored pictures that do not call them mirrored"
OFF: tuple[float | None, ...] = (None, 0.0, 0.01, -0.01, 0.02, -0.02, 0.05, -0.05, 0.1, -0.1)
WIDTH_PX, HEIGHT_PX = 1600, 1200
COUNTS = (8, 12, 17, 25, 35, 60, 120, 250)
"""Numbers of points in patterns without a right answer."""

Places = tuple[Vector, Vector]


def run(quick: bool, seed: int) -> Report:
    """Benchmark of wrong focal lengths."""
    return measured(8 if quick else PICTURES, seed, None)


def measured(count: int, seed: int, folder: Path | None) -> Report:
    """Solve drawn pictures, the real ones of a folder, and patterns without an answer."""
    sky, solver = blind_sky(load_embedded(), YEAR)
    outcomes: Counter[tuple[float | None, str]] = Counter()
    lost = lost_told = mirrored = 0
    real = real_pictures(folder) if folder else []
    for number in tqdm(range(len(real) + count), desc="pictures", unit="picture"):
        picture = real[number] if number < len(real) else drawn_picture(seed, number - len(real))
        _, counts, truth, field_deg, _ = picture
        frame = _frame(counts)
        true_px = focal_px(counts.shape[1], field_deg)
        told = []
        for off in OFF:
            guess_px = None if off is None else true_px * (1.0 + off)
            found = solve_picture(frame, sky, solver, guess_px).attitude
            error = None if found is None else attitude_error_arcsec(found.attitude, truth)
            right = error is not None and is_right(error, field_deg)
            told.append("none" if error is None else "right" if right else "wrong")
        outcomes.update(zip(OFF, told, strict=True))
        lost += told[1] == "right" and told.count("right") < len(told)
        lost_told += told[1] == "right" and told[1:].count("right") < len(told) - 1
        result = solve_picture(_frame(counts[:, ::-1]), sky, solver)
        mirrored += result.attitude is not None and not result.frame.is_mirrored
    figures: dict[str, Any] = {"pictures": len(real) + count}
    for off in OFF:
        label = "not told" if off is None else f"off by {100 * off:+.0f} %" if off else "exact"
        figures[f"focal length {label}: right, wrong, none"] = ", ".join(
            str(outcomes[off, each]) for each in ("right", "wrong", "none")
        )
    wrong = sum(number for (_, each), number in outcomes.items() if each == "wrong")
    figures["right with the exact focal length, lost with another or none"] = lost
    figures[MIRRORED] = mirrored
    bounds = [at_most("wrong", wrong, 0), at_most("lost with another", lost_told, 0)]
    bounds.append(at_most(MIRRORED, mirrored, 0))
    rng = np.random.default_rng((seed, 1))
    sets = max(count // 5, 3)
    for draw in SKYLESS:
        answers = 0
        for _ in tqdm(range(sets), desc=draw.__name__, unit="set"):
            answers += solver.solve(_points(rng, draw), _range(rng)).found is not None
        label = f"answers to {sets} sets of {draw.__name__.replace('_', ' ')}"
        figures[label] = answers
        bounds.append(at_most(label, answers, 0))
    return Report("focal lengths told wrong", figures, bounds)


def _frame(counts: Any) -> Frame:
    return Frame(counts.astype(np.float32), "NPY", "sha256:0", 255.0)


def _points(rng: np.random.Generator, draw: Callable[[np.random.Generator, int], Places]) -> Points:
    u_px, v_px = draw(rng, int(rng.choice(COUNTS)))
    inside = (u_px > 0) & (u_px < WIDTH_PX - 1) & (v_px > 0) & (v_px < HEIGHT_PX - 1)
    u_px, v_px = u_px[inside], v_px[inside]
    return Points(u_px, v_px, np.full(len(u_px), rng.uniform(0.1, 0.5)), WIDTH_PX, HEIGHT_PX)


def _range(rng: np.random.Generator) -> FocalRange:
    if rng.random() < 0.5:
        return FocalRange.of_fields(WIDTH_PX, WIDEST_FIELD_DEG)
    return FocalRange.about(10.0 ** rng.uniform(3.1, 4.2), 0.25)


def points_anywhere(rng: np.random.Generator, count: int) -> Places:
    """Uniformly distributed positions (n,), (n,)."""
    return rng.uniform(0.0, WIDTH_PX, count), rng.uniform(0.0, HEIGHT_PX, count)


def clusters(rng: np.random.Generator, count: int) -> Places:
    """Positions in one to five clusters, with a fifth of the points elsewhere."""
    u_px, v_px = points_anywhere(rng, count)
    heaps = int(rng.integers(1, 6))
    of = rng.integers(0, heaps, count)
    middle_u, middle_v = points_anywhere(rng, heaps)
    spread_px = rng.uniform(10.0, 250.0, heaps)[of]
    in_heap = rng.random(count) < 0.8
    u_px[in_heap] = (middle_u[of] + spread_px * rng.standard_normal(count))[in_heap]
    v_px[in_heap] = (middle_v[of] + spread_px * rng.standard_normal(count))[in_heap]
    return u_px, v_px


def streaks(rng: np.random.Generator, count: int) -> Places:
    """Positions along a line with some width."""
    angle = rng.uniform(0.0, math.pi)
    along, across = rng.uniform(-700.0, 700.0, count), rng.normal(0.0, rng.uniform(1, 60), count)
    return (
        WIDTH_PX / 2 + along * math.cos(angle) - across * math.sin(angle),
        HEIGHT_PX / 2 + along * math.sin(angle) + across * math.cos(angle),
    )


def horizons(rng: np.random.Generator, count: int) -> Places:
    """Positions of lights that thin out below a line, with a fifth of the points elsewhere."""
    u_px, v_px = points_anywhere(rng, count)
    low = rng.random(count) < 0.8
    v_px[low] = (rng.uniform(200.0, 1000.0) + rng.exponential(60.0, count))[low]
    return u_px, v_px


def grids(rng: np.random.Generator, count: int) -> Places:
    """Positions on a rotated square grid, each off by half a pixel."""
    side = math.ceil(math.sqrt(count))
    step_px, angle = rng.uniform(20.0, 250.0), rng.uniform(0.0, 1.0)
    i, j = np.indices((side, side)).reshape(2, -1)[:, :count] - side / 2
    u_px = WIDTH_PX / 2 + step_px * (i * math.cos(angle) - j * math.sin(angle))
    v_px = HEIGHT_PX / 2 + step_px * (i * math.sin(angle) + j * math.cos(angle))
    return u_px + rng.normal(0.0, 0.5, len(u_px)), v_px + rng.normal(0.0, 0.5, len(v_px))


def double_points(rng: np.random.Generator, count: int) -> Places:
    """Pairs of positions at a fixed offset, as from a camera that shook."""
    u_px, v_px = points_anywhere(rng, count // 2)
    apart_px, angle = rng.uniform(3.0, 15.0), rng.uniform(0.0, 2.0 * math.pi)
    return (
        np.concatenate([u_px, u_px + apart_px * math.cos(angle)]),
        np.concatenate([v_px, v_px + apart_px * math.sin(angle)]),
    )


SKYLESS = (points_anywhere, clusters, streaks, horizons, grids, double_points)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command that measures, prints, and writes the page on request; 1 if out of bounds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pictures", type=int, default=PICTURES)
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--folder", type=Path, help="of real pictures, with truth.json")
    parser.add_argument("--write", action="store_true", help="the section of docs/cameras.md")
    parsed = parser.parse_args(arguments)
    report = measured(parsed.pictures, parsed.seed, parsed.folder)
    print(report.text())
    if parsed.write:
        real = " --folder FOLDER" if parsed.folder else ""
        write_part("offsets", report, f"--pictures {parsed.pictures} --seed {parsed.seed}{real}")
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
