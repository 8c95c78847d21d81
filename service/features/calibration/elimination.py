"""Normal equations with the attitudes eliminated, and a test of which unknowns are observable.

The attitude of a batch affects its own stars only.  Eliminating it block by block (Schur
complement) leaves a small system of the unknowns alone, equivalent to a least squares over all
attitudes and unknowns together.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from service.features.calibration.linearise import Kind, Linearised, Unknown, Weights, largest_sigma
from service.features.calibration.stars import Indices
from service.missions.mission import Tracker
from service.vectors import Matrix, Vector

ATTITUDE_PRIOR = 1.0
"""A priori information (1/rad^2) on every attitude, so that a batch with one star is solvable."""


@dataclass(frozen=True, eq=False)
class Normal:
    """Reduced normal equations: `matrix` (p, p) times the step = `right` (p,).

    `squares` is the weighted sum of squares that remains with the best attitudes and no
    step; `full` (p,) the diagonal before the attitudes were eliminated.
    """

    matrix: Matrix
    right: Vector
    squares: float
    full: Vector

    def __add__(self, other: "Normal") -> "Normal":
        pairs = ((getattr(self, each.name), getattr(other, each.name)) for each in fields(self))
        return Normal(*(one + another for one, another in pairs))

    def __sub__(self, other: "Normal") -> "Normal":
        pairs = ((getattr(self, each.name), getattr(other, each.name)) for each in fields(self))
        return Normal(*(one - another for one, another in pairs))

    def solution(self, free: Indices) -> Vector:
        """Solve the equations for the unknowns `free`; the step (p,) of all others is zero."""
        step = np.zeros(len(self.right))
        if len(free):
            inner = self.matrix[np.ix_(free, free)]
            scale = 1.0 / np.sqrt(np.diag(inner))
            scaled = inner * np.outer(scale, scale)
            step[free] = np.linalg.solve(scaled, self.right[free] * scale) * scale
        return step

    def squares_after(self, step: Vector) -> float:
        """Weighted sum of squared residuals after a step (p,), with optimal attitudes."""
        return float(self.squares - 2.0 * self.right @ step + step @ self.matrix @ step)


@dataclass(frozen=True, eq=False)
class Eliminated:
    """Normal equations from which the attitude of every batch is eliminated.

    `blocks` holds one system per block of batches.  `whiten` (K, 3, 3) are the inverted Cholesky
    factors L^-1 of the attitudes' own blocks and `coupling` (3 K, p) is L^-1 times the blocks that
    couple attitudes and unknowns; both are None if the attitudes are known.
    """

    parts: Sequence[Linearised]
    blocks: tuple[Normal, ...]
    whiten: Matrix | None
    coupling: Matrix | None

    @property
    def normal(self) -> Normal:
        """Sum of the normal equations of all batches."""
        first, *others = self.blocks
        return sum(others, start=first)

    def steps(
        self, normal: Normal, residual: Vector, weight: Weights, free: Indices
    ) -> tuple[Vector, Vector, float]:
        """Solve for steps of unknowns (p,) and attitudes (K, 3), given weighted residuals (2, n).

        The matrix is that of `normal`, whatever weights it was built with.  The third value is the
        length of the step in sigmas: of all unknowns, or rms over the attitudes if there are none.
        """
        pulled = weight * residual
        right = np.zeros(len(normal.right))
        for part in self.parts:
            own = part.flat
            right[part.stars.columns] = -own @ pulled[:, part.stars.rows].ravel()
        if self.whiten is None or self.coupling is None:
            step = replace(normal, right=right).solution(free)
            return step, np.zeros((0, 3)), _length(normal, step)
        turning = np.zeros(3 * len(self.whiten))
        for part in self.parts:
            sums = part.by_turns.T @ pulled[:, part.stars.rows].ravel()
            turning[: len(sums)] += sums
        reduced = (self.whiten @ turning.reshape(-1, 3, 1)).ravel()
        right += reduced @ self.coupling
        step = replace(normal, right=right).solution(free)
        reduced += self.coupling @ step
        turns = -(np.swapaxes(self.whiten, 1, 2) @ reduced.reshape(-1, 3, 1))[..., 0]
        of_attitudes = float(np.sqrt(np.mean(reduced**2)))
        return step, turns, _length(normal, step) if len(free) else of_attitudes

    def change(self, step: Vector, turns: Vector, stars: int) -> Vector:
        """Change of the residuals (2, n) by steps of the unknowns and turns of the attitudes."""
        found = np.empty((2, stars))
        for part in self.parts:
            by = part.flat
            moved = step[part.stars.columns] @ by
            if self.whiten is not None:
                moved = moved + part.by_turns @ turns.ravel()[: part.by_turns.shape[1]]
            found[:, part.stars.rows] = moved.reshape(2, -1)
        return found


def _length(normal: Normal, step: Vector) -> float:
    return math.sqrt(max(float(step @ normal.matrix @ step), 0.0))


def eliminate(
    parts: Sequence[Linearised],
    residual: Vector,
    weight: Weights,
    unknowns: int,
    edges: Indices,
    attitudes_known: bool = False,
) -> Eliminated:
    """Normal equations of each block of batches, attitudes eliminated unless they are known.

    `edges` (f + 1,) are the first batches of the blocks, and the number of batches at the end.
    """
    batches = int(edges[-1])
    matrix = np.zeros((len(edges) - 1, unknowns + 1, unknowns + 1))
    # Residuals form one more column, after the columns of the unknowns.
    coupling = np.zeros((batches, 3, unknowns + 1))
    own_blocks = np.zeros((3, 3, batches))
    for part in parts:
        stars = part.stars
        seen = np.concatenate([part.by_unknown, residual[None, :, stars.rows]])
        own = weight[stars.rows]
        weighted = seen if (own == 1.0).all() else seen * own
        columns = np.append(stars.columns, unknowns)
        rows = np.searchsorted(stars.batch, edges)
        for block, (first, last) in enumerate(pairwise(rows)):
            count = 2 * (last - first)
            right = seen[:, :, first:last].reshape(len(seen), count)
            left = weighted[:, :, first:last].reshape(len(seen), count)
            matrix[block][np.ix_(columns, columns)] += left @ right.T
        if attitudes_known:
            continue
        flat = np.ascontiguousarray(weighted.reshape(len(seen), -1).T)
        sums = (part.by_turns.T @ flat).reshape(-1, 3, len(seen))
        coupling[: len(sums), :, columns] += sums
        _add_blocks(own_blocks, part, own)
    full = matrix[:, :-1, :-1].diagonal(axis1=1, axis2=2).copy()
    if attitudes_known:
        return Eliminated(parts, _normals(matrix, full), None, None)
    chol = np.linalg.cholesky(own_blocks.transpose(2, 0, 1) + ATTITUDE_PRIOR * np.eye(3))
    whiten = np.linalg.inv(chol)
    solved = whiten @ coupling
    for block, (first, last) in enumerate(pairwise(edges)):
        flat = solved[first:last].reshape(-1, unknowns + 1)
        matrix[block] -= flat.T @ flat
    tied = np.ascontiguousarray(solved[:, :, :-1]).reshape(3 * batches, unknowns)
    return Eliminated(parts, _normals(matrix, full), whiten, tied)


def _normals(matrix: Matrix, full: Matrix) -> tuple[Normal, ...]:
    """Normal equations from blocks (f, p + 1, p + 1), with residuals as last row and column."""
    return tuple(
        Normal(block[:-1, :-1], -block[:-1, -1], float(block[-1, -1]), own)
        for block, own in zip(matrix, full, strict=True)
    )


def _add_blocks(into: Matrix, part: Linearised, weight: Weights) -> None:
    """Add the information of a tracker's stars on each attitude to its block (3, 3, K)."""
    by, batch = part.by_attitude, part.stars.batch
    for i in range(3):
        for j in range(i, 3):
            products = (by[:, 0, i] * by[:, 0, j] + by[:, 1, i] * by[:, 1, j]) * weight
            sums = np.bincount(batch, products, minlength=into.shape[2])
            into[i, j] += sums
            if i != j:
                into[j, i] += sums


