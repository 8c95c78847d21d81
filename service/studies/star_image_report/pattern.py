"""The pattern constant K: one number that knows a group of stars (report, 7.8).

K is the sum of the squared distances of all pairs.  It stays the same when the field
moves or turns, and needs no pairing of u with v.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault
from service.imaging.centroids.window import Array


def pattern_constant(u: npt.ArrayLike, v: npt.ArrayLike) -> float:
    """K = (N - 1)(sum u² + sum v²) - sum over i, j of (u_i u_j + v_i v_j) (7.43), unpaired.

    Computed as N sum |r - mean|², which is the same and does not cancel.  (In the
    report 7.42 reads "a" for its second 2, and 7.46 pairs x with y where both are one.)
    """
    x, y = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
    if x.shape != y.shape or x.ndim != 1:
        raise BadInput(Fault("v", "must be as many as u", f"{x.shape}, {y.shape}"))
    spread = float(np.sum((x - x.mean()) ** 2) + np.sum((y - y.mean()) ** 2))
    return len(x) * spread


def chord_constant(vectors: npt.ArrayLike) -> float:
    """The same of unit vectors (n, 3), by their chords: exact for any pointing in a wide field."""
    v = np.asarray(vectors, dtype=np.float64)
    return len(v) * float(np.sum((v - v.mean(axis=0)) ** 2))


def constant_sigma(constant: float, stars: int, position_sigma: float) -> float:
    """sigma_K = 2 sigma sqrt(N K) for errors `position_sigma` per axis."""
    return 2.0 * position_sigma * math.sqrt(stars * constant)


@dataclass(frozen=True)
class PatternStore:
    """Known fields by (number of stars, sqrt(K / N)), whose noise is the same for all: sigma.

    One missing or false star makes another pattern of a field; alone this tells apart some
    thirty fields, and beyond that narrows a search.
    """

    names: tuple[str, ...]
    stars: npt.NDArray[np.intp]
    keys: Array

    def within(
        self, stars: int, constant: float, position_sigma: float, sigmas: float = 3.0
    ) -> list[str]:
        """The stored fields of as many stars within the tolerance, nearest first."""
        order, distance = self._ranked(stars, constant)
        return [self.names[i] for i in order if distance[i] <= sigmas * position_sigma]

    def nearest(self, stars: int, constant: float) -> str | None:
        """The stored field of as many stars that is nearest; None where there is none."""
        order, _ = self._ranked(stars, constant)
        return self.names[order[0]] if len(order) else None

    def _ranked(self, stars: int, constant: float) -> tuple[npt.NDArray[np.intp], Array]:
        distance = np.abs(self.keys - key_of(stars, constant))
        same = np.flatnonzero(self.stars == stars)
        return same[np.argsort(distance[same], kind="stable")], distance


def key_of(stars: int, constant: float) -> float:
    """sqrt(K / N)."""
    return math.sqrt(constant / stars)


def store_of(patterns: dict[str, tuple[int, float]]) -> PatternStore:
    """A store of fields by name: number of stars and K."""
    counts = np.array([stars for stars, _ in patterns.values()], dtype=np.intp)
    keys = np.array([key_of(stars, constant) for stars, constant in patterns.values()])
    return PatternStore(tuple(patterns), counts, keys)
