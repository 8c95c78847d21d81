"""Joint calibration of trackers from the identified stars of many batches.

A robust Gauss-Newton least squares over all unknowns and the attitude of every batch, which is
eliminated (attitude-free estimation: Bierman & Shuster; Shuster, Pitone & Bierman 1991).  Stars
have Huber's weights; outliers are left out.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from service.errors import BadInput, Fault
from service.features.calibration import linearise
from service.features.calibration.elimination import (
    Eliminated,
    Marks,
    Normal,
    NotObservable,
    eliminate,
    inverse,
    not_observable,
    observable,
)
from service.features.calibration.linearise import Model, Unknown, unknowns_of
from service.features.calibration.stars import IdentifiedStars, Indices
from service.vectors import Matrix, Vector

ROUNDS, LINEARISATIONS = 30, 6
LEAST_FREEDOM = 20
"""Least excess of residuals over unknowns: their scale is then known to about a sixth."""
FAR_RAD = 2e-3
"""Length of a step, in radians, above which the derivatives are computed again."""
LEAVE_OUT_FROM = 2
"""Iteration from which outliers are left out; earlier the fit itself may still be off."""
RECOUNTED = 0.005
"""Share of newly left out stars above which sigmas are computed again."""
SETTLED = 0.1
"""Length of a step, in sigmas of all unknowns, below which the iteration ends."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration of trackers estimated from identified stars of a period.

    `value` (p,) and `covariance` (p, p) are of `unknowns`, in the unit of each.  `stars`
    (n) are those that were used, ordered by tracker and batch; `residual` (n, 2) is
    observed minus predicted in the stars' sigmas, along h and v, `before` the same with
    the mission's present settings and attitudes fitted to these.  `weight` (n,) is 0 for
    stars left out as wrong.  `attitude` (K, 3, 3) are the batches' with the calibration.
    """

    model: Model
    stars: IdentifiedStars
    unknowns: tuple[Unknown, ...]
    value: Vector
    covariance: Matrix
    attitude: Matrix
    before: Vector
    residual: Vector
    weight: linearise.Weights
    freedom: int
    not_observable: tuple[NotObservable, ...]

    @property
    def sigma(self) -> Vector:
        """Standard deviation (p,) of each estimated unknown, in its unit."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def used(self) -> Marks:
        """Mask (n,) of the stars that were not left out as outliers."""
        return self.weight > 0.0

    @property
    def residual_over_sigma(self) -> float:
        """Root mean square of the used residuals per degree of freedom, in the stars' sigmas."""
        return math.sqrt(float(np.sum(self.residual[self.used] ** 2)) / max(self.freedom, 1))

    def value_of(self, name: str) -> tuple[float, float]:
        """Value and sigma of a named unknown, in its unit; raises `BadInput` if not estimated."""
        for at, each in enumerate(self.unknowns):
            if each.name == name:
                return float(self.value[at]), float(self.sigma[at])
        raise BadInput(Fault("name", "is not among the unknowns that were estimated", name))


@dataclass(eq=False)
class Fit:
    """State of the iterated least squares fit of a calibration.

    `values` (p,) are all unknowns, in radians and seconds, `marks` (p,) the mask of the free ones;
    the others are zero.  `residual` is (2, n) in sigmas, `scale` the measured sigma of these
    residuals.  `reduced` are normal equations in which the stars `counted` have weight one and the
    others zero.
    """

    parts: Sequence[linearise.TrackerStars]
    unknowns: Sequence[Unknown]
    marks: Marks
    values: Vector
    attitude: Matrix
    residual: Vector
    weight: linearise.Weights
    counted: Marks
    reduced: Eliminated
    scale: float = 1.0

    @property
    def free(self) -> Indices:
        """Indices of the unknowns that are estimated."""
        return np.flatnonzero(self.marks)

    @property
    def used(self) -> Marks:
        """Mask (n,) of the stars that are not left out as outliers."""
        return self.weight > 0.0


def calibrate(stars: IdentifiedStars, model: Model) -> Calibration:
    """Estimate the unknowns of a camera and alignment model from the stars of a period.

    Unknowns that the stars do not determine keep the mission's values and are named in
    `not_observable`.  Raises `BadInput` if there are fewer residuals than unknowns.
    """
    stars = stars.usable(model.attitudes_known)
    start = begun(stars, model)
    before = replace(start, marks=np.zeros_like(start.marks))
    _settle(before, stars, model, False)
    return calibration_of(stars, model, _run(start, stars, model), before)


def fit(stars: IdentifiedStars, model: Model) -> Fit:
    """Fit a calibration model to stars that are sorted as by `usable`."""
    return _run(begun(stars, model), stars, model)


def _run(found: Fit, stars: IdentifiedStars, model: Model) -> Fit:
    """Repeat the linearised fit from its last result until nothing changes, up to a limit."""
    for number in range(LINEARISATIONS):
        steps, far = _settle(found, stars, model, number > 0)
        if steps == 1 and not far:
            break
        if far:
            found.counted = found.used
            found.reduced = _reduced(found, model)
            # An unknown may have been observable by stars only that are left out now.
            found.marks = found.marks & observable(found.reduced.normal, found.unknowns)
            found.values = np.where(found.marks, found.values, 0.0)
    return found


