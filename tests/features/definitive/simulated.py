"""Passes of a spacecraft with known attitude, as a gyro and star trackers measure them.

Everything is done with scipy's rotations, which the filter does not use.  Times are
seconds from the beginning; the rates are of the body axes.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from service.features.definitive.kernels.inputs import AttitudeMeasurements, DirectionMeasurements
from service.features.definitive.kernels.result import AttitudeHistory
from service.gyro.samples import GyroModel, GyroSamples
from service.vectors import read_only

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

ARCSEC = math.pi / 180.0 / 3600.0
START_NS = 800_000_000 * 10**9
SUBSTEPS = 20
"""The truth is integrated in so many steps between two gyro samples."""


@dataclass(frozen=True)
class Truth:
    """The attitude (n,) and the mean rate (n, 3) since the time before, at times (n,)."""

    time_s: Array
    attitude: Any
    rate_rad_s: Array

    @property
    def tai_ns(self) -> Rows:
        return np.asarray(START_NS + np.rint(self.time_s * 1e9).astype(np.int64))


def inertial_hold(time_s: Array) -> Array:
    """No rate at all (n, 3)."""
    return np.zeros((len(time_s), 3))


def orbital_rate(time_s: Array) -> Array:
    """The rate (n, 3) of a body that keeps one side to the Earth, in a low orbit."""
    return np.tile([0.0, -2.0 * math.pi / 5400.0, 0.0], (len(time_s), 1))


def slews(time_s: Array) -> Array:
    """Holds of 20 minutes and turns of 65 deg between them, at 0.12 deg/s about three axes."""
    phase, turn = np.mod(time_s, 1800.0) - 1200.0, (time_s // 1800.0).astype(int)
    ramp = np.clip(np.minimum(phase, 600.0 - phase) / 60.0, 0.0, 1.0)
    axes = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.36, 0.48]])
    return np.asarray(math.radians(0.12) * ramp[:, None] * axes[turn % 3])


@lru_cache(maxsize=16)
def truth_of(
    rate: Callable[[Array], Array], duration_s: float, step_s: float = 1.0, start: Any = None
) -> Truth:
    """The motion whose rate (n, 3) is `rate` of times (n,), integrated in small steps.

    Tests of one motion share it.
    """
    time_s: Array = np.arange(round(duration_s / step_s) + 1, dtype=np.float64) * step_s
    small_s = step_s / SUBSTEPS
    middles: Array = np.arange((len(time_s) - 1) * SUBSTEPS, dtype=np.float64) + 0.5
    fine = rate(middles * small_s)
    parts = fine.reshape(-1, SUBSTEPS, 3)
    steps = Rotation.from_rotvec(parts[:, 0] * small_s)
    for part in range(1, SUBSTEPS):
        # A(w dt) A is the transpose of A^T exp([w x] dt).
        steps = steps * Rotation.from_rotvec(parts[:, part] * small_s)
    turned = steps.as_quat()
    reach = 1
    while reach < len(turned):
        # Afterwards each is the product of twice as many steps up to its own.
        product = Rotation.from_quat(turned[:-reach]) * Rotation.from_quat(turned[reach:])
        turned[reach:] = product.as_quat()
        reach *= 2
    attitude = Rotation.from_quat(np.vstack([[0.0, 0.0, 0.0, 1.0], turned]))
    rates = np.vstack([np.zeros(3), parts.mean(axis=1)])
    return Truth(read_only(time_s), (start or Rotation.identity()) * attitude, read_only(rates))


def gyro_of(
    truth: Truth,
    model: GyroModel,
    rng: np.random.Generator,
    bias_rad_s: Array | None = None,
    errors: Array | None = None,
    quantum_rad: float = 0.0,
) -> tuple[GyroSamples, Array]:
    """Gyro samples of a motion, and the bias (n, 3) at each: Farrenkopf's model, exactly.

    `errors` (3, 3) are those of scale and alignment; `quantum_rad` is one count.
    """
    n = len(truth.time_s)
    step_s = np.diff(truth.time_s, prepend=-truth.time_s[1])[:, None]
    if bias_rad_s is None:
        bias_rad_s = rng.normal(0.0, model.bias_sigma_rad_s, 3)
    walk = rng.normal(size=(n, 3)) * model.sigma_u_rad_s1_5 * np.sqrt(step_s)
    walk[0] = 0.0
    bias = bias_rad_s + np.cumsum(walk, axis=0)
    mean_bias = 0.5 * (bias + np.vstack([bias[:1], bias[:-1]]))
    sigma = np.sqrt(model.sigma_v_rad_s0_5**2 / step_s + model.sigma_u_rad_s1_5**2 * step_s / 12.0)
    rate = truth.rate_rad_s + mean_bias + sigma * rng.normal(size=(n, 3))
    if errors is not None:
        rate = rate + truth.rate_rad_s @ np.asarray(errors).T
    if quantum_rad:
        angle = np.cumsum(rate * step_s, axis=0)
        rate = np.diff(np.floor(angle / quantum_rad) * quantum_rad, axis=0, prepend=0.0) / step_s
    return GyroSamples(truth.tai_ns, rate), bias


def random_errors(model: GyroModel, rng: np.random.Generator) -> Array:
    """Errors (3, 3) of scale and alignment as large as the model says."""
    off = rng.normal(0.0, model.misalignment_rad, (3, 3))
    return np.where(np.eye(3) > 0, rng.normal(0.0, model.scale, (3, 3)), off)


def attitudes_of(
    truth: Truth,
    rows: Rows,
    sigma_arcsec: tuple[float, float, float],
    rng: np.random.Generator,
    offset: Array | None = None,
) -> AttitudeMeasurements:
    """Measured attitudes at some rows of the truth; `offset` (n, 3) in radians turns them away."""
    sigma = np.asarray(sigma_arcsec) * ARCSEC
    noise = rng.normal(size=(len(rows), 3)) * sigma
    measured = truth.attitude[rows]
    if offset is not None:
        measured = measured * Rotation.from_rotvec(offset)
    measured = measured * Rotation.from_rotvec(noise)
    return AttitudeMeasurements(
        truth.tai_ns[rows],
        measured.as_quat(),
        np.tile(np.diag(sigma**2), (len(rows), 1, 1)),
    )


def directions_of(
    truth: Truth, rows: Rows, body: list[float], sigma_arcsec: float, rng: np.random.Generator
) -> DirectionMeasurements:
    """One star a row, seen about the direction `body`, with noise in both axes across."""
    seen = np.asarray(body) + rng.normal(0.0, 0.03, (len(rows), 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    # The noise turns the vector; its part along the vector has no effect.
    turned = Rotation.from_rotvec(rng.normal(0.0, sigma_arcsec * ARCSEC, (len(rows), 3)))
    return DirectionMeasurements(
        truth.tai_ns[rows],
        turned.apply(seen),
        truth.attitude[rows].apply(seen),
        np.full(len(rows), sigma_arcsec * ARCSEC),
    )


def attitude_errors(
    history: AttitudeHistory, truth: Truth, rows: Rows | slice = slice(None)
) -> Array:
    """theta (n, 3) in radians, A_true = A(theta) A, of epochs that are the times of the truth."""
    estimated = Rotation.from_quat(history.quaternion)
    return np.asarray((estimated.inv() * truth.attitude[rows]).as_rotvec())


def nees(history: AttitudeHistory, truth: Truth, bias: Array) -> Array:
    """e^T P^-1 e (n,) of attitude and bias: chi-square with six degrees of freedom."""
    errors = np.hstack([attitude_errors(history, truth), bias - history.bias_rad_s])
    return squares(errors, history.covariance)


def squares(errors: Array, covariance: Array) -> Array:
    """e^T P^-1 e (n,) of errors (n, k)."""
    solved = np.linalg.solve(covariance, errors[..., None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", errors, solved))
