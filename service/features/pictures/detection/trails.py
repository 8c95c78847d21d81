"""Recognition and measurement of trailed stars, whose images are all elongated alike.

A camera that turns while its shutter is open moves each star along a path that follows from the
star's place and one small rotation. That rotation is fitted to the brighter images; then stars are
detected with a filter of the trail's shape, and placed by the two ends and the length of the trail.
Images that are elongated alike but not even along such a path (two images of each star, a mount
that stopped halfway) allow no place at mid exposure, and are refused.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import sep
from scipy import fft

from service.features.pictures.centroids.trail_fit import (
    CHUNK_PIXELS,
    TrailImage,
    TrailPixels,
    TrailPlaces,
    fit_trails,
)
from service.features.pictures.frames.frame import CountArray
from service.vectors import Vector, rotate_about

LEAST_WIDTHS = 2.5
"""Least length of a trail, in widths of a still star's image; shorter ones count as still."""
LONGEST_SHARE = 0.25
"""Longest trail that is measured, as a share of the picture's shorter side."""
BRIGHT_SIGMAS, CLEAR_SIGMAS = 4.0, 8.0
"""Least filtered light at the edge and at the peak of a patch, in sigmas, for fitting trails."""
FILTER_PX = 1.2
LEAST_PIXELS = 12
COMPONENTS, LEAST_COMPONENTS, JUDGED = 80, 6, 30
AGREEING_SHARE = 0.55
"""Least share of the brighter images that one common motion must explain."""
TRIALS = 400
FOCAL_SIDES = (math.inf, 3.0, 1.5, 1.0, 0.7, 0.5)
"""Trial focal lengths of the common motion, in longer sides of the picture."""
LONGEST_FOCAL_PX = 1e6
FITTED_STARS = 24
UNEVEN_SHARE = 0.06
"""Largest share of a bright trail's squared light that its path leaves unexplained beyond noise."""
LARGEST_BOW = 0.2
"""Largest distance of a path's middle from its chord's middle, as a share of the chord."""
UNEVEN_LIGHT = 0.03
"""Largest distance of a trail's mean light from its middle, as a share of its length."""


@dataclass(frozen=True)
class Motion:
    """The common motion of stars on a sensor: a small rotation seen through a lens.

    `shift_u_px` and `shift_v_px` are the motion of a star in the middle, `turn_rad` is the rotation
    about the middle, u towards v, and `focal_px` the focal length. `bow_px` is added to the bow of
    every path; see `TrailImage`.
    """

    middle_u_px: float
    middle_v_px: float
    shift_u_px: float
    shift_v_px: float
    turn_rad: float
    focal_px: float
    bow_px: float = 0.0

    def trails(self, u_px: Vector, v_px: Vector) -> tuple[Vector, Vector, Vector]:
        """Chords along u and v, and the bows (n,), of trails of stars at mid-exposure places."""
        f = self.focal_px
        x, y = (u_px - self.middle_u_px) / f, (v_px - self.middle_v_px) / f
        middle = np.stack([x, y, np.ones_like(x)], axis=-1)
        half = 0.5 * np.array([-self.shift_v_px / f, self.shift_u_px / f, self.turn_rad])
        ends = [rotate_about(turn, middle) for turn in (-half, half)]
        begin, end = (each[..., :2] / each[..., 2:] * f for each in ends)
        chord = end - begin
        off = np.stack([x, y], axis=-1) * f - 0.5 * (begin + end)
        length = np.maximum(np.hypot(chord[..., 0], chord[..., 1]), 1e-9)
        bow = (off[..., 1] * chord[..., 0] - off[..., 0] * chord[..., 1]) / length
        return chord[..., 0], chord[..., 1], bow + self.bow_px


@dataclass(frozen=True)
class Trails:
    """The common motion in a picture of trailed stars, and the width of a still star's image.

    `length_px` is the median length over the picture. `refused` is the reason why no place at mid
    exposure can be told, or None.
    """

    motion: Motion
    sigma_px: float
    length_px: float
    refused: str | None = None

    def image_at(self, u_px: Vector, v_px: Vector) -> TrailImage:
        """The trailed images of stars (n) at given places; the values have the shape (n, 1)."""
        along_u, along_v, bow = self.motion.trails(u_px, v_px)
        return TrailImage(self.sigma_px, along_u[:, None], along_v[:, None], bow[:, None])