def begun(stars: IdentifiedStars, model: Model) -> Fit:
    """Starting point of a fit: the mission's present settings, all stars with full weight."""
    unknowns = unknowns_of(stars.trackers, model)
    parts = linearise.prepared(stars, unknowns, model.reference_temperature_c)
    values, every = np.zeros(len(unknowns)), np.ones(len(stars), dtype=np.bool_)
    residual = _residuals(parts, values, stars.attitude, len(stars))
    reduced = _eliminated(parts, values, stars.attitude, residual, every, model)
    marks = observable(reduced.normal, unknowns)
    if degrees_of_freedom(stars, model, every) < int(marks.sum()) + LEAST_FREEDOM:
        message = f"are too few for {int(marks.sum())} unknowns and the attitude of every batch"
        raise BadInput(Fault("stars", message, f"{len(stars)} in {stars.batches} batches"))
    weight = every.astype(np.float64)
    return Fit(parts, unknowns, marks, values, stars.attitude, residual, weight, every, reduced)


def _settle(found: Fit, stars: IdentifiedStars, model: Model, near: bool) -> tuple[int, bool]:
    """Iterate robust weights on fixed linear equations until the steps are small.

    Returns the number of steps, and True if the result is far from the point of linearisation.
    """
    free, normal = found.free, found.reduced.normal
    moved, turned = np.zeros(len(found.values)), np.zeros((stars.batches, 3))
    residual, steps = found.residual, 0
    for steps in range(1, ROUNDS + 1):
        step, turns, length = found.reduced.steps(normal, residual, found.weight, free)
        residual = residual + found.reduced.change(step, turns, len(stars))
        moved += step
        if not model.attitudes_known:
            turned += turns
        used = found.used
        freedom = degrees_of_freedom(stars, model, used) - len(free)
        found.scale = scale_of(residual[:, used], 2 * int(used.sum()), freedom)
        leave_out = near or steps > LEAVE_OUT_FROM
        found.weight = weights(residual, found.scale, leave_out)
        if leave_out and length < SETTLED * found.scale:
            break
    found.values = found.values + moved
    found.attitude = linearise.turned_attitudes(found.attitude, turned)
    found.residual = _residuals(found.parts, found.values, found.attitude, len(stars))
    angles = [abs(v) for v, each in zip(moved, found.unknowns, strict=True) if each.unit != "s"]
    return steps, max([float(np.abs(turned).max()), *angles]) > FAR_RAD


def _reduced(found: Fit, model: Model) -> Eliminated:
    """Normal equations linearised at the present values of a fit."""
    arguments = found.values, found.attitude, found.residual, found.counted
    return _eliminated(found.parts, *arguments, model)


def _eliminated(
    parts: Sequence[linearise.TrackerStars],
    values: Vector,
    attitude: Matrix,
    residual: Vector,
    counted: Marks,
    model: Model,
) -> Eliminated:
    derivatives = [linearise.linearised(part, values, attitude) for part in parts]
    edges = np.array([0, len(attitude)])
    arguments = residual, counted.astype(np.float64), len(values), edges
    return eliminate(derivatives, *arguments, model.attitudes_known)


def _residuals(
    parts: Sequence[linearise.TrackerStars], values: Vector, attitude: Matrix, stars: int
) -> Vector:
    found = np.empty((2, stars))
    for part in parts:
        found[:, part.rows] = linearise.residuals(part, values, attitude)
    return found


def degrees_of_freedom(stars: IdentifiedStars, model: Model, used: Marks) -> int:
    """Number of residuals less three per attitude; the unknowns are not subtracted.

    A batch with fewer than two remaining stars determines no attitude, and adds nothing.
    """
    if model.attitudes_known:
        return 2 * int(used.sum())
    count = 2 * np.bincount(stars.batch[used], minlength=stars.batches)
    return int(np.maximum(count - 3, 0).sum())


def calibration_of(stars: IdentifiedStars, model: Model, settled: Fit, before: Fit) -> Calibration:
    """Calibration from a settled fit: values, covariance in their units, residuals before."""
    free, used = settled.free, settled.used
    if float(np.mean(used != settled.counted)) > RECOUNTED:
        settled.counted = used
        settled.reduced = _reduced(settled, model)
    freedom = degrees_of_freedom(stars, model, used) - len(free)
    kept = tuple(settled.unknowns[at] for at in free)
    per_unit = np.array([each.per_unit for each in kept])
    covariance = np.zeros((0, 0))
    if kept:
        factor = covariance_factor(settled.residual[:, used], settled.scale, freedom)
        covariance = inverse(settled.reduced.normal.matrix[np.ix_(free, free)]) * factor
        covariance /= np.outer(per_unit, per_unit)
    return Calibration(
        model,
        stars,
        kept,
        settled.values[free] / per_unit,
        covariance,
        settled.attitude,
        before.residual.T,
        settled.residual.T,
        settled.weight,
        freedom,
        not_observable(
            stars.trackers, settled.unknowns, settled.marks, model.attitudes_known, model.time_tag
        ),
    )


