"""Compiled propagation of the filter between epochs: transition matrix and process noise.

The error state is (theta, delta b): the attitude error about the body axes in
radians, and the error of the gyro's bias in rad/s.  At a rate w that is constant
within the step,

    d theta / dt = -[w x] theta - delta b - n_v,    d delta b / dt = n_u

(Markley & Crassidis, 2014, chapter 6), which is solved in closed form.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from service.attitude.covariance import congruence
from service.compiled.jit import njit_no_refcount

SERIES_BELOW = 0.1
"""Rotation angle of a step, in radians, below which series replace the closed form."""
CLEAR_CHANGE = 6.0
"""Change of a measured rate, in sigmas of gyro noise, that counts as real."""


class Noise(NamedTuple):
    """Noise variances of a gyro model and thresholds of the filter, as plain numbers.

    `angle` is sigma_v^2 in rad^2/s, `bias` sigma_u^2 in rad^2/s^3, `coast` the same for the rate in
    a gap, `first_bias` in rad^2/s^2.  `gate_2` and `gate_3` are the limits of chi-square with two
    and three degrees of freedom, `start_gate_3` the limit for attitudes until a start is confirmed,
    for which every accepted measurement counts at least `least_redundancy`.  Below `established` an
    attitude is young.
    """

    angle: float
    bias: float
    coast: float
    clock_step_s: float
    first_bias: float
    scale: float
    misalignment: float
    gate_2: float
    gate_3: float
    start_gate_3: float
    start_redundancy: float
    least_redundancy: float
    established: float
    confirmations: int
    reset_after_ns: int
    lost: float


class Timeline(NamedTuple):
    """Epochs of the filter (n): all times of gyro samples and measurements, in order.

    `tai_ns` (n,) as `Utc.tai_ns`.  For the step that ends at an epoch: `step_s` (n,), `rate_rad_s`
    (n, 3) as measured, `interval_s` (n,) the gyro interval that contains the step, and `gap_s` (n,)
    the seconds from the beginning of a gap to the beginning of the step; -1 without a gap.  `first`
    (n + 1,) counts the measurements before an epoch.
    """

    tai_ns: Any
    step_s: Any
    rate_rad_s: Any
    interval_s: Any
    gap_s: Any
    first: Any


class Workspace(NamedTuple):
    """Scratch matrices that every filter step overwrites.

    `phi` (6, 6) is the transition; `psi` (3, 3) the integral of Psi over the step and `psi_square`
    (3, 3) the integral of Psi Psi^T, see `transition`; `product` (6, 6), `gain` (6, 3), `projected`
    (3, 6) and `small` (3, 3) are intermediate, `partials` (3, 3) the derivatives of a measurement
    by theta and `noise` (3, 3) its covariance.  `shift` (3,) is a variance of the bias, `rate` (3,)
    the estimated rate, `theta` (3,) a rotation vector and `dx` (6,) a correction of the state.
    """

    phi: Any
    psi: Any
    psi_square: Any
    product: Any
    gain: Any
    projected: Any
    small: Any
    partials: Any
    noise: Any
    shift: Any
    rate: Any
    theta: Any
    dx: Any


def workspace() -> Workspace:
    """Allocate the scratch matrices of one filter or smoother."""
    return Workspace(
        phi=np.zeros((6, 6)),
        psi=np.zeros((3, 3)),
        psi_square=np.zeros((3, 3)),
        product=np.zeros((6, 6)),
        gain=np.zeros((6, 3)),
        projected=np.zeros((3, 6)),
        small=np.zeros((3, 3)),
        partials=np.zeros((3, 3)),
        noise=np.zeros((3, 3)),
        shift=np.zeros(3),
        rate=np.zeros(3),
        theta=np.zeros(3),
        dx=np.zeros(6),
    )


@njit_no_refcount
def transition(rate, dt, work):  # type: ignore[no-untyped-def]
    """Transition matrix of a step of `dt` seconds, and the two integrals for its process noise.

    With W = [w x] of the rate in rad/s and Psi(t) the integral of exp(-W s) from 0 to t,
    phi = [[exp(-W dt), -Psi(dt)], [0, I]].
    """
    square = rate[0] * rate[0] + rate[1] * rate[1] + rate[2] * rate[2]
    x2 = square * dt * dt
    x = math.sqrt(x2)
    if x < SERIES_BELOW:
        s1 = 1.0 - x2 / 6.0 * (1.0 - x2 / 20.0 * (1.0 - x2 / 42.0))
        s2 = 0.5 * (1.0 - x2 / 12.0 * (1.0 - x2 / 30.0 * (1.0 - x2 / 56.0)))
        s3 = (1.0 - x2 / 20.0 * (1.0 - x2 / 42.0 * (1.0 - x2 / 72.0))) / 6.0
        s4 = (1.0 - x2 / 30.0 * (1.0 - x2 / 56.0 * (1.0 - x2 / 90.0))) / 24.0
        s5 = (1.0 - x2 / 42.0 * (1.0 - x2 / 72.0 * (1.0 - x2 / 110.0))) / 60.0
    else:
        sine, cosine = math.sin(x), math.cos(x)
        s1 = sine / x
        s2 = (1.0 - cosine) / x2
        s3 = (x - sine) / (x2 * x)
        s4 = (0.5 * x2 - 1.0 + cosine) / (x2 * x2)
        s5 = (1.0 / 3.0 - 2.0 * s3) / x2
    dt2 = dt * dt
    dt3 = dt2 * dt
    phi, psi, psi_square = work.phi, work.psi, work.psi_square
    for i in range(3):
        for j in range(3):
            same = 1.0 if i == j else 0.0
            w = 0.0
            if i != j:
                w = -rate[3 - i - j] if (j - i) % 3 == 1 else rate[3 - i - j]
            w2 = rate[i] * rate[j] - same * square
            phi[i, j] = same - s1 * dt * w + s2 * dt2 * w2
            phi[i, j + 3] = -(dt * same - s2 * dt2 * w + s3 * dt3 * w2)
            phi[i + 3, j] = 0.0
            phi[i + 3, j + 3] = same
            psi[i, j] = 0.5 * dt2 * same - s3 * dt3 * w + s4 * dt2 * dt2 * w2
            psi_square[i, j] = dt3 / 3.0 * same + s5 * dt3 * dt2 * w2


@njit_no_refcount
def add_process_noise(q, rate, dt, gap_s, noise, work):  # type: ignore[no-untyped-def]
    """Add the process noise of a step of `dt` seconds to `q` (6, 6); `work` holds the transition.

    Within a gap, which began `gap_s` before the step, the rate is a random walk, and the gyro's
    clock may have stepped along the rotation.
    """
    for i in range(3):
        for j in range(3):
            q[i, j] += noise.bias * work.psi_square[i, j]
            q[i, j + 3] -= noise.bias * work.psi[i, j]
            q[j + 3, i] -= noise.bias * work.psi[i, j]
        q[i, i] += noise.angle * dt
        q[i + 3, i + 3] += noise.bias * dt
    if gap_s >= 0.0:
        stepped = min(dt, noise.clock_step_s)
        for i in range(3):
            q[i, i] += noise.coast * (gap_s * dt * dt + dt * dt * dt / 3.0)
            for j in range(3):
                q[i, j] += stepped * stepped * rate[i] * rate[j]


@njit_no_refcount
def bias_shift(anchor, rate, interval_s, noise, variance):  # type: ignore[no-untyped-def]
    """Variance (3,) that a change of rate adds to the bias, from scale and misalignment errors.

    M w changes with the rate, and M is constant.  The variances of a turn that begins in small
    steps have to add up to the variance of the whole change, so each step adds the change of w^2.
    `anchor` (3,) is the rate at the last clear change, and is updated.
    """
    for i in range(3):
        variance[i] = 0.0
    if (noise.scale == 0.0 and noise.misalignment == 0.0) or interval_s <= 0.0:
        return
    least = 2.0 * CLEAR_CHANGE * CLEAR_CHANGE * noise.angle / interval_s
    for j in range(3):
        change = (rate[j] - anchor[j]) ** 2
        if change > least:
            change = max(change, abs(rate[j] * rate[j] - anchor[j] * anchor[j]))
            anchor[j] = rate[j]
            for i in range(3):
                variance[i] += change * (noise.scale if i == j else noise.misalignment)


@njit_no_refcount
def predict(p, rate, dt, gap_s, shift, noise, work):  # type: ignore[no-untyped-def]
    """Propagate the covariance `p` (6, 6) over a step of `dt` seconds; `work` keeps the transition.

    `rate` (3,) is the estimated rate, `gap_s` the time from the beginning of a gap to the beginning
    of the step, -1 without a gap.  `shift` (3,) is first added to the variance of the bias.
    """
    transition(rate, dt, work)
    for i in range(3):
        p[i + 3, i + 3] += shift[i]
    congruence(work.phi, p, p, work.product)
    add_process_noise(p, rate, dt, gap_s, noise, work)
