"""Joint calibration of trackers from the identified stars of many batches.

A robust least squares of Gauss and Newton over all unknowns and the attitude of every
batch, which is eliminated (attitude-free estimation: Bierman & Shuster; Shuster, Pitone
& Bierman 1991).  Stars count by Huber's weights; those far off are left out.
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
"""Residuals beyond what determines the unknowns: these give their scale to about a sixth."""
FAR_RAD = 2e-3
"""The step above which the derivatives are computed anew."""
LEAVE_OUT_FROM = 2
"""The round from which on stars far off are left out: before, the fit itself may be off."""
RECOUNTED = 0.005
"""Sigmas are computed anew where more stars than this share were left out: half the change."""
SETTLED = 0.1
"""A step so many sigmas long, all unknowns together, is the last: what follows is a tenth of it."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """The estimate of the trackers from the stars of a stretch.

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
        """One standard deviation (p,) of each unknown, in its unit."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def used(self) -> Marks:
        """The stars (n,) that were not left out."""
        return self.weight > 0.0

    @property
    def residual_over_sigma(self) -> float:
        """Root mean square of the used residuals per degree of freedom, in the stars' sigmas."""
        return math.sqrt(float(np.sum(self.residual[self.used] ** 2)) / max(self.freedom, 1))

    def value_of(self, name: str) -> tuple[float, float]:
        """Value and sigma of an unknown, in its unit; raises `BadInput` without such a one."""
        for at, each in enumerate(self.unknowns):
            if each.name == name:
                return float(self.value[at]), float(self.sigma[at])
        raise BadInput(Fault("name", "is not among the unknowns that were estimated", name))


@dataclass(eq=False)
class Fit:
    """A fit, on its way and where it has settled.

    `values` (p,) are all unknowns, in radians and seconds, `marks` (p,) those that are
    free; the others are zero.  `residual` is (2, n) in sigmas, `scale` the sigma that
    residuals have in these.  `reduced` has unit weights for the stars `counted` and
    none for others.
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
        """The unknowns that are estimated."""
        return np.flatnonzero(self.marks)

    @property
    def used(self) -> Marks:
        """The stars (n,) that are not left out."""
        return self.weight > 0.0


def calibrate(stars: IdentifiedStars, model: Model) -> Calibration:
    """The unknowns of a model, by the stars of a stretch.

    Unknowns that the stars do not show are left as the mission has them and named in
    `not_observable`.  Raises `BadInput` where there are fewer residuals than unknowns.
    """
    stars = stars.usable(model.attitudes_known)
    start = begun(stars, model)
    before = replace(start, marks=np.zeros_like(start.marks))
    _settle(before, stars, model, False)
    return calibration_of(stars, model, _run(start, stars, model), before)


def fit(stars: IdentifiedStars, model: Model) -> Fit:
    """The fit of a model to stars that are in the order of `by_tracker`."""
    return _run(begun(stars, model), stars, model)


def _run(found: Fit, stars: IdentifiedStars, model: Model) -> Fit:
    """Settle again and again, from where the last time ended, until that moves nothing."""
    for number in range(LINEARISATIONS):
        steps, far = _settle(found, stars, model, number > 0)
        if steps == 1 and not far:
            break
        if far:
            found.counted = found.used
            found.reduced = _reduced(found, model)
            # Stars that were left out may have been all that showed an unknown.
            found.marks = found.marks & observable(found.reduced.normal, found.unknowns)
            found.values = np.where(found.marks, found.values, 0.0)
    return found


def begun(stars: IdentifiedStars, model: Model) -> Fit:
    """A fit at the mission's present settings, all stars with full weight."""
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
    """Move a fit to where linear equations with robust weights settle.

    How many steps that took, and whether they led far.
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
    """The normal equations where the fit stands."""
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
    """Two a star less three an attitude; the unknowns are not taken off.

    A batch of which fewer than two stars are left determines no attitude, and adds none.
    """
    if model.attitudes_known:
        return 2 * int(used.sum())
    count = 2 * np.bincount(stars.batch[used], minlength=stars.batches)
    return int(np.maximum(count - 3, 0).sum())


def calibration_of(stars: IdentifiedStars, model: Model, settled: Fit, before: Fit) -> Calibration:
    """Values and covariance of a fit, in units, with the residuals before it."""
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
"""Bound of a star's residual, both tangents together, in sigmas.

Estimates keep 96 % of the efficiency that least squares has with Gaussian errors.
"""
WRONG = 5.0
"""A residual beyond so many sigmas is no measurement of that star (Gaussian: 4 in a million)."""
MEDIAN_RADIUS = math.sqrt(2.0 * math.log(2.0))
"""Median of the length of two Gaussian residuals, in sigmas."""


def scale_of(residual: Vector, used: int, freedom: int) -> float:
    """Sigma of one residual of (2, n) by their median length.

    `used` residuals have `freedom` degrees of freedom: the fit has made them smaller.
    """
    length = np.hypot(residual[0], residual[1])
    return max(float(np.median(length)) / MEDIAN_RADIUS * math.sqrt(used / max(freedom, 1)), 1e-12)


def weights(residual: Vector, scale: float, leave_out: bool) -> linearise.Weights:
    """Weights (n,) of stars with these residuals (2, n).

    With `leave_out` those beyond `WRONG` have none.
    """
    length = np.hypot(residual[0], residual[1]) / scale
    weight = np.minimum(1.0, HUBER / np.maximum(length, 1e-300))
    return np.where(length > WRONG, 0.0, weight) if leave_out else weight


def covariance_factor(residual: Vector, scale: float, freedom: int) -> float:
    """The factor of the inverse of the unweighted normal matrix (Huber 1981, 7.6).

    The mean square of the bounded residuals over the square of the mean slope of the
    bound; `residual` (2, n) are those of the stars that were not left out.
    """
    length = np.hypot(residual[0], residual[1]) / scale
    bounded = np.minimum(length, HUBER) * scale
    # Beyond the bound only the direction across the residual still moves it.
    slope = np.where(length <= HUBER, 1.0, 0.5 * HUBER / np.maximum(length, 1e-300))
    return float(np.sum(bounded**2)) / max(freedom, 1) / float(slope.mean()) ** 2


# The degree of the distortion, chosen by blocks of time that the fit has not seen.
#
# The stretch is cut into consecutive blocks of batches.  Each block is predicted from the
# others; only its attitudes are its own.  The smallest degree is taken whose residuals are
# no worse than the best by more than chance: one standard error over the blocks.

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
    """True if squares over blocks exceed others by no more than a standard error of the sum."""
    n = len(excess)
    error = float(np.std(excess, ddof=1)) * math.sqrt(n) if n > 1 else 0.0
    return float(excess.sum()) <= error
