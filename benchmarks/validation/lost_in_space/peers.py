"""Solvers for points of unknown identity, each used as its documentation says.

All have the same stars: the run catalog from which the service's index is made.  The input of a
solver (pixels, vectors) is made before the clock starts, and its output is converted to an attitude
after the clock stops.  The peers come with the extra `peers`; a missing one is left out with a
message.
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

from service.identify.lost_in_space.finder import search_sky
from service.identify.lost_in_space.solver import FieldOfView, LostInSpace
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.whole_sky.index import build_sky_index
from service.vectors import Matrix, from_ra_dec
from studies.scenes import PinholeCamera, Scene

LIMIT_MAG = 6.5
PATTERN_ERROR = 0.005
"""Error of tetra3's edge ratios: noise of 1 to 2 px in 1,024; with its 0.001 it finds 60 %."""
CACHE = Path(tempfile.gettempdir()) / "lost-in-space-peers"


@dataclass(frozen=True)
class Solver:
    """Solver with its database: `ready` makes its input, `solve` is timed, `attitude` reads."""

    name: str
    database_mb: float
    ready: Callable[[Scene], Any]
    solve: Callable[[Any], Any]
    attitude: Callable[[Any], Matrix | None]
    slow: bool = False
    """True for a solver that gets the first scenes only."""


def ours(
    run_catalog: RunCatalog, field: FieldOfView, sigma: float = 1.0, offset_mag: float = 0.0
) -> Solver:
    """The service's own solver, with sigmas and magnitudes that may be wrong."""
    index = build_sky_index(run_catalog, LIMIT_MAG, field.radius_deg)
    solver = LostInSpace(index, field)
    return Solver(
        "lost_in_space",
        index.nbytes / 1e6,
        lambda scene: (
            scene.direction,
            scene.magnitude_mag + offset_mag,
            scene.sigma_rad * sigma,
        ),
        lambda told: search_sky(solver, *told),
        lambda search: search.result.attitude,
    )


def peers(run_catalog: RunCatalog, camera: PinholeCamera, position_px: float) -> list[Solver]:
    """Installed solvers of other projects."""
    made = []
    if importlib.util.find_spec("tetra3rs"):
        made.append(tetra3rs_solver(run_catalog, camera))
    if importlib.util.find_spec("tetra3"):
        made.append(_cedar_solve(run_catalog, camera))
    if importlib.util.find_spec("ruststartracker"):
        made.append(_ruststartracker(run_catalog, camera, position_px))
    return made


def _cached(name: str, run_catalog: RunCatalog, suffix: str) -> Path:
    CACHE.mkdir(exist_ok=True)
    return CACHE / f"{name}-{run_catalog.digest.removeprefix('sha256:')[:16]}{suffix}"