HUBER = 2.0
"""Bound of Huber's weight on a star's residual, both tangents together, in sigmas.

Estimates keep 96 % of the efficiency of least squares with Gaussian errors.
"""
WRONG = 5.0
"""Length of a residual, in sigmas, above which a star is an outlier (Gaussian: 4 in a million)."""
MEDIAN_RADIUS = math.sqrt(2.0 * math.log(2.0))
"""Median length of a vector of two Gaussian residuals, in sigmas."""


def scale_of(residual: Vector, used: int, freedom: int) -> float:
    """Robust sigma of residuals (2, n) from their median length.

    `used` residuals have `freedom` degrees of freedom, since the fit has made them smaller.
    """
    length = np.hypot(residual[0], residual[1])
    return max(float(np.median(length)) / MEDIAN_RADIUS * math.sqrt(used / max(freedom, 1)), 1e-12)


def weights(residual: Vector, scale: float, leave_out: bool) -> linearise.Weights:
    """Huber weights (n,) of stars with residuals (2, n).

    With `leave_out` residuals beyond `WRONG` have weight zero.
    """
    length = np.hypot(residual[0], residual[1]) / scale
    weight = np.minimum(1.0, HUBER / np.maximum(length, 1e-300))
    return np.where(length > WRONG, 0.0, weight) if leave_out else weight


def covariance_factor(residual: Vector, scale: float, freedom: int) -> float:
    """Factor from the inverse of the unweighted normal matrix to the covariance (Huber 1981, 7.6).

    The mean square of the bounded residuals over the square of the mean slope of the bound;
    `residual` (2, n) holds only stars that were not left out.
    """
    length = np.hypot(residual[0], residual[1]) / scale
    bounded = np.minimum(length, HUBER) * scale
    # Beyond the bound only a change across the residual still changes the bounded value.
    slope = np.where(length <= HUBER, 1.0, 0.5 * HUBER / np.maximum(length, 1e-300))
    return float(np.sum(bounded**2)) / max(freedom, 1) / float(slope.mean()) ** 2


# The degree of the distortion, chosen by blocks of time that the fit has not seen.
#
# The batches are cut into consecutive blocks.  Each block is predicted from the others, with
# only its attitudes fitted.  The smallest degree is taken whose residuals are worse than the
# best by no more than one standard error over the blocks.

BLOCKS = 10


@dataclass(frozen=True)
class HeldOut:
    """Prediction error of a distortion of some degree on blocks of time outside of its fit.

    `residual_over_sigma` is a root mean square per degree of freedom, in the stars'
    sigmas; `chosen` marks the degree to use.
    """

    degree: int
    residual_over_sigma: float
    chosen: bool


def calibrate_with_chosen_degree(
    stars: IdentifiedStars, model: Model
) -> tuple[Calibration, tuple[HeldOut, ...]]:
    """Calibrate with the best distortion degree up to the model's; also return the error of each
    degree.

    Raises `BadInput` if there are too few stars for the model's own degree.
    """
    usable = stars.usable(model.attitudes_known)
    tried = held_out(usable, model, fit(usable, model))
    (chosen,) = (each.degree for each in tried if each.chosen)
    return calibrate(usable, replace(model, degree=chosen)), tried


def held_out(stars: IdentifiedStars, model: Model, settled: Fit) -> tuple[HeldOut, ...]:
    """Cross-validate every distortion degree up to the model's by held-out blocks of batches.

    The settled fit is linear near its solution: leaving out a block subtracts its normal equations.
    Stars left out by the fit stay left out.
    """
    edges = _edges(stars.batches)
    derivatives = [
        linearise.linearised(part, settled.values, settled.attitude) for part in settled.parts
    ]
    used = settled.used.astype(np.float64)
    count = len(settled.unknowns)
    arguments = settled.residual, used, count, edges, model.attitudes_known
    by_block = [
        _from_zero(each, settled.values) for each in eliminate(derivatives, *arguments).blocks
    ]
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


def _edges(batches: int) -> Indices:
    count = min(BLOCKS, batches)
    return np.unique(np.linspace(0, batches, count + 1).astype(np.int64))


def _from_zero(normal: Normal, values: Vector) -> Normal:
    """Convert equations for steps from `values` to equations for the unknowns themselves."""
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
    """Sum of squared residuals of each block (f,), predicted by unknowns from the other blocks."""
    total = sum(by_block[1:], start=by_block[0])
    if len(by_block) == 1:
        return np.array([total.squares])
    return np.array([each.squares_after((total - each).solution(free)) for each in by_block])


def _no_worse(excess: Vector) -> bool:
    """True if the sum of excess squares (f,) over blocks is at most one standard error."""
    n = len(excess)
    error = float(np.std(excess, ddof=1)) * math.sqrt(n) if n > 1 else 0.0
    return float(excess.sum()) <= error