def measured_trails(
    light: CountArray,
    noise_counts: float,
    usable: npt.NDArray[np.bool_] | None = None,
    least_widths: float = LEAST_WIDTHS,
) -> Trails | None:
    """The star trails on light (rows, columns) above its background.

    None where no common motion elongates the images: stars stand still, or the lens elongates them.
    """
    found = _components(light, noise_counts, usable)
    if len(found) < LEAST_COMPONENTS:
        return None
    rows, columns = light.shape
    square = 12.0 * ((found["x2"] - found["y2"]) + 2j * found["xy"])
    width = math.sqrt(max(float(np.median(found["b"])) ** 2, 0.3))
    motion = _common_motion(found["x"], found["y"], square, width, rows, columns)
    if motion is None:
        return None
    along_u, along_v, _ = motion.trails(found["x"], found["y"])
    length = float(np.median(np.hypot(along_u, along_v)))
    if length < least_widths * width:
        return None
    trails = Trails(motion, width, length)
    corner_u, corner_v = np.array([0.0, columns, 0.0, columns]), np.array([0.0, 0.0, rows, rows])
    longest = float(np.hypot(*motion.trails(corner_u, corner_v)[:2]).max())
    if longest > LONGEST_SHARE * min(rows, columns):
        return replace(trails, refused="too long to be told apart")
    return _fitted(trails, light, noise_counts, usable, found)


def _components(
    light: CountArray, noise_counts: float, usable: npt.NDArray[np.bool_] | None
) -> npt.NDArray[np.void]:
    """The brightest connected patches of light wholly within the picture, most light first."""
    steps = np.arange(-2.0, 3.0)
    kernel = np.exp(-0.5 * (steps[None, :] ** 2 + steps[:, None] ** 2) / FILTER_PX**2)
    noise = noise_counts * float(np.sqrt((kernel**2).sum()) / kernel.sum())
    try:
        found = sep.extract(
            light,
            thresh=BRIGHT_SIGMAS * noise,
            filter_kernel=kernel.astype(np.float32),
            minarea=LEAST_PIXELS,
            deblend_cont=1.0,
            clean=False,
        )
    except Exception:
        # SEP raises one plain exception: too much of the picture is bright.
        return np.zeros(0, dtype=[("x", "f8")])
    rows, columns = light.shape
    whole = (found["xmin"] > 0) & (found["ymin"] > 0)
    whole &= (found["xmax"] < columns - 1) & (found["ymax"] < rows - 1)
    # The threshold cuts off the faint ends of a patch; clear patches show their full length.
    clear = found["cpeak"] > CLEAR_SIGMAS * noise
    if usable is not None:
        clear &= usable[found["ypeak"], found["xpeak"]]
    found = found[whole & clear]
    return np.asarray(found[np.argsort(-found["flux"], kind="stable")[:COMPONENTS]])


