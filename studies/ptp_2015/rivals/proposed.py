"""Answers and interface of the identification algorithms in the comparison."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from service.identify.triangles.triangle_match import count_pairs, validate
from service.sky.catalog.run_catalog import RunCatalog
from studies.scenes import Scene

Rows = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Proposed:
    """Answer of an identification algorithm for one field.

    `match` (n,) is the algorithm's answer, rows of the star list or -1.  `image` and `star` are the
    pairs that it considers possible, the likeliest first, as input of an attitude check.
    """

    match: Rows
    image: Rows
    star: Rows


class Algorithm(Protocol):
    """Interface of an identification algorithm with its database."""

    @property
    def entries(self) -> int:
        """Number of rows in the algorithm's database."""
        ...

    @property
    def nbytes(self) -> int:
        """Size of the database in bytes, without the star list that every algorithm needs."""
        ...

    def identify(self, scene: Scene) -> Proposed:
        """Name the stars of a field; `scene.sigma_rad` is the noise that may be assumed."""
        ...


class Build(Protocol):
    """Interface of a function that builds an algorithm's database for a run catalog."""

    def __call__(self, stars: RunCatalog) -> Algorithm:
        """Build the algorithm with its database."""
        ...


def proposed_by_votes(image: Rows, star: Rows, stars: int, n: int, shared: bool) -> Proposed:
    """Most-voted names by matched triangles (m, 3); `shared`: only names by sharing stars count."""
    pairs, held = np.empty((3, 3 * len(image)), np.int32), np.empty(3 * len(image), np.bool_)
    count = 0
    if len(image):
        count = count_pairs(image, star, stars, pairs[0], pairs[1], pairs[2], held)
    named, row, votes = pairs[:, :count]
    match = np.empty(n, np.int32)
    validate(named, row, votes, held[:count] if shared else np.ones(count, np.bool_), match)
    return Proposed(match, named, row)