Marks = npt.NDArray[np.bool_]

LEAST_SHARE = 1e-9
"""Least share of an unknown's information that must remain after attitudes and other unknowns."""

ORDER: tuple[Kind, ...] = ("alignment", "scale", "distortion", "temperature", "time_tag")
"""Priority of kinds of unknowns: of two that stars cannot separate, the later is dropped."""

REASONS: dict[Kind, str] = {
    "alignment": "too few batches in which this tracker and another both have identified stars",
    "scale": "too few stars far enough from each other",
    "distortion": "too few stars for this degree, or only in a part of the field of view",
    "temperature": "the temperature is not known, or changes too little",
    "time_tag": "the body rates change too little: it looks like a misalignment; batches with "
    "different rates would tell them apart",
}
ABSOLUTE = (
    "the stars give the attitude through the trackers, so only angles between trackers show; "
    "{first} is taken to be where the mission has it"
)
ONE_CLOCK = "it looks like a turn of the body; {first} is taken to have the right time"


@dataclass(frozen=True)
class NotObservable:
    """An unknown that the stars do not determine, and the reason."""

    name: str
    reason: str


def observable(normal: Normal, unknowns: Sequence[Unknown]) -> Marks:
    """Mask of the unknowns (p,) that the normal equations determine.

    An unknown is dropped if the attitudes and the unknowns before it in `ORDER` leave none of its
    information, and then if its sigma is implausibly large.
    """
    order = sorted(
        range(len(unknowns)),
        key=lambda at: (ORDER.index(unknowns[at].kind), unknowns[at].degree, at),
    )
    kept: list[int] = []
    for at in order:
        if _share_left(normal, kept, at) > LEAST_SHARE:
            kept.append(at)
    per_unit = np.array([each.per_unit for each in unknowns])
    while kept:
        sigma = np.sqrt(np.diag(inverse(normal.matrix[np.ix_(kept, kept)]))) / per_unit[kept]
        beyond = [
            place
            for place, at in enumerate(kept)
            if not sigma[place] <= largest_sigma(unknowns[at])
        ]
        if not beyond:
            break
        del kept[beyond[-1]]
    marks = np.zeros(len(unknowns), dtype=np.bool_)
    marks[kept] = True
    return marks


