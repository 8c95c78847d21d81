"""Patterns of four stars by shape, independent of scale: the pattern index of the blind solver.

The two stars farthest apart define a frame, in which the other two have four coordinates,
independent of rotation and scale (Lang et al. 2010). A mirrored pattern has another code.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from service.vectors import Vector

Rows = npt.NDArray[np.int32]

LEVELS_DEG = (2.4, 4.8, 9.6, 19.2, 1.2)
"""Radii in degrees of the caps whose stars make patterns; patterns are up to twice as wide.

The narrowest level is the most expensive to build, and searched last.
"""
DEEPEST_RANK = 8
"""A star is used at a level if it has fewer brighter stars than this in the cap about it."""
COMPANIONS = 5
"""Number of brightest stars in each star's cap that make patterns with the star."""
LEAST_WIDTH = 0.6
"""Least width of a pattern, as a share of the level's radius; narrower ones belong to the next
level.
"""
_PAIRS = np.array(list(combinations(range(4), 2)))
_OTHERS = np.array([[k for k in range(4) if k not in pair] for pair in _PAIRS.tolist()])


@dataclass(frozen=True, eq=False)
class QuadLevel:
    """The star patterns of one angular size.

    `stars` (q, 4) are catalog rows in the order of the code, `chord` (q,) the distance of the first
    two as a chord of the unit sphere, `tree` a search tree of the codes.
    """

    radius_deg: float
    stars: Rows
    chord: npt.NDArray[np.float32]
    tree: cKDTree

    @property
    def nbytes(self) -> int:
        """The size of the patterns in memory in bytes, with the tree estimated."""
        return int(self.stars.nbytes + self.chord.nbytes + 56 * len(self.stars))


def build_quad_level(direction: Vector, radius_deg: float) -> QuadLevel:
    """The star patterns among directions (n, 3), brightest first, within caps of a radius.

    Every part of the sky, rich or poor, contributes about as many of its brightest stars.
    """
    cap = 0.5 * (1.0 - np.cos(np.radians(radius_deg)))
    # Three times the number for evenly distributed stars, so that poor regions have enough.
    used = min(len(direction), int(3 * DEEPEST_RANK / cap))
    reach = 2.0 * np.sin(0.5 * np.radians(radius_deg))
    pairs = cKDTree(direction[:used]).query_pairs(reach, output_type="ndarray")
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    first = np.searchsorted(both[:, 0], np.arange(used + 1))
    brighter = np.bincount(pairs.max(axis=1), minlength=used)
    enough = np.diff(first) >= COMPANIONS
    star = np.flatnonzero((brighter < DEEPEST_RANK) & enough)
    near = both[first[star][:, None] + np.arange(COMPANIONS), 1]
    chosen = np.array(list(combinations(range(COMPANIONS), 3)))
    three = near[:, chosen].reshape(-1, 3)
    quads = np.column_stack([np.repeat(star, len(chosen)), three])
    quads = np.unique(np.sort(quads, axis=1), axis=0)
    code, order, chord = quad_codes(direction[quads])
    wide = chord >= LEAST_WIDTH * np.radians(radius_deg)
    stars = np.take_along_axis(quads, order, axis=1)[wide].astype(np.int32)
    return QuadLevel(radius_deg, stars, chord[wide].astype(np.float32), cKDTree(code[wide]))


def quad_codes(direction: Vector) -> tuple[Vector, Rows, Vector]:
    """The codes (q, 4) of patterns (q, 4, 3), the order of their stars, the largest chord (q,).

    Coordinates are on the plane that touches the sky between the two stars farthest apart, in units
    of half their distance. The two are ordered so that the others lie nearer to the first, the
    others from left to right.
    """
    apart = direction[:, _PAIRS[:, 0]] - direction[:, _PAIRS[:, 1]]
    chord2 = np.einsum("qki,qki->qk", apart, apart)
    widest = chord2.argmax(axis=1)
    order = np.concatenate([_PAIRS[widest], _OTHERS[widest]], axis=1)
    chord = np.sqrt(np.take_along_axis(chord2, widest[:, None], axis=1)[:, 0])
    sorted_ = np.take_along_axis(direction, order[:, :, None], axis=1)
    middle = sorted_[:, 0] + sorted_[:, 1]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    along = (sorted_[:, 1] - sorted_[:, 0]) / chord[:, None]
    half = 0.5 * chord / np.sqrt(1.0 - 0.25 * chord**2)
    rest = sorted_[:, 2:]
    depth = np.einsum("qki,qi->qk", rest, middle) * half[:, None]
    x = np.einsum("qki,qi->qk", rest, along) / depth
    y = np.einsum("qki,qi->qk", rest, np.cross(middle, along)) / depth
    turned = x.sum(axis=1) > 0.0
    x[turned], y[turned] = -x[turned], -y[turned]
    order[turned] = order[turned][:, [1, 0, 2, 3]]
    swapped = x[:, 0] > x[:, 1]
    x[swapped], y[swapped] = x[swapped][:, ::-1], y[swapped][:, ::-1]
    order[swapped] = order[swapped][:, [0, 1, 3, 2]]
    return np.column_stack([x[:, 0], y[:, 0], x[:, 1], y[:, 1]]), order, chord
