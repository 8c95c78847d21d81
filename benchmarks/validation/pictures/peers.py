"""Solvers for pictures of unknown cameras, each with its own detector, as documented.

The peers are no part of the project: `PYTHONPATH` names a folder with `tetra3` (cedar-solve) and
`tetra3rs`; a missing one is left out with a message.  Each has one database for fields of 5 to 50
degrees: cedar-solve's is made of the service's stars, tetra3rs has its own catalog.  The first use
makes them, in minutes.
"""

import importlib.util
import logging
import math
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.validation.lost_in_space.peers import CACHE
from service.features.pictures.blind.bright_stars import BrightStars
from service.features.pictures.blind.picture import blind_sky, solve_picture
from service.features.pictures.frames.frame import Frame
from service.sky.catalog.star_catalog import load_embedded
from service.vectors import Matrix, from_ra_dec, ra_dec_of

YEAR = 2020
LEAST_FIELD_DEG, MOST_FIELD_DEG = 5.0, 50.0
FIELD_ERROR = 0.15
"""Relative error that a solver assumes of a given field of view."""


@dataclass(frozen=True)
class Answer:
    """Attitude (3, 3) of the picture's middle; `covariance_rad2` if the solver gives one."""

    attitude: Matrix
    covariance_rad2: Matrix | None = None


@dataclass(frozen=True)
class PictureSolver:
    """Solver; `solve` takes the counts and the field along the width in degrees, or None."""

    name: str
    solve: Callable[[Any, float | None], Answer | None]


def solvers() -> list[PictureSolver]:
    """The service's own solver, and the available peers."""
    made = [_ours()]
    if importlib.util.find_spec("tetra3"):
        made.append(_cedar_solve())
    if importlib.util.find_spec("tetra3rs"):
        made.append(_tetra3rs())
    return made


def _ours() -> PictureSolver:
    sky, solver = blind_sky(load_embedded(), YEAR)

    def solve(counts: Any, field_deg: float | None) -> Answer | None:
        guess_px = None if field_deg is None else focal_px(counts.shape[1], field_deg)
        frame = Frame(counts.astype(np.float32), "NPY", "sha256:0", 255.0)
        found = solve_picture(frame, sky, solver, guess_px).attitude
        return None if found is None else Answer(found.attitude, found.covariance_rad2)

    return PictureSolver("ours", solve)


def focal_px(width_px: int, field_deg: float) -> float:
    """Focal length with which a width spans a field of view."""
    return 0.5 * width_px / math.tan(math.radians(0.5 * field_deg))


def _cedar_solve() -> PictureSolver:
    # It is written for numpy before 2, which had this name for the module.
    np.math = math  # type: ignore[attr-defined]
    from tetra3 import Tetra3, get_centroids_from_image

    logging.getLogger("tetra3.Tetra3").setLevel(logging.ERROR)
    path = _made("cedar-solve-pictures.npz", _make_cedar_database)
    solver = Tetra3(load_database=None)
    solver.load_database(path)

    def solve(counts: Any, field_deg: float | None) -> Answer | None:
        centroids = get_centroids_from_image(Image.fromarray(counts))
        error = None if field_deg is None else FIELD_ERROR * field_deg
        if len(centroids) < 4:
            return None
        result = solver.solve_from_centroids(
            *(centroids, counts.shape),
            fov_estimate=field_deg,
            fov_max_error=error,
            match_max_error=0.005,
            return_matches=True,
        )
        if result["RA"] is None:
            return None
        half_v, half_u = (side / 2 for side in counts.shape)
        focal = half_u / math.tan(math.radians(0.5 * result["FOV"]))
        v, u = np.array(result["matched_centroids"]).T
        seen = np.column_stack([(u - half_u) / focal, (v - half_v) / focal, np.ones(len(u))])
        seen /= np.linalg.norm(seen, axis=1)[:, None]
        sky = np.array(result["matched_stars"])
        return Answer(_best_rotation(seen, from_ra_dec(sky[:, 0], sky[:, 1])))

    return PictureSolver("cedar-solve", solve)


def _make_cedar_database(path: Path) -> None:
    from tetra3 import Tetra3

    sky = blind_sky(load_embedded(), YEAR)[0]
    # The Yale catalog's binary form, whose name must be `bsc5`; minus: J2000.
    folder = Path(tempfile.mkdtemp(dir=CACHE))
    (folder / "bsc5").write_bytes(_bsc5(sky))
    Tetra3(load_database=None).generate_database(
        max_fov=MOST_FIELD_DEG,
        min_fov=LEAST_FIELD_DEG,
        save_as=path,
        star_catalog=str(folder / "bsc5"),
        epoch_proper_motion=None,
    )


def _bsc5(sky: BrightStars) -> bytes:
    rows = np.zeros(len(sky.direction), dtype="<f4,<f8,<f8,<i2,<i2,<f4,<f4")
    places = np.radians([ra_dec_of(each) for each in sky.direction])
    rows["f0"] = np.arange(len(rows)) + 1
    rows["f1"], rows["f2"] = places.T
    rows["f4"] = np.round(100 * sky.magnitude_mag)
    return struct.pack("<7i", 0, 1, -len(rows), 1, 1, 1, rows.dtype.itemsize) + rows.tobytes()


def _tetra3rs() -> PictureSolver:
    import tetra3rs

    def make(path: Path) -> None:
        made = tetra3rs.SolverDatabase.generate_from_gaia(
            max_fov_deg=MOST_FIELD_DEG, min_fov_deg=LEAST_FIELD_DEG, epoch_proper_motion_year=YEAR
        )
        made.save_to_file(str(path))

    path = _made("tetra3rs-pictures.bin", make)
    database = tetra3rs.SolverDatabase.load_from_file(str(path))
    middle_deg = math.sqrt(LEAST_FIELD_DEG * MOST_FIELD_DEG)

    def solve(counts: Any, field_deg: float | None) -> Answer | None:
        found = tetra3rs.extract_centroids(counts)
        result = database.solve_from_centroids(
            found.centroids,
            # It wants an estimate; without an error any field is taken.
            fov_estimate_deg=field_deg or middle_deg,
            fov_max_error_deg=None if field_deg is None else FIELD_ERROR * field_deg,
            image_shape=counts.shape,
        )
        if not result or result.parity_flip:
            return None
        return Answer(np.asarray(result.rotation_matrix_icrs_to_camera))

    return PictureSolver("tetra3rs", solve)


def _made(name: str, make: Callable[[Path], None]) -> Path:
    CACHE.mkdir(exist_ok=True)
    path: Path = CACHE / name
    if not path.exists():
        part = path.with_name(f"part-{name}")
        make(part)
        part.rename(path)
    return path


def _best_rotation(seen: Matrix, reference: Matrix) -> Matrix:
    u, _, vt = np.linalg.svd(seen.T @ reference)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
