"""Pictures of cameras of which nothing is known: right, wrong or none, how honest, how fast.

    python -m benchmarks.validation.pictures.blind --pictures 500 --seed 3
    ... --folder real-data/pictures    real ones too, whose truth is in truth.json
    ... --write                        into docs/cameras.md
    PYTHONPATH=peers ...               beside cedar-solve and tetra3rs

Pictures are drawn with random lenses: 5 to 50 degrees, distortion to 3 %, any gain, backgrounds
of which some are clipped to black, JPEG of quality 70.  Every solver is told the field to 10 %, or
nothing.  Times are processor time of all threads of a solver.  The benchmark keeps the answer for
each picture in a file: a run that was stopped goes on from there.
"""

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.stats import chi2
from tqdm import tqdm

from benchmarks.bounds import at_least, at_most
from benchmarks.record import record_of
from benchmarks.report import Report
from benchmarks.validation.pictures.document import SOURCES, write_part
from benchmarks.validation.pictures.peers import YEAR, PictureSolver, solvers
from service.features.pictures.blind.picture import blind_sky
from service.sky.catalog.star_catalog import load_embedded
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector, attitude_error_arcsec
from tests.features.pictures.drawn import draw_picture, middle_attitude

PICTURES, QUICK_PICTURES = 500, 8
TOLD = ("within 10 %", "nothing")
RIGHT_SHARE, RIGHT_ROLL_DEG = 0.01, 1.0
"""Right is a boresight within a share of the field, and a roll within so many degrees."""
QUANTILES = (0.25, 0.5, 0.75, 0.9, 0.99)
RIGHT_LEAST = 0.9


def run(quick: bool, seed: int) -> Report:
    """The benchmark among the others."""
    count = QUICK_PICTURES if quick else PICTURES
    return _report(measured(count, seed, None, solvers(), None))


def measured(
    count: int, seed: int, folder: Path | None, made: Sequence[PictureSolver], log: Path | None
) -> list[dict[str, Any]]:
    """A row for every picture, solver and knowledge; those in the file `log` are not made again."""
    kept = log.read_text(encoding="utf-8") if log is not None and log.exists() else ""
    rows = [json.loads(line) for line in kept.splitlines()]
    done = {(row["picture"], row["solver"], row["told"]) for row in rows}
    pictures = real_pictures(folder) if folder else []
    with tqdm(total=len(pictures) + count, desc="pictures", unit="picture") as bar:
        for name, counts, truth, field_deg, told_deg in [*pictures, *_later(count)]:
            if counts is None:
                name, counts, truth, field_deg, told_deg = drawn_picture(seed, int(name))
            for solver in made:
                for told in TOLD:
                    if (name, solver.name, told) in done:
                        continue
                    row = {"picture": name, "solver": solver.name, "told": told}
                    row |= _row(solver, counts, truth, field_deg, told_deg if told[0] == "w" else 0)
                    rows.append(row)
                    if log:
                        with log.open("a", encoding="utf-8") as file:
                            file.write(json.dumps(row) + "\n")
            bar.update()
    return rows


def _later(count: int) -> Iterator[tuple[str, Any, Any, float, float]]:
    for number in range(count):
        yield str(number), None, None, 0.0, 0.0


def drawn_picture(seed: int, number: int) -> tuple[str, Any, Matrix, float, float]:
    """Name, counts, true attitude, field along the width in degrees, and a field within 10 %."""
    rng = np.random.default_rng((seed, number))
    picture = draw_picture(rng, blind_sky(load_embedded(), YEAR)[0])
    field_deg = _field_deg(picture.counts.shape[1], picture.lens.focal_px)
    told_deg = field_deg * rng.uniform(0.9, 1.1)
    return f"drawn {number}", picture.counts, middle_attitude(picture), field_deg, told_deg


def real_pictures(folder: Path) -> list[tuple[str, Any, Matrix, float, float]]:
    """The same of every picture of a folder, the field told 10 % too wide."""
    pictures = []
    for each in json.loads((folder / "truth.json").read_text(encoding="utf-8"))["pictures"]:
        counts = np.asarray(Image.open(folder / each["file"]).convert("L"))
        field_deg = _field_deg(counts.shape[1], each["focal_length_px"])
        truth = np.array(each["rotation_icrs_to_camera"])
        pictures.append((each["file"], counts, truth, field_deg, 1.1 * field_deg))
    return pictures


