"""Answers and interface of the identification algorithms in the comparison."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from service.identify.triangles.triangle_match import count_pairs, validate
from service.simulate.scenes import Scene
from service.sky.catalog.run_catalog import RunCatalog

Rows = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Proposed:
    """An algorithm's word on one field.

    `match` (n,) is its own answer, rows of the star list or -1.  `image` and
    `star` are the pairs that it thinks possible, the likeliest first: what an
    attitude check may be made of.
    """

    match: Rows
    image: Rows
    star: Rows


class Algorithm(Protocol):
    """A database with the search in it."""

    @property
    def entries(self) -> int:
        """Rows of the database."""
        ...

    @property
    def nbytes(self) -> int:
        """Bytes of the database, without the star list that every algorithm needs."""
        ...

    def identify(self, scene: Scene) -> Proposed:
        """Name the stars of a field; `scene.sigma_rad` is what it is told of the noise."""
        ...


class Build(Protocol):
    """Makes an algorithm's database for the stars of a run catalog."""

    def __call__(self, stars: RunCatalog) -> Algorithm:
        """The algorithm, ready."""
        ...


def proposed_by_votes(image: Rows, star: Rows, stars: int, n: int, shared: bool) -> Proposed:
    """Each star's most-voted name of matched triangles (m, 3); `shared`: sharing stars decide."""
    pairs, held = np.empty((3, 3 * len(image)), np.int32), np.empty(3 * len(image), np.bool_)
    count = 0
    if len(image):
        count = count_pairs(image, star, stars, pairs[0], pairs[1], pairs[2], held)
    named, row, votes = pairs[:, :count]
    match = np.empty(n, np.int32)
    validate(named, row, votes, held[:count] if shared else np.ones(count, np.bool_), match)
    return Proposed(match, named, row)