def tetra3rs_solver(
    run_catalog: RunCatalog,
    camera: PinholeCamera,
    hint: Callable[[Scene], Matrix] | None = None,
    hint_deg: float = 1.0,
) -> Solver:
    """Solver tetra3rs with a catalog file of our stars; with `hint`, in its tracking mode."""
    import tetra3rs

    path = _cached("tetra3rs", run_catalog, ".bin")
    if not path.exists():
        stars = path.with_suffix(".stars.bin")
        kind = [("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("magnitude", "<f4", 3)]
        rows = np.zeros(len(run_catalog), dtype=kind)
        rows["id"] = np.arange(len(run_catalog)) + 1
        rows["ra"], rows["dec"] = run_catalog.ra_deg, run_catalog.dec_deg
        rows["magnitude"] = run_catalog.magnitude_mag[:, None]
        stars.write_bytes(b"GDR3" + struct.pack("<IQ", 1, len(rows)) + rows.tobytes())
        tetra3rs.SolverDatabase.generate_from_gaia(
            str(stars),
            max_fov_deg=camera.field_deg,
            star_max_magnitude=LIMIT_MAG,
            pattern_max_error=PATTERN_ERROR,
            epoch_proper_motion_year=None,
        ).save_to_file(str(path))
    database = tetra3rs.SolverDatabase.load_from_file(str(path))
    model = tetra3rs.CameraModel(camera.focal_px, camera.side_px, camera.side_px)
    # A threshold of 1e-3 finds 2.5 % more than the default of 1e-5, and no more wrong ones.
    always = {"camera_model": model, "fov_max_error_deg": 0.1, "match_threshold": 1e-3}

    def ready(scene: Scene) -> dict[str, Any]:
        flux = 10.0 ** (-0.4 * scene.magnitude_mag)
        told = {"centroids": np.column_stack([camera.pixels(scene.direction), flux]), **always}
        if hint is not None:
            told |= {"attitude_hint": hint(scene), "hint_uncertainty_deg": hint_deg}
        return told

    return Solver(
        "tetra3rs",
        path.stat().st_size / 1e6,
        ready,
        lambda told: database.solve_from_centroids(**told),
        lambda result: result.rotation_matrix_icrs_to_camera if result else None,
    )


def _cedar_solve(run_catalog: RunCatalog, camera: PinholeCamera) -> Solver:
    from tetra3 import Tetra3

    logging.getLogger("tetra3.Tetra3").setLevel(logging.ERROR)
    path = _cached("cedar-solve", run_catalog, ".npz")
    solver = Tetra3(load_database=None)
    if not path.exists():
        # The Yale catalog's binary form, whose name must be `bsc5`; minus: J2000.
        folder = Path(tempfile.mkdtemp(dir=CACHE))
        bright = run_catalog.magnitude_mag <= LIMIT_MAG
        kind = "<f4,<f8,<f8,<i2,<i2,<f4,<f4"
        rows = np.zeros(int(bright.sum()), dtype=kind)
        rows["f0"] = np.arange(len(rows)) + 1
        rows["f1"] = np.radians(run_catalog.ra_deg[bright])
        rows["f2"] = np.radians(run_catalog.dec_deg[bright])
        rows["f4"] = np.round(100 * run_catalog.magnitude_mag[bright])
        head = struct.pack("<7i", 0, 1, -len(rows), 1, 1, 1, rows.dtype.itemsize)
        (folder / "bsc5").write_bytes(head + rows.tobytes())
        solver.generate_database(
            max_fov=camera.field_deg,
            save_as=path,
            star_catalog=str(folder / "bsc5"),
            star_max_magnitude=LIMIT_MAG,
            pattern_max_error=PATTERN_ERROR,
            epoch_proper_motion=None,
        )
    solver.load_database(path)
    half = camera.side_px / 2

    def ready(scene: Scene) -> Any:
        return camera.pixels(scene.direction)[:, ::-1] + half

    def solve(told: Any) -> Any:
        return solver.solve_from_centroids(
            told,
            (camera.side_px, camera.side_px),
            fov_estimate=camera.field_deg,
            fov_max_error=0.1,
            match_max_error=PATTERN_ERROR,
            return_matches=True,
        )

    def attitude(result: Any) -> Matrix | None:
        if result["RA"] is None:
            return None
        sky = np.array(result["matched_stars"])
        seen = camera.directions((np.array(result["matched_centroids"]) - half)[:, ::-1])
        return _best_rotation(seen, from_ra_dec(sky[:, 0], sky[:, 1]))

    return Solver("cedar-solve", path.stat().st_size / 1e6, ready, solve, attitude, slow=True)


def _ruststartracker(run_catalog: RunCatalog, camera: PinholeCamera, position_px: float) -> Solver:
    import ruststartracker
    from ruststartracker.star import StarTrackerError

    bright = run_catalog.magnitude_mag <= LIMIT_MAG
    half = camera.side_px / 2
    matrix = np.array([[camera.focal_px, 0, half], [0, camera.focal_px, half], [0, 0, 1]])
    tracker = ruststartracker.StarTracker(
        run_catalog.direction[bright].astype(np.float32),
        run_catalog.magnitude_mag[bright].astype(np.float32),
        ruststartracker.CameraParameters(matrix, (camera.side_px, camera.side_px), None),
        # Three sigmas of a separation.
        inter_star_angle_tolerance=max(3.0 * math.sqrt(2.0) * position_px, 1.0) * camera.pixel_rad,
        n_minimum_matches=5,
        timeout_secs=1.0,
    )

    def solve(told: Any) -> Any:
        try:
            return tracker.process_observation_vectors(told)
        except StarTrackerError:
            return None

    def attitude(result: Any) -> Matrix | None:
        if result is None:
            return None
        from scipy.spatial.transform import Rotation

        return np.asarray(Rotation.from_quat(np.asarray(result.quat)).as_matrix().T)

    # It makes its pairs when it starts and keeps no file: two stars and an angle of 32 bits each.
    stars = int(bright.sum())
    within = 1.0 - math.cos(2.0 * math.atan(half * math.sqrt(2.0) * camera.pixel_rad))
    megabytes = stars * stars * within / 4.0 * 12 / 1e6
    return Solver(
        *("ruststartracker", megabytes),
        *(lambda scene: np.asarray(scene.direction, np.float32), solve, attitude),
        slow=True,
    )


def _best_rotation(seen: Matrix, reference: Matrix) -> Matrix:
    u, _, vt = np.linalg.svd(seen.T @ reference)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
