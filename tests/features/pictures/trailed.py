"""Pictures whose stars run along paths while the shutter is open, with their truth."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import erf

from service.features.pictures.blind.bright_stars import BrightStars
from service.features.pictures.blind.lens import Lens
from service.vectors import Matrix


@dataclass(frozen=True)
class TrailedPicture:
    """`counts` (rows, columns), and the attitude (3, 3) of the lens's axis at mid exposure.

    `u_px`, `v_px` (n) are the places of the drawn stars at mid exposure, and `flux_counts` theirs.
    """

    counts: Any
    lens: Lens
    attitude: Matrix
    u_px: Any
    v_px: Any
    flux_counts: Any


def draw_trailed(
    rng: np.random.Generator,
    sky: BrightStars,
    lens: Lens,
    turn_rad: Any,
    *,
    psf_px: float = 1.2,
    noise: float = 7.0,
    faintest_mag: float = 7.0,
    faintest_ratio: float = 30.0,
    path_px: Any = None,
    weights: Any = None,
    steps: int = 100,
) -> TrailedPicture:
    """The real sky through a camera that turns by the rotation vector `turn_rad` (3,) in its axes.

    `path_px` (k, 2) and `weights` (k,) displace the images of all stars alike instead, each with
    its share of the light.  A star of `faintest_mag` that stands still has `faintest_ratio`.
    """
    attitude = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    counts = rng.normal(100.0, noise, (lens.height_px, lens.width_px))
    if path_px is None:
        share = (np.arange(steps) + 0.5) / steps - 0.5
        turns = Rotation.from_rotvec(share[:, None] * np.asarray(turn_rad)).as_matrix()
        offsets = np.zeros((steps, 2))
    else:
        turns, offsets = np.broadcast_to(np.eye(3), (len(path_px), 3, 3)), np.asarray(path_px)
    light = np.full(len(turns), 1.0 / len(turns)) if weights is None else np.asarray(weights)
    bright = sky.magnitude_mag < faintest_mag
    camera = sky.direction[bright] @ attitude.T
    u, v = lens.places(camera)
    with np.errstate(invalid="ignore"):
        near = (u > -60) & (v > -60) & (u < lens.width_px + 60) & (v < lens.height_px + 60)
    u, v, camera = u[near], v[near], camera[near]
    least = faintest_ratio * noise * 2.0 * np.sqrt(np.pi) * psf_px
    flux = least * 10.0 ** (0.4 * (faintest_mag - sky.magnitude_mag[bright][near]))
    moved = [lens.places(camera @ turn.T) for turn in turns]
    path_u = np.array([each[0] for each in moved]) + offsets[:, :1]
    path_v = np.array([each[1] for each in moved]) + offsets[:, 1:]
    for k in np.flatnonzero(np.isfinite(path_u + path_v).all(axis=0)):
        add_path(counts, path_u[:, k], path_v[:, k], psf_px, light * flux[k])
    return TrailedPicture(counts, lens, attitude, u, v, flux)


def add_path(counts: Any, u: Any, v: Any, psf: float, light: Any) -> None:
    """Add the images (k) of a star along its path, each with its light."""
    half = int(np.ceil(4.0 * psf + 1.0))
    columns = np.arange(max(0, round(u.min()) - half), min(counts.shape[1], round(u.max()) + half))
    rows = np.arange(max(0, round(v.min()) - half), min(counts.shape[0], round(v.max()) + half))
    if not (len(columns) and len(rows)):
        return

    def share(at: Any, center: Any) -> Any:
        edges = (np.append(at - 0.5, at[-1] + 0.5) - center[:, None]) / (psf * np.sqrt(2.0))
        return 0.5 * np.diff(erf(edges), axis=1)

    counts[np.ix_(rows, columns)] += (light[:, None] * share(rows, v)).T @ share(columns, u)