def is_right(error_arcsec: Vector, field_deg: float) -> bool:
    """Whether an error (3,) is that of a right answer."""
    across_deg, roll_deg = np.hypot(*error_arcsec[:2]) / 3600.0, abs(error_arcsec[2]) / 3600.0
    return bool(across_deg < RIGHT_SHARE * field_deg and roll_deg < RIGHT_ROLL_DEG)


def _field_deg(width_px: int, focal_px: float) -> float:
    return 2.0 * math.degrees(math.atan(0.5 * width_px / focal_px))


def _row(
    solver: PictureSolver, counts: Any, truth: Matrix, field_deg: float, told_deg: float
) -> dict[str, Any]:
    start = time.process_time()
    answer = solver.solve(counts, told_deg or None)
    row: dict[str, Any] = {"ms": 1000.0 * (time.process_time() - start), "right": None}
    if answer is None:
        return row
    error = attitude_error_arcsec(answer.attitude, truth)
    row["right"] = is_right(error, field_deg)
    row["error_arcsec"] = [round(float(each), 2) for each in error]
    if answer.covariance_rad2 is not None:
        turn = error / ARCSEC_PER_RADIAN
        row["square"] = float(turn @ np.linalg.solve(answer.covariance_rad2, turn))
        sigma = np.sqrt(np.diag(answer.covariance_rad2)) * ARCSEC_PER_RADIAN
        row["sigma_arcsec"] = [round(float(each), 2) for each in sigma]
    return row


def _report(rows: Sequence[dict[str, Any]]) -> Report:
    figures: dict[str, Any] = {}
    bounds = []
    for kind, chosen in _kinds(rows).items():
        for told in TOLD:
            for name in dict.fromkeys(row["solver"] for row in chosen):
                some = [row for row in chosen if row["solver"] == name and row["told"] == told]
                right = sum(row["right"] is True for row in some)
                wrong = sum(row["right"] is False for row in some)
                label = f"{kind}, told {told}, {name}"
                figures[f"{label}: right, wrong, none"] = f"{right}, {wrong}, " + str(
                    len(some) - right - wrong
                )
                figures[f"{label}: median, 90 % ms of processor"] = "{:.0f}, {:.0f}".format(
                    *np.quantile([row["ms"] for row in some], [0.5, 0.9])
                )
                if name == "ours":
                    bounds.append(at_most(f"{label}: wrong", wrong, 0))
                    bounds.append(at_least(f"{label}: right", right / len(some), RIGHT_LEAST))
        square = [row["square"] for row in chosen if row.get("right") and "square" in row]
        found = ", ".join(f"{each:.2f}" for each in np.quantile(square, QUANTILES))
        figures[f"{kind}: e^T P^-1 e, quantiles 25 50 75 90 99 %"] = found
        beyond = float(np.mean(np.array(square) > chi2(3).ppf(0.99)))
        bounds.append(at_most(f"{kind}: e^T P^-1 e beyond its 99 % point", beyond, 0.02))
    expected = ", ".join(f"{each:.2f}" for each in chi2(3).ppf(QUANTILES))
    figures["e^T P^-1 e, quantiles of chi-square with three degrees"] = expected
    return Report("pictures", figures, bounds)


def _kinds(rows: Sequence[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    kinds: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        drawn = row["picture"].startswith("drawn")
        kinds.setdefault("drawn" if drawn else "real", []).append(row)
    return kinds


def main() -> int:
    """Measure, print, and write the page if asked to; 1 where a figure is out of bounds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pictures", type=int, default=PICTURES)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--folder", type=Path, help="of real pictures, with truth.json")
    parser.add_argument("--log", type=Path, help="what is done; default: by the code's digest")
    parser.add_argument("--write", action="store_true", help="the section of docs/cameras.md")
    parsed = parser.parse_args()
    digest = record_of(SOURCES).sources
    log = parsed.log or Path(tempfile.gettempdir()) / f"pictures-{parsed.seed}-{digest}.jsonl"
    report = _report(measured(parsed.pictures, parsed.seed, parsed.folder, solvers(), log))
    print(report.text())
    if parsed.write:
        real = " --folder FOLDER" if parsed.folder else ""
        write_part("blind", report, f"--pictures {parsed.pictures} --seed {parsed.seed}{real}")
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