def _common_motion(
    u: Vector, v: Vector, square: npt.NDArray[np.complex128], width: float, rows: int, columns: int
) -> Motion | None:
    """The common motion that explains most trails, found by random trials with two trails.

    `square` (n,) is (t_u + i t_v)^2 of each trail t, since a trail's direction has no sign.
    """
    seen = np.sqrt(square)
    middle_u, middle_v = 0.5 * (columns - 1), 0.5 * (rows - 1)
    rng = np.random.default_rng(len(u))
    judged = min(JUDGED, len(u))
    tolerance = np.maximum(0.2 * np.abs(seen), 1.2 * width)
    best, most = None, 0.0
    for sides in FOCAL_SIDES:
        inverse = (sides * max(rows, columns)) ** -1.0
        design = _design(u - middle_u, v - middle_v, inverse)
        for _ in range(TRIALS // len(FOCAL_SIDES)):
            pair = rng.choice(judged, 2, replace=False)
            target = seen[pair] * np.array([1.0, rng.choice((-1.0, 1.0))])
            values = _solved(design[:, pair], target)
            for _ in range(2):
                told = design[0] @ values + 1j * (design[1] @ values)
                sense = np.where(np.real(told * seen.conj()) < 0.0, -1.0, 1.0)
                off = np.abs(told - sense * seen)
                agree = off < tolerance
                if np.count_nonzero(agree) < 3:
                    break
                values = _solved(design[:, agree], (sense * seen)[agree])
            score = float(np.exp(-0.5 * (off / tolerance) ** 2)[:judged].sum())
            if score > most and np.count_nonzero(agree[:judged]) >= AGREEING_SHARE * judged:
                shift_u, shift_v, turn = values.tolist()
                focal_px = min(1.0 / max(inverse, 1e-9), LONGEST_FOCAL_PX)
                best = Motion(middle_u, middle_v, shift_u, shift_v, turn, focal_px)
                most = score
    return best


def _design(x: Vector, y: Vector, inverse: float) -> Vector:
    """Motions along u and v (2, n, 3) per unit of shift along u, shift along v, and turn."""
    k = inverse**2
    along_u = np.stack([1.0 + k * x * x, k * x * y, -y], axis=-1)
    along_v = np.stack([k * x * y, 1.0 + k * y * y, x], axis=-1)
    return np.stack([along_u, along_v])


def _solved(design: Vector, target: npt.NDArray[np.complex128]) -> Vector:
    """The least-squares shift and turn (3,) for observed motions, slightly regularised."""
    rows = np.concatenate([design[0], design[1]])
    right = np.concatenate([target.real, target.imag])
    scale = np.maximum(np.sqrt((rows**2).mean(axis=0)), 1e-9)
    unit = rows / scale
    normal = unit.T @ unit + 1e-6 * np.eye(3)
    return np.asarray(np.linalg.solve(normal, unit.T @ right) / scale)


_STEPS = {
    "shift_u_px": 0.02, "shift_v_px": 0.02, "turn_rad": 2e-5, "bow_px": 0.01, "sigma_px": 0.01,
}  # fmt: skip


def _fitted(
    trails: Trails,
    light: CountArray,
    noise_counts: float,
    usable: npt.NDArray[np.bool_] | None,
    found: npt.NDArray[np.void],
) -> Trails:
    """Trails refined on the pixels of bright trails, with the reason to refuse a bad fit."""
    u, v = found["x"].astype(np.float64), found["y"].astype(np.float64)
    along_u, along_v, _ = trails.motion.trails(u, v)
    told = (along_u + 1j * along_v) ** 2
    seen = 12.0 * ((found["x2"] - found["y2"]) + 2j * found["xy"])
    alike = np.abs(told - seen) < 0.5 * np.abs(told)
    u, v = u[alike][:FITTED_STARS], v[alike][:FITTED_STARS]
    for _ in range(6):
        image = trails.image_at(u, v)
        pixels = TrailPixels.about(image, u, v, light, noise_counts, usable)
        placed = fit_trails(pixels, image, u, v, math.inf)
        u, v = placed.u_px, placed.v_px
        changed = _stepped(trails, pixels, placed)
        moved = _difference(trails, changed)
        trails = changed
        if moved < 0.02:
            break
    image = trails.image_at(u, v)
    pixels = TrailPixels.about(image, u, v, light, noise_counts, usable)
    placed = fit_trails(pixels, image, u, v, math.inf)
    along_u, along_v, _ = trails.motion.trails(placed.u_px, placed.v_px)
    trails = replace(trails, length_px=float(np.median(np.hypot(along_u, along_v))))
    return replace(trails, refused=_refusal(trails, pixels, placed))


def _stepped(trails: Trails, pixels: TrailPixels, placed: TrailPlaces) -> Trails:
    """Motion and width of trails after one Gauss-Newton step that eliminates the stars' places."""
    u, v, flux = placed.u_px, placed.v_px, placed.flux_counts[:, None]
    du, dv = pixels.u_px - u[:, None], pixels.v_px - v[:, None]

    def drawn(changed: Trails) -> Vector:
        return np.asarray(flux * changed.image_at(u, v).pixel(du, dv))

    image = trails.image_at(u, v)
    value, by_u, by_v = image.with_slopes(du, dv)
    model = flux * value
    own = np.stack([-flux * by_u, -flux * by_v, value], axis=-1)
    usable = pixels.usable
    # All stars have equal weight; otherwise bright ones would dominate.
    weight = np.where(usable, 1.0, 0.0) / np.maximum(flux, 1e-9) ** 2
    columns = np.stack(
        [(drawn(_changed(trails, name, step)) - model) / step for name, step in _STEPS.items()],
        axis=-1,
    )
    left = np.where(usable, pixels.light - model, 0.0)
    # Stars that the shape explains badly, such as blends, get little weight.
    share = (np.where(usable, left**2, 0.0)).sum(axis=1) / np.maximum((model**2).sum(axis=1), 1e-30)
    usual = max(float(np.median(share)), 1e-6)
    weight = weight / (1.0 + (share / (3.0 * usual)) ** 2)[:, None]
    w = weight
    # The stars' own parameters are eliminated.
    block = np.einsum("np,npi,npj->nij", w, own, own)
    cross = np.einsum("np,npi,npk->nik", w, own, columns)
    right_own = np.einsum("np,npi,np->ni", w, own, left)
    solved = np.linalg.solve(block + 1e-12 * np.eye(3), cross)
    normal = np.einsum("np,npi,npj->ij", w, columns, columns) - np.einsum(
        "nik,nil->kl", cross, solved
    )
    right = np.einsum("np,npk,np->k", w, columns, left) - np.einsum("nik,ni->k", solved, right_own)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    unit = normal / np.outer(scale, scale) + 1e-6 * np.eye(len(scale))
    step = np.linalg.solve(unit, right / scale) / scale
    limits = np.array([3.0, 3.0, 3.0 / max(u.max() - u.min(), 50.0), 1.0, 0.3]) * max(
        1.0, 0.1 * trails.length_px
    )
    step = np.clip(step, -limits, limits)
    for name, change in zip(_STEPS, step.tolist(), strict=True):
        trails = _changed(trails, name, change)
    return replace(trails, sigma_px=min(max(trails.sigma_px, 0.4), 8.0))


def _changed(trails: Trails, name: str, change: float) -> Trails:
    if name == "sigma_px":
        return replace(trails, sigma_px=trails.sigma_px + change)
    motion = trails.motion
    return replace(trails, motion=replace(motion, **{name: getattr(motion, name) + change}))


def _difference(one: Trails, other: Trails) -> float:
    """The largest difference in pixels of two trails' motions or widths, rotation at the edge."""
    a, b = one.motion, other.motion
    return max(
        abs(a.shift_u_px - b.shift_u_px),
        abs(a.shift_v_px - b.shift_v_px),
        abs(a.turn_rad - b.turn_rad) * a.middle_u_px,
        abs(a.bow_px - b.bow_px),
        abs(one.sigma_px - other.sigma_px),
    )


def _refusal(trails: Trails, pixels: TrailPixels, placed: TrailPlaces) -> str | None:
    """The reason why trails do not give places at mid exposure; None if they do."""
    bow = np.abs(trails.motion.trails(placed.u_px, placed.v_px)[2])
    if float(np.median(bow)) > LARGEST_BOW * trails.length_px:
        return "too strongly bent"
    if float(np.median(placed.unexplained)) > UNEVEN_SHARE:
        return "not evenly along one line"
    off = float(np.median(_mean_light_px(trails, pixels, placed)))
    if abs(off) > UNEVEN_LIGHT * trails.length_px:
        return "more at one end than at the other"
    return None


def _mean_light_px(trails: Trails, pixels: TrailPixels, placed: TrailPlaces) -> Vector:
    """The distance (n,) along each trail from its middle to its mean light, in pixels."""
    u, v = placed.u_px, placed.v_px
    image = trails.image_at(u, v)
    along, across, *_ = image.along_and_across(pixels.u_px - u[:, None], pixels.v_px - v[:, None])
    reach = 3.5 * trails.sigma_px
    inside = pixels.usable & (np.abs(across) < reach + np.abs(image.bow_px))
    inside &= np.abs(along) < 0.5 * image.length_px + reach
    light = np.where(inside, pixels.light, 0.0)
    # In an even trail the mean light is at the middle; in a ramp or a step it is not.
    total = np.maximum(light.sum(axis=1), 1e-9)
    return np.asarray((light * along).sum(axis=1) / total)


LEAST_CLEAR, LEAST_DRAWN_OUT, LEAST_COHERENCE = 8, 0.15, 0.6
"""Criteria for trailed images: least number, ellipticity, and smoothness over the picture."""


def may_trail(
    u_px: Vector, v_px: Vector, drawn_out: npt.NDArray[np.complex128], side_px: int
) -> bool:
    """True if bright images (n) are elongated alike, judged by their central parts.

    `drawn_out` is complex: its size is the ellipticity, its angle twice the direction. It differs
    randomly between stars that stand still.
    """
    if len(u_px) < LEAST_CLEAR or np.median(np.abs(drawn_out)) < LEAST_DRAWN_OUT:
        return False
    x, y = u_px / side_px - 0.5, v_px / side_px - 0.5
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y][: len(x) - 2], axis=1)
    left = drawn_out - design @ np.linalg.lstsq(design, drawn_out, rcond=None)[0]
    freedom = (len(x) - design.shape[1]) / len(x)
    share = float((np.abs(left) ** 2).sum() / (np.abs(drawn_out) ** 2).sum()) / freedom
    return bool(1.0 - share > LEAST_COHERENCE)


