"""Pictures of random lenses, drawn from the catalog, with their truth."""

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation
from scipy.special import erf

from service.features.pictures.blind.bright_stars import BrightStars
from service.features.pictures.blind.lens import Lens
from service.features.pictures.blind.solver import rotation_between
from service.vectors import Matrix

SIZES = ((1024, 768), (640, 480), (1280, 960), (1024, 1024))
FAINTEST_RATIO = 5.0
"""Signal to noise behind a matched filter of the faintest star that is counted."""


@dataclass(frozen=True)
class DrawnPicture:
    """`counts` (rows, columns) of 8 bits; `attitude` (3, 3) is of the lens's own axis."""

    counts: Any
    lens: Lens
    attitude: Matrix
    psf_sigma_px: float


def draw_picture(
    rng: np.random.Generator,
    sky: BrightStars,
    field_deg: float | None = None,
    bend: float | None = None,
    stars: int | None = None,
    quality: int | None = 70,
    lens: Lens | None = None,
    off_center: float = 0.01,
) -> DrawnPicture:
    """A picture of 5 to 50 degrees, distortion to 3 %, any gain, some clipped to black, JPEG."""
    if lens is None:
        width, height = SIZES[rng.integers(len(SIZES))]
        field_deg = field_deg or np.exp(rng.uniform(np.log(5.0), np.log(50.0)))
        focal_px = 0.5 * width / np.tan(np.radians(0.5 * field_deg))
        bend = rng.uniform(-0.03, 0.03) if bend is None else bend
        lens = Lens(width, height, focal_px, bend, *rng.normal(0.0, off_center, 2))
    attitude = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    psf = rng.uniform(0.8, 2.0)
    noise = rng.uniform(0.5, 6.0)
    u, v = lens.places(sky.direction @ attitude.T)
    with np.errstate(invalid="ignore"):
        inside = (u > 0) & (v > 0) & (u < lens.width_px - 1) & (v < lens.height_px - 1)
    rows = np.flatnonzero(inside)
    count = min(stars or int(np.exp(rng.uniform(np.log(12.0), np.log(80.0)))), len(rows) - 1)
    faintest_mag = sky.magnitude_mag[rows[count]]
    flux = FAINTEST_RATIO * noise * 2.0 * np.sqrt(np.pi) * psf
    counts = rng.normal(rng.uniform(-1.0, 5.0) * noise, noise, (lens.height_px, lens.width_px))
    slope = rng.uniform(-5.0, 5.0, 2) * noise
    counts += np.linspace(0.0, slope[0], lens.width_px)
    counts += np.linspace(0.0, slope[1], lens.height_px)[:, None]
    for row in rows[: 3 * count + 10]:
        light = flux * 10.0 ** (0.4 * (faintest_mag - sky.magnitude_mag[row]))
        _add_star(counts, u[row], v[row], psf, light)
    hot = rng.integers(0, 10)
    counts[rng.integers(0, lens.height_px, hot), rng.integers(0, lens.width_px, hot)] += 50.0
    counts = np.clip(np.round(counts), 0, 255).astype(np.uint8)
    if quality is not None:
        counts = np.asarray(Image.open(io.BytesIO(jpeg_of(counts, quality))))
    return DrawnPicture(counts, lens, attitude, psf)


def middle_attitude(picture: DrawnPicture) -> Matrix:
    """The truth of a drawn picture about its middle: the shortest turn of its lens's axis."""
    lens = picture.lens
    middle = lens.directions(
        np.array([(lens.width_px - 1) / 2]), np.array([(lens.height_px - 1) / 2])
    )[0]
    axis = np.cross(middle, [0.0, 0.0, 1.0])
    three = np.stack([middle, axis, np.cross(middle, axis)])
    turned = np.stack([[0.0, 0.0, 1.0], axis, np.cross([0.0, 0.0, 1.0], axis)])
    return rotation_between(turned, three) @ picture.attitude


def jpeg_of(counts: Any, quality: int = 90) -> bytes:
    file = io.BytesIO()
    Image.fromarray(counts).save(file, "JPEG", quality=quality)
    return file.getvalue()


def _add_star(counts: Any, u: float, v: float, psf: float, light: float) -> None:
    half = int(np.ceil(4.0 * psf + 2.0))
    columns = np.arange(max(0, round(u) - half), min(counts.shape[1], round(u) + half + 1))
    rows = np.arange(max(0, round(v) - half), min(counts.shape[0], round(v) + half + 1))

    def share(at: Any, center: float) -> Any:
        edges = (np.stack([at - 0.5, at + 0.5]) - center) / (psf * np.sqrt(2.0))
        return 0.5 * np.diff(erf(edges), axis=0)[0]

    counts[np.ix_(rows, columns)] += light * np.outer(share(rows, v), share(columns, u))
