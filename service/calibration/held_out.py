"""The degree of the distortion, chosen by blocks of time that the fit has not seen.

The stretch is cut into consecutive blocks of batches.  Each block is predicted from the
others; only its attitudes are its own.  The smallest degree is taken whose residuals are
no worse than the best by more than chance: one standard error over the blocks.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from service.calibration.elimination import Normal, eliminate
from service.calibration.estimate import (
    Calibration,
    Fit,
    calibrate,
    degrees_of_freedom,
    fit,
)
from service.calibration.linearise import linearised
from service.calibration.stars import IdentifiedStars, Indices
from service.calibration.unknowns import Model
from service.vectors import Vector

BLOCKS = 10


@dataclass(frozen=True)
class HeldOut:
    """How well a distortion of a degree predicts blocks of time that it was not fitted to.

    `residual_over_sigma` is a root mean square per degree of freedom, in the stars'
    sigmas; `chosen` marks the degree to use.
    """

    degree: int
    residual_over_sigma: float
    chosen: bool


def calibrate_with_chosen_degree(
    stars: IdentifiedStars, model: Model, blocks: int = BLOCKS
) -> tuple[Calibration, tuple[HeldOut, ...]]:
    """`calibrate` with the best degree up to that of the model, and what each degree gave.

    Raises `BadInput` where there are too few stars for the model's own degree.
    """
    usable = stars.usable(model.attitudes_known)
    tried = held_out(usable, model, fit(usable, model), blocks)
    (chosen,) = (each.degree for each in tried if each.chosen)
    return calibrate(usable, replace(model, degree=chosen)), tried


def held_out(
    stars: IdentifiedStars, model: Model, settled: Fit, blocks: int = BLOCKS
) -> tuple[HeldOut, ...]:
    """Every degree up to the model's by held-out blocks, around a settled fit of the model.

    The fit is linear there: leaving out a block subtracts its normal equations.  Stars
    that the fit left out are left out here.
    """
    edges = _edges(stars.batches, blocks)
    derivatives = [linearised(part, settled.values, settled.attitude) for part in settled.parts]
    used = settled.used.astype(np.float64)
    count = len(settled.unknowns)
    given = settled.residual, used, count, edges, model.attitudes_known
    by_block = [_from_zero(each, settled.values) for each in eliminate(derivatives, *given).blocks]
    freedom = degrees_of_freedom(stars, model, settled.used)
    squares = {
        degree: _predicted_squares(by_block, _free(settled, degree))
        for degree in range(model.degree + 1)
    }
    best = min(squares, key=lambda degree: float(squares[degree].sum()))
    chosen = next(degree for degree, each in squares.items() if _no_worse(each - squares[best]))
    return tuple(
        HeldOut(degree, math.sqrt(float(each.sum()) / max(freedom, 1)), degree == chosen)
        for degree, each in squares.items()
    )


def _edges(batches: int, blocks: int) -> Indices:
    count = min(blocks, batches)
    return np.unique(np.linspace(0, batches, count + 1).astype(np.int64))


def _from_zero(normal: Normal, values: Vector) -> Normal:
    """Equations of steps from `values`, as equations of the unknowns themselves."""
    return replace(
        normal,
        right=normal.right + normal.matrix @ values,
        squares=normal.squares_after(-values),
    )


def _free(settled: Fit, degree: int) -> Indices:
    return np.array(
        [at for at in settled.free if settled.unknowns[at].degree <= degree], dtype=np.int64
    )


def _predicted_squares(by_block: list[Normal], free: Indices) -> Vector:
    """The sum of squares of each block with the unknowns that the other blocks give."""
    total = sum(by_block[1:], start=by_block[0])
    if len(by_block) == 1:
        return np.array([total.squares])
    return np.array([each.squares_after((total - each).solution(free)) for each in by_block])


def _no_worse(excess: Vector) -> bool:
    """Whether squares over blocks exceed others by no more than a standard error of the sum."""
    n = len(excess)
    error = float(np.std(excess, ddof=1)) * math.sqrt(n) if n > 1 else 0.0
    return float(excess.sum()) <= error