TWIN_ANCHORS, TWIN_OTHERS, TWIN_SHARE, LEAST_TWINS = 16, 60, 0.6, 9
TWIN_REACH_SHARE, TWIN_GATE_PX, TWIN_RATIO = 0.125, 1.0, 1.35


def twin_distance_px(u_px: Vector, v_px: Vector, flux: Vector, side_px: int) -> float | None:
    """Distance in pixels of the two images that every star has; None without such twins.

    Stars (n) are given the clearest first. All pairs have the same displacement and ratio of light.
    """
    u_px, v_px, flux = (each[:TWIN_OTHERS] for each in (u_px, v_px, flux))
    count = min(len(u_px), TWIN_ANCHORS)
    if count < LEAST_TWINS:
        return None
    du, dv = u_px - u_px[:count, None], v_px - v_px[:count, None]
    apart = np.hypot(du, dv)
    anchor, other = np.nonzero((apart > 0.0) & (apart < TWIN_REACH_SHARE * side_px))
    du, dv, apart = du[anchor, other], dv[anchor, other], apart[anchor, other]
    share = np.log(np.maximum(flux[other], 1e-9) / np.maximum(flux[anchor], 1e-9))
    # At least this share of anchors must have a twin, so one of the first anchors has one.
    tried = np.flatnonzero(anchor < count - math.ceil(TWIN_SHARE * count) + 1)
    for k in tried.tolist():
        # A twin lies on either side: the star itself may be the twin of the other.
        same = np.zeros(len(du), dtype=bool)
        for sense in (1.0, -1.0):
            alike = (np.abs(du - sense * du[k]) < TWIN_GATE_PX) & (
                np.abs(dv - sense * dv[k]) < TWIN_GATE_PX
            )
            same |= alike & (np.abs(share - sense * share[k]) < math.log(TWIN_RATIO))
        if len(np.unique(anchor[same])) >= max(TWIN_SHARE * count, LEAST_TWINS):
            return float(apart[k])
    return None


