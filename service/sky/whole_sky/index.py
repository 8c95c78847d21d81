"""The whole-sky index for a search without a prior.

Star pairs are sorted into classes of the fainter star's magnitude, then by separation, so that
candidates for an observed pair are found without examining fainter stars; bitmaps show where no
star is; and every patch of the sky has a list of the stars that a field of view centred there may
contain.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from service.compiled.arrays import view_into
from service.compiled.jit import njit
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.files import Content
from service.sky.geometry.pairs import build_pairs
from service.sky.geometry.star_grid import build_star_grid
from service.sky.whole_sky.bitmap import build_sky_bitmap
from service.vectors import ARCSEC_PER_RADIAN, Vector, read_only

LINE = 64
"""Alignment of arrays in the block, the size of a processor's cache line."""
HEAD_WORDS = 64
"""Number of 64-bit words in the head of the block, three per array."""
FIRST, LAST, ROWS = 0, 1, 2
"""The words of an array in the head: its first byte, the byte after its last, and its rows."""

StoreBytes = npt.NDArray[np.uint8]
Form = tuple[str, Sequence[int]]
"""The data type and shape of an array, from which its view is made."""


def stored(arrays: Sequence[npt.NDArray[Any]]) -> tuple[StoreBytes, list[npt.NDArray[Any]]]:
    """A read-only block with copies of arrays, and views of the copies."""
    head = np.zeros(HEAD_WORDS, np.int64)
    at = head.nbytes
    for k, array in enumerate(arrays):
        head[3 * k : 3 * k + 3] = at, at + array.nbytes, len(array)
        at += -(-array.nbytes // LINE) * LINE
    store = np.zeros(at, np.uint8)
    store[: head.nbytes] = head.view(np.uint8)
    for k, array in enumerate(arrays):
        store[head[3 * k + FIRST] : head[3 * k + LAST]] = (
            np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        )
    return read_only(store), views_of(store, [(each.dtype.str, each.shape) for each in arrays])


def views_of(store: StoreBytes, forms: Sequence[Form]) -> list[npt.NDArray[Any]]:
    """Read-only views of the arrays in a block, by their types and shapes."""
    head = store[: 8 * HEAD_WORDS].view(np.int64)
    return [
        read_only(store[head[3 * k + FIRST] : head[3 * k + LAST]].view(dtype).reshape(shape))
        for k, (dtype, shape) in enumerate(forms)
    ]


BUCKET_RAD = 4.0 / ARCSEC_PER_RADIAN
"""Width in radians of the buckets of pair separations."""
MAX_PAIR_DEG = 8.0
FURTHER_MAG = 1.0
"""Magnitudes beyond the limit to which stars are matched, since noise may make them visible."""
CLASSES_BELOW_LIMIT_MAG = (2.5, 2.0, 1.5, 1.25, 1.0, 0.75, 0.5, 0.25)
BITMAP_RADII_RAD = tuple(
    arcsec / ARCSEC_PER_RADIAN
    for arcsec in (60.0, 140.0, 190.0, 240.0, 310.0, 400.0, 530.0, 700.0, 1500.0)
)
PATCHES = 24
"""Number of sky patches along an edge of each face of the cube."""
PATCH_RADIUS_RAD = math.sqrt(2.0) / PATCHES
"""Largest distance from the middle of a patch to its corners, at a face's middle, in radians."""
BRIGHTEST_MAG, STEP_MAG = -2.0, 0.05
"""First magnitude and step of the table that counts brighter stars by magnitude."""
MAX_STARS = 60_000
"""Largest number of stars in a whole-sky index, since rows are stored in 16 bits."""
MAX_PAIRS = 1_500_000
"""Largest number of pairs in a whole-sky index (6 MB), which limits the stars of deep catalogs."""


class Index(NamedTuple):
    """The whole-sky index in the form that kernels take.

    `stars` (n, 4) holds x, y, z and the magnitude, `place` (n, 4) the same in single precision for
    filtering, and `cell_place` the same in the order of `cell_rows`; `brighter` (k) the number of
    stars brighter than each magnitude step; `pairs` (p, 2) the brighter and the dimmer row;
    `class_edge` (c, 2) the faintest magnitude of each class, the limit for the last one, and the
    cumulative share of all pairs; `face` (6, 5) the grid's box and offset. `bits` has a bitmap for
    every radius, of the stars within the limit, and then the same for all stars. Pairs are of stars
    within the limit; the grid and the patches also have fainter stars.
    """

    stars: Any
    pairs: Any
    offset: Any
    class_edge: Any
    bits: Any
    face: Any
    cell_start: Any
    cell_rows: Any
    patch_start: Any
    patch_rows: Any
    place: Any
    cell_place: Any
    brighter: Any


ARRAYS = len(Index._fields)
AT = Index(*range(ARRAYS))
"""The position of each array in the head of an index's block of memory."""


@dataclass(frozen=True, eq=False)
class SkyIndex:
    """The whole-sky index of a run catalog, for fields of view up to a radius.

    `offset` (classes, buckets + 1) has the index in `arrays.pairs` of the first pair of each class
    and separation bucket; `patch_start` and `patch_rows` list the stars within reach of a field of
    view in each patch, brightest first. Pairs are of stars to `limit_mag`; the resulting attitudes
    are tested with stars `FURTHER_MAG` fainter. All arrays are views of `store`, one read-only
    block.
    """

    run_catalog: str
    limit_mag: float
    radius_deg: float
    store: StoreBytes
    arrays: Index

    @property
    def nbytes(self) -> int:
        """The size of the whole-sky index in memory, in bytes."""
        return self.store.nbytes

    @property
    def content(self) -> Content:
        """The whole-sky index as the content of a sky file."""
        facts = {
            "run_catalog": self.run_catalog,
            "limit_mag": self.limit_mag,
            "radius_deg": self.radius_deg,
            "forms": [(each.dtype.str, each.shape) for each in self.arrays],
        }
        return Content(facts, {"store": self.store})

    @classmethod
    def of_content(cls, content: Content) -> "SkyIndex":
        """A whole-sky index from the content of a sky file."""
        facts, store = dict(content.facts), content.arrays["store"]
        arrays = Index(*views_of(store, facts.pop("forms")))
        return cls(**facts, store=store, arrays=arrays)

    @property
    def stars(self) -> int:
        """The number of stars in the index."""
        return len(self.arrays.stars)

    @property
    def pairs(self) -> int:
        """The number of star pairs in the index."""
        return len(self.arrays.pairs)


def build_sky_index(run_catalog: RunCatalog, limit_mag: float, radius_deg: float) -> SkyIndex:
    """The whole-sky index of stars to a limit, for fields of view with corners at `radius_deg`.

    Fainter stars of the run catalog are used for matching only. If there are too many stars, the
    faintest are left out.
    """
    magnitude = run_catalog.magnitude_mag
    separation_max_deg = min(MAX_PAIR_DEG, 2.0 * radius_deg)
    # Evenly distributed stars make n^2 (1 - cos(separation)) / 4 pairs, real ones somewhat more.
    within = 1.0 - math.cos(math.radians(separation_max_deg))
    most = min(MAX_STARS, int(math.sqrt(3.0 * MAX_PAIRS / within)))
    count = min(int(np.searchsorted(magnitude, limit_mag, "right")), most)
    known = min(int(np.searchsorted(magnitude, limit_mag + FURTHER_MAG, "right")), MAX_STARS)
    # If not all stars within the limit fit, fainter ones would leave a gap.
    if count < np.searchsorted(magnitude, limit_mag, "right"):
        known = count
    direction = np.ascontiguousarray(run_catalog.direction[:known])
    within_limit = direction[:count]
    pairs = build_pairs(within_limit, separation_max_deg)
    edge = limit_mag - np.array([*CLASSES_BELOW_LIMIT_MAG, 0.0])
    pair_class = np.searchsorted(edge, magnitude[pairs.dimmer])
    bucket = (pairs.separation_rad / BUCKET_RAD).astype(np.int64)
    buckets = int(math.radians(separation_max_deg) / BUCKET_RAD) + 1
    # Sorted by bucket, not by separation within a bucket, so that nearby stars are close in memory.
    order = np.lexsort((pairs.dimmer, bucket, pair_class))
    key = (pair_class * buckets + bucket)[order]
    start = np.searchsorted(key, np.arange(len(edge) * buckets + 1))
    rows = np.arange(len(edge))[:, None] * buckets + np.arange(buckets + 1)[None, :]
    share = np.cumsum(np.bincount(pair_class, minlength=len(edge))) / max(pairs.count, 1)
    patch_start, patch_rows = _patches(direction, radius_deg)
    grid = build_star_grid(direction)
    place = np.column_stack([direction, magnitude[:known]]).astype(np.float32)
    arrays = Index(
        stars=np.column_stack([direction, magnitude[:known]]),
        pairs=np.column_stack([pairs.brighter, pairs.dimmer])[order].astype(np.uint16),
        offset=start[rows].astype(np.int32),
        class_edge=np.column_stack([edge, share]),
        bits=np.stack(
            [
                build_sky_bitmap(some, radius)
                for some in (within_limit, direction)
                for radius in BITMAP_RADII_RAD
            ]
        ),
        face=np.column_stack([grid.box, grid.offset]).astype(np.int32),
        cell_start=grid.start,
        cell_rows=grid.rows.astype(np.uint16),
        patch_start=patch_start,
        patch_rows=patch_rows,
        place=place,
        cell_place=place[grid.rows],
        brighter=_brighter(magnitude[:known]),
    )
    store, views = stored(arrays)
    return SkyIndex(run_catalog.digest, limit_mag, radius_deg, store, Index(*views))


def _brighter(magnitude: Vector) -> npt.NDArray[np.int32]:
    """The number of stars brighter than each magnitude step; zero for the first step."""
    steps = int((magnitude[-1] - BRIGHTEST_MAG) / STEP_MAG) + 2 if len(magnitude) else 1
    brighter = np.searchsorted(magnitude, BRIGHTEST_MAG + STEP_MAG * np.arange(max(steps, 1)))
    brighter[0] = 0
    return brighter.astype(np.int32)


@njit(nogil=True)
def index_in(store):  # type: ignore[no-untyped-def]
    """Views of the whole-sky index in a block of memory, which the caller keeps alive."""
    head = view_into(store, 0, (ARRAYS, 3), np.int64)
    classes, levels = head[AT.offset, ROWS], head[AT.bits, ROWS]
    buckets = (head[AT.offset, LAST] - head[AT.offset, FIRST]) // 4 // classes
    level_bytes = (head[AT.bits, LAST] - head[AT.bits, FIRST]) // levels
    return Index(
        _array(store, head, AT.stars, 4, np.float64),
        _array(store, head, AT.pairs, 2, np.uint16),
        view_into(store, head[AT.offset, FIRST], (classes, buckets), np.int32),
        _array(store, head, AT.class_edge, 2, np.float64),
        view_into(store, head[AT.bits, FIRST], (levels, level_bytes), np.uint8),
        _array(store, head, AT.face, 5, np.int32),
        _column(store, head, AT.cell_start, np.int32),
        _column(store, head, AT.cell_rows, np.uint16),
        _column(store, head, AT.patch_start, np.int32),
        _column(store, head, AT.patch_rows, np.uint16),
        _array(store, head, AT.place, 4, np.float32),
        _array(store, head, AT.cell_place, 4, np.float32),
        _column(store, head, AT.brighter, np.int32),
    )


@njit(nogil=True)
def _array(store, head, at, columns, dtype):  # type: ignore[no-untyped-def]
    return view_into(store, head[at, FIRST], (head[at, ROWS], columns), dtype)


@njit(nogil=True)
def _column(store, head, at, dtype):  # type: ignore[no-untyped-def]
    return view_into(store, head[at, FIRST], (head[at, ROWS],), dtype)


def _patches(
    direction: Vector, radius_deg: float
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.uint16]]:
    """Start and rows, by sky patch, of the stars in any field of view aimed at that patch."""
    least = math.cos(min(math.radians(radius_deg) + PATCH_RADIUS_RAD, math.pi))
    middle = (np.arange(PATCHES) + 0.5) * 2.0 / PATCHES - 1.0
    start, rows = [0], []
    for face in range(6):
        axis, side = divmod(face, 2)
        for u in middle:
            for v in middle:
                p = np.empty(3)
                p[axis], p[(axis + 1) % 3], p[(axis + 2) % 3] = 1.0 - 2.0 * side, u, v
                found = np.flatnonzero(direction @ (p / math.sqrt(p @ p)) >= least)
                start.append(start[-1] + len(found))
                rows.append(found)
    return np.array(start, np.int32), np.concatenate(rows).astype(np.uint16)


@njit(nogil=True, inline="always")
def patch_of(p):  # type: ignore[no-untyped-def]
    """The number of the sky patch of a direction (3,)."""
    axis = 0
    if abs(p[1]) > abs(p[axis]):
        axis = 1
    if abs(p[2]) > abs(p[axis]):
        axis = 2
    face = 2 * axis + (1 if p[axis] < 0.0 else 0)
    scale = 0.5 * PATCHES / abs(p[axis])
    u = min(int(p[(axis + 1) % 3] * scale + 0.5 * PATCHES), PATCHES - 1)
    v = min(int(p[(axis + 2) % 3] * scale + 0.5 * PATCHES), PATCHES - 1)
    return (face * PATCHES + u) * PATCHES + v