def _share_left(normal: Normal, kept: Sequence[int], at: int) -> float:
    full = normal.full[at]
    if not full > 0.0:
        return 0.0
    left = normal.matrix[at, at]
    if kept:
        across = normal.matrix[kept, at]
        scale = 1.0 / np.sqrt(np.diag(normal.matrix)[kept])
        inner = normal.matrix[np.ix_(kept, kept)] * np.outer(scale, scale)
        left -= (across * scale) @ np.linalg.solve(inner, across * scale)
    return float(left / full)


def inverse(matrix: Matrix) -> Matrix:
    """Inverse of a positive definite matrix whose rows have different units."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale))


def not_observable(
    trackers: Sequence[Tracker],
    unknowns: Sequence[Unknown],
    marks: Marks,
    attitudes_known: bool,
    time_tag: bool,
) -> tuple[NotObservable, ...]:
    """Dropped unknowns, and properties that star observations never determine, with reasons."""
    found = [
        NotObservable(each.name, REASONS[each.kind])
        for each, kept in zip(unknowns, marks, strict=True)
        if not kept
    ]
    if attitudes_known:
        return tuple(found)
    first = trackers[0].name
    always = [NotObservable("absolute alignment", ABSOLUTE.format(first=first))]
    if time_tag:
        always.append(NotObservable(f"{first} time tag", ONE_CLOCK.format(first=first)))
    return (*always, *found)