PEAK_WIDTHS = 1.5
TILE_PX, LEAST_TILE_PX = 256, 48
TILE_WIDTHS = 3.0
"""Largest difference of trails within one tile of the filter, in widths of a star's image."""
SURROUND = 3.0
FILTER_REACH = 4.0
MOST_UNEXPLAINED = 0.5
CLEAR_RATIO = 20.0


def find_trails(
    light: CountArray, noise: CountArray | float, trails: Trails, threshold: float, most: int
) -> tuple[Vector, Vector, Vector]:
    """Places along u and v (n,) and signal to noise of star trails, the clearest first.

    The light is filtered with the shape of a trail minus its surroundings.
    """
    filtered = np.zeros(light.shape, dtype=np.float32)
    rows, columns = light.shape
    signal = np.asarray(light / noise, dtype=np.float32)
    side = _tile_px(trails, rows, columns)
    for top in range(0, rows, side):
        for left in range(0, columns, side):
            bottom, right = min(top + side, rows), min(left + side, columns)
            filtered[top:bottom, left:right] = _filtered_tile(
                signal, trails, (top, left, bottom, right)
            )
    spread = sep.Background(np.ascontiguousarray(filtered[::2, ::2]), bw=32, bh=32)
    behind = spread.rms(dtype=np.float32)
    # Where bright trails are dense, the local noise would be underestimated.
    np.maximum(behind, 0.5 * float(np.median(behind)) or 1e-12, out=behind)
    ratio = filtered / np.repeat(np.repeat(behind, 2, axis=0), 2, axis=1)[:rows, :columns]
    v, u = np.nonzero(ratio > threshold)
    edge = int(2.0 * trails.sigma_px) + 1
    inside = (v >= edge) & (v < rows - edge) & (u >= edge) & (u < columns - edge)
    v, u = v[inside], u[inside]
    reach = min(math.ceil(PEAK_WIDTHS * trails.sigma_px), edge)
    highest = np.ones(len(u), dtype=bool)
    for down in range(-reach, reach + 1):
        for across in range(-reach, reach + 1):
            highest &= ratio[v, u] >= ratio[v + down, u + across]
    u, v = u[highest], v[highest]
    order = np.argsort(-ratio[v, u], kind="stable")[: 4 * most]
    u, v = u[order], v[order]
    kept = _alone(trails, u.astype(np.float64), v.astype(np.float64))[:most]
    u, v = u[kept], v[kept]
    return u.astype(np.float64), v.astype(np.float64), ratio[v, u].astype(np.float64)


