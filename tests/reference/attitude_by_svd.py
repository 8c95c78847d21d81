"""Wahba's problem solved by a singular value decomposition, and cases to hold QUEST against it.

The decomposition (Markley 1988) solves Wahba's problem without iteration; it
is right to its own rounding, which grows where the geometry is weak.  The
bound of a case is that growth: BOUND_EPS times the sum of the weights over the
least eigenvalue of the information matrix.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.attitude.kernels import QUEST, START, fit_attitude
from service.attitude.solution import WORST_AXIS_RAD, fit_workspace
from service.vectors import ARCSEC_PER_RADIAN

Array = npt.NDArray[np.float64]

BOUND_EPS = 30.0 * float(np.finfo(float).eps)


@dataclass(frozen=True)
class Cases:
    """Random matched vectors: truth (k, 3, 3), b and r (k, n, 3), sigma (k, n) in radians."""

    truth: Array
    b: Array
    r: Array
    sigma: Array


def random_cases(rng: np.random.Generator, count: int, stars: int, kind: str) -> Cases:
    """Cases of one kind: `half_turn` (exactly 180 deg about any axis), `narrow`, `unequal`, `wide`.

    Fields run from a twentieth of a degree to the whole sky, sigma from 0.5 to
    60 arcsec, in `unequal` by up to four decades within a case.
    """
    q = rng.normal(size=(count, 4))
    if kind == "half_turn":
        q[:, 3] = 0.0
        # A third of them about a coordinate axis itself.
        q[: count // 3, :3] = np.eye(3)[rng.integers(3, size=count // 3)]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    truth = matrices(q)
    low, high = {"narrow": (0.05, 2.0), "wide": (20.0, 180.0)}.get(kind, (0.5, 20.0))
    radius = np.radians(10.0 ** rng.uniform(math.log10(low), math.log10(high), size=(count, 1, 1)))
    boresight = unit(rng.normal(size=(count, 1, 3)))
    aside = rng.normal(size=(count, stars, 3))
    aside = unit(aside - np.sum(aside * boresight, axis=2, keepdims=True) * boresight)
    angle = radius * np.sqrt(rng.uniform(size=(count, stars, 1)))
    exact = np.cos(angle) * boresight + np.sin(angle) * aside
    sigma = 10.0 ** rng.uniform(math.log10(0.5), math.log10(60.0), size=(count, 1))
    spread = 2.0 if kind == "unequal" else 0.3
    sigma = sigma * 10.0 ** rng.uniform(-spread, spread, size=(count, stars)) / ARCSEC_PER_RADIAN
    b = unit(exact + sigma[:, :, None] * rng.normal(size=exact.shape))
    r = np.einsum("kij,kni->knj", truth, exact)
    return Cases(truth, b, r, sigma)


def unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def matrices(q: Array) -> Array:
    """A(q) (k, 3, 3) of quaternions (k, 4)."""
    v, s = q[:, :3], q[:, 3]
    zero = np.zeros(len(q))
    skew = np.stack(
        [
            np.stack([zero, -v[:, 2], v[:, 1]], axis=1),
            np.stack([v[:, 2], zero, -v[:, 0]], axis=1),
            np.stack([-v[:, 1], v[:, 0], zero], axis=1),
        ],
        axis=1,
    )
    along = (s * s - np.sum(v * v, axis=1))[:, None, None] * np.eye(3)
    return np.asarray(along + 2 * v[:, :, None] * v[:, None, :] - 2 * s[:, None, None] * skew)


def by_svd(cases: Cases) -> Array:
    """Attitude matrices (k, 3, 3) that minimise Wahba's loss."""
    weights = cases.sigma**-2.0
    weights = weights / weights.sum(axis=1, keepdims=True)
    profile = np.einsum("kn,kni,knj->kij", weights, cases.b, cases.r)
    u, _, vt = np.linalg.svd(profile)
    d = np.broadcast_to(np.eye(3), profile.shape).copy()
    d[:, 2, 2] = np.linalg.det(u) * np.linalg.det(vt)
    return np.asarray(u @ d @ vt)


def information(cases: Cases) -> Array:
    """Sum of sigma^-2 (I - b b^T), (k, 3, 3)."""
    weights = cases.sigma**-2.0
    total = weights.sum(axis=1)[:, None, None] * np.eye(3)
    return np.asarray(total - np.einsum("kn,kni,knj->kij", weights, cases.b, cases.b))


def apart_rad(a: Array, b: Array) -> Array:
    """The angle of the rotation between attitude matrices (k, 3, 3)."""
    return np.asarray(2.0 * np.arcsin(np.minimum(1.0, np.linalg.norm(a - b, axis=(1, 2)) / 8**0.5)))


@dataclass(frozen=True)
class Agreement:
    """Case by case, of those that have an attitude: how far QUEST is from the decomposition."""

    cases: int
    refused: int
    wrongly_refused: int
    apart_rad: Array
    bound_rad: Array
    sigma_rad: Array
    """Predicted one sigma of the worst axis."""
    triad_apart_rad: Array


def agreement(cases: Cases) -> Agreement:
    """Solve every case both ways."""
    count, stars = cases.sigma.shape
    quaternions, triads = np.empty((count, 4)), np.empty((count, 4))
    solved = np.zeros(count, bool)
    workspace = fit_workspace(stars)
    for k in range(count):
        vectors = (np.array(each[k], order="C") for each in (cases.b, cases.r, cases.sigma))
        solved[k] = fit_attitude(*vectors, WORST_AXIS_RAD, QUEST, workspace)
        triads[k], quaternions[k] = workspace.quaternions[:START]
    least = np.linalg.eigvalsh(information(cases))[:, 0]
    worst = 1.0 / np.sqrt(np.maximum(least, 1e-300))
    # Within a thousandth of the bound either verdict is rounding.
    wrongly = np.count_nonzero(~solved & (worst < 0.999 * WORST_AXIS_RAD))
    weights = (cases.sigma**-2.0).sum(axis=1)
    reference = by_svd(cases)[solved]
    return Agreement(
        cases=count,
        refused=int(np.count_nonzero(~solved)),
        wrongly_refused=int(wrongly),
        apart_rad=apart_rad(matrices(quaternions[solved]), reference),
        bound_rad=np.asarray(BOUND_EPS * weights[solved] / least[solved]),
        sigma_rad=worst[solved],
        triad_apart_rad=apart_rad(matrices(triads[solved]), reference),
    )