def _tile_px(trails: Trails, rows: int, columns: int) -> int:
    """The side of square tiles within which all trails are nearly alike, in pixels."""
    motion = trails.motion
    u, v = np.array([0.0, columns, 0.0, columns]), np.array([0.0, 0.0, rows, rows])
    along_u, along_v, _ = motion.trails(u, v)
    differ = max(float(np.ptp(along_u)), float(np.ptp(along_v))) / max(rows, columns)
    alike = max(TILE_WIDTHS * trails.sigma_px, 0.2 * trails.length_px)
    return int(min(max(alike / max(differ, 1e-9), LEAST_TILE_PX), TILE_PX))


def _filtered_tile(
    light: CountArray, trails: Trails, tile: tuple[int, int, int, int]
) -> CountArray:
    """The light of a tile (top, left, bottom, right) filtered with the trail at its middle."""
    top, left, bottom, right = tile
    rows, columns = light.shape
    u, v = np.array([0.5 * (left + right - 1)]), np.array([0.5 * (top + bottom - 1)])
    along_u, along_v, _ = (float(each[0]) for each in trails.motion.trails(u, v))
    sigma = trails.sigma_px
    reach = math.ceil(FILTER_REACH * SURROUND * sigma + 0.5 * math.hypot(along_u, along_v))
    first_row, first_column = max(top - reach, 0), max(left - reach, 0)
    part = light[first_row : min(bottom + reach, rows), first_column : min(right + reach, columns)]
    down = fft.next_fast_len(part.shape[0] + reach, real=True)
    across = fft.next_fast_len(part.shape[1] + reach, real=True)
    v_cycles, u_cycles = fft.fftfreq(down)[:, None], fft.rfftfreq(across)[None, :]
    square = -2.0 * (math.pi * sigma) ** 2 * (v_cycles**2 + u_cycles**2)
    response = np.exp(square) - np.exp(SURROUND**2 * square)
    response *= np.sinc(along_u * u_cycles + along_v * v_cycles)
    spectrum = fft.rfft2(part, (down, across)) * response.astype(np.float32)
    whole = fft.irfft2(spectrum, (down, across), overwrite_x=True)
    return np.asarray(
        whole[top - first_row : bottom - first_row, left - first_column : right - first_column],
        dtype=np.float32,
    )


def _alone(trails: Trails, u: Vector, v: Vector) -> npt.NDArray[np.intp]:
    """The indices of places, in order of their signal, that lie on no clearer star's trail."""
    along_u, along_v, _ = trails.motion.trails(u, v)
    length = np.maximum(np.hypot(along_u, along_v), 1e-9)
    cos, sin = along_u / length, along_v / length
    reach = 2.0 * trails.sigma_px
    kept: list[int] = []
    for k in range(len(u)):
        du, dv = u[k] - u[kept], v[k] - v[kept]
        along = np.abs(du * cos[kept] + dv * sin[kept])
        across = np.abs(dv * cos[kept] - du * sin[kept])
        if not np.any((along < 0.5 * length[kept] + reach) & (across < reach)):
            kept.append(k)
    return np.array(kept, dtype=np.intp)


def placed_trails(
    light: CountArray,
    noise: CountArray | float,
    usable: npt.NDArray[np.bool_] | None,
    trails: Trails,
    u_px: Vector,
    v_px: Vector,
    gain_e_per_count: float = math.inf,
) -> TrailPlaces:
    """Stars (n) fitted with their trails near given places, with covariances; see `fit_trails`."""
    placed = _placed(light, noise, usable, trails, u_px, v_px, gain_e_per_count)
    # The second fit subtracts the light of all other stars.
    all_light = _drawn(trails, placed, light.shape)
    return _placed(
        light, noise, usable, trails, placed.u_px, placed.v_px, gain_e_per_count, all_light, placed
    )


def _placed(
    light: CountArray,
    noise: CountArray | float,
    usable: npt.NDArray[np.bool_] | None,
    trails: Trails,
    u_px: Vector,
    v_px: Vector,
    gain_e_per_count: float,
    all_light: CountArray | None = None,
    before: TrailPlaces | None = None,
) -> TrailPlaces:
    """The stars fitted in chunks with their trails; `all_light` has other stars to subtract."""
    longest = max(float(np.hypot(*trails.motion.trails(u_px, v_px)[:2]).max(initial=0.0)), 1.0)
    chunk = max(int(CHUNK_PIXELS / (longest + 12.0 * trails.sigma_px) ** 2), 1)
    parts = []
    for first in range(0, max(len(u_px), 1), chunk):
        part = slice(first, first + chunk)
        u, v = u_px[part], v_px[part]
        image = trails.image_at(u, v)
        pixels = TrailPixels.about(image, u, v, light, noise, usable)
        if all_light is not None and before is not None:
            rows, columns = light.shape
            at_v = np.clip(pixels.v_px, 0, rows - 1).astype(np.int64)
            at_u = np.clip(pixels.u_px, 0, columns - 1).astype(np.int64)
            own = before.flux_counts[part, None] * image.pixel(
                pixels.u_px - u[:, None], pixels.v_px - v[:, None]
            )
            pixels = replace(pixels, light=pixels.light - (all_light[at_v, at_u] - own))
        parts.append(fit_trails(pixels, image, u, v, gain_e_per_count))
    names = ("u_px", "v_px", "flux_counts", "covariance", "chi_square", "unexplained")
    return TrailPlaces(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def _drawn(trails: Trails, placed: TrailPlaces, shape: tuple[int, int]) -> CountArray:
    """The modelled light of all stars (rows, columns), drawn as far as it is significant."""
    whole = np.zeros(shape)
    nothing = np.zeros(shape, dtype=np.float32)
    for first in range(0, len(placed.u_px), 40):
        part = slice(first, first + 40)
        u, v = placed.u_px[part], placed.v_px[part]
        image = trails.image_at(u, v)
        pixels = TrailPixels.about(image, u, v, nothing, 1.0, None)
        value = placed.flux_counts[part, None] * image.pixel(
            pixels.u_px - u[:, None], pixels.v_px - v[:, None]
        )
        inside = pixels.usable
        at = pixels.v_px[inside].astype(np.int64), pixels.u_px[inside].astype(np.int64)
        np.add.at(whole, at, value[inside])
    return whole
