"""Smoother of filtered attitudes: a backward pass that adds the information of later data.

The recursion of Rauch, Tung & Striebel (1965), with attitude corrections as rotations.  It stops at
epochs at which the filter started anew.
"""

from typing import Any, NamedTuple

import numpy as np

from service.attitude.covariance import (
    cholesky,
    congruence,
    copy,
    multiply_transposed,
    solve_factored,
)
from service.attitude.quaternions import rotation_between, turn
from service.compiled.jit import njit_no_refcount
from service.features.definitive.kernels.filter import filter_attitude, noise_of
from service.features.definitive.kernels.forward import (
    DOUBTFUL,
    GOOD,
    LOST,
    NONE,
    STARTING,
    UNCHECKED,
)
from service.features.definitive.kernels.inputs import (
    AttitudeMeasurements,
    ConstantRateModel,
    DirectionMeasurements,
)
from service.features.definitive.kernels.propagation import predict, workspace
from service.features.definitive.kernels.result import AttitudeHistory, FilterResult
from service.gyro.samples import GyroModel, GyroSamples
from service.vectors import read_only

_STEP_NS = 10**9


class Filtered(NamedTuple):
    """Input arrays of the smoother for n filtered epochs and the steps to them; see `Steps`."""

    step_s: Any
    rate_rad_s: Any
    gap_s: Any
    shift: Any
    started: Any
    updated: Any
    status: Any
    doubt_rad: Any


class Smoothed(NamedTuple):
    """Output arrays of the smoother for n epochs; see `AttitudeHistory`."""

    quaternion: Any
    bias: Any
    covariance: Any
    doubt_rad: Any
    status: Any


class Matrices(NamedTuple):
    """Scratch arrays of the smoother: predicted covariance, gain, a spare (6, 6), a quaternion."""

    predicted: Any
    gain: Any
    spare: Any
    kept: Any


def smooth(result: FilterResult, model: GyroModel | ConstantRateModel) -> AttitudeHistory:
    """Smooth the attitudes in the result of the filter, with the same motion model.

    Results filtered in parts are joined first by `result.joined`.  A doubt is removed if later
    measurements agreed with the attitude; if the filter dropped the attitude, the doubt extends
    back to the last accepted measurement.
    """
    gyro = model.as_gyro() if isinstance(model, ConstantRateModel) else model
    history, steps = result.history, result.steps
    filtered = Filtered(
        steps.step_s,
        steps.measured_rate_rad_s,
        steps.gap_s,
        steps.shift,
        steps.started,
        steps.updated,
        history.status,
        history.doubt_rad,
    )
    smoothed = Smoothed(
        history.quaternion.copy(),
        history.bias_rad_s.copy(),
        history.model_covariance.copy(),
        history.doubt_rad.copy(),
        history.status.copy(),
    )
    matrices = Matrices(np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(4))
    run_smoother(filtered, smoothed, noise_of(gyro), matrices, workspace())
    settle(filtered, smoothed)
    for array in smoothed:
        read_only(array)
    return AttitudeHistory(
        history.tai_ns,
        smoothed.quaternion,
        read_only(steps.measured_rate_rad_s - smoothed.bias),
        smoothed.bias,
        smoothed.covariance,
        smoothed.doubt_rad,
        smoothed.status,
    )


@njit_no_refcount
def run_smoother(filtered, smoothed, noise, matrices, work):  # type: ignore[no-untyped-def]
    """Smooth attitude, bias and covariance backward from the last epoch but one.

    `smoothed` holds a copy of the filtered values on entry.  No information passes back across a
    start.
    """
    gain = matrices.gain
    for k in range(len(filtered.status) - 2, -1, -1):
        if filtered.status[k] == NONE or filtered.started[k + 1]:
            continue
        q, bias, p = smoothed.quaternion[k], smoothed.bias[k], smoothed.covariance[k]
        if not _find_gain(filtered, k, bias, p, noise, matrices, work):
            continue
        # The prediction of the next epoch takes the place of q until it is compared.
        for i in range(4):
            matrices.kept[i] = q[i]
        for i in range(3):
            work.theta[i] = work.rate[i] * filtered.step_s[k + 1]
            work.dx[i + 3] = smoothed.bias[k + 1, i] - bias[i]
        turn(q, work.theta, q)
        rotation_between(q, smoothed.quaternion[k + 1], work.dx)
        for i in range(3):
            work.theta[i] = 0.0
            for j in range(6):
                work.theta[i] += gain[i, j] * work.dx[j]
                bias[i] += gain[i + 3, j] * work.dx[j]
        turn(matrices.kept, work.theta, q)
        for i in range(6):
            for j in range(6):
                matrices.predicted[i, j] = (
                    smoothed.covariance[k + 1, i, j] - matrices.predicted[i, j]
                )
        congruence(gain, matrices.predicted, matrices.spare, work.product)
        for i in range(6):
            for j in range(6):
                p[i, j] += matrices.spare[i, j]


@njit_no_refcount
def _find_gain(filtered, k, bias, p, noise, matrices, work):  # type: ignore[no-untyped-def]
    """Smoother gain P phi^T P_predicted^-1 of epoch k, and the predicted covariance of the next.

    False if the predicted covariance is not positive definite.
    """
    for i in range(3):
        work.rate[i] = filtered.rate_rad_s[k + 1, i] - bias[i]
        work.shift[i] = filtered.shift[k + 1, i]
    copy(p, matrices.predicted)
    step_s, gap_s = filtered.step_s[k + 1], filtered.gap_s[k + 1]
    predict(matrices.predicted, work.rate, step_s, gap_s, work.shift, noise, work)
    if not cholesky(matrices.predicted, 6, matrices.spare):
        return False
    multiply_transposed(p, work.phi, matrices.gain)
    for i in range(6):
        solve_factored(matrices.spare, 6, matrices.gain[i])
    return True


@njit_no_refcount
def settle(filtered, smoothed):  # type: ignore[no-untyped-def]
    """Remove doubts that later measurements resolved, and confirm starts that they confirmed.

    A doubt that lasted to the end of its interval extends back to the last accepted measurement.
    Data after a gyro gap confirm no attitude before it; if nothing confirms the measurement that
    ended a gap, nothing confirms the attitudes back to the previous measurement.
    """
    n = len(filtered.status)
    lasting, confirmed, unchecked, doubt_rad = False, False, False, 0.0
    for k in range(n - 1, -1, -1):
        status = filtered.status[k]
        if k == n - 1 or filtered.started[k + 1]:
            lasting, confirmed, unchecked = filtered.doubt_rad[k] > 0.0, False, False
        elif filtered.updated[k + 1] == UNCHECKED:
            confirmed, unchecked = False, not confirmed
        if filtered.updated[k]:
            unchecked = False
        if filtered.doubt_rad[k] > 0.0:
            doubt_rad = filtered.doubt_rad[k]
        elif filtered.updated[k]:
            lasting = False
        smoothed.doubt_rad[k] = doubt_rad if lasting else 0.0
        if status in (GOOD, DOUBTFUL) and not unchecked:
            confirmed = True
        if status not in (NONE, LOST):
            smoothed.status[k] = DOUBTFUL if lasting else GOOD if confirmed else STARTING


def compile_kernels() -> None:
    """Compile filter and smoother by running them on three seconds of a body at rest."""
    model = GyroModel(sigma_v_rad_s0_5=1e-6, sigma_u_rad_s1_5=1e-9)
    tai_ns = np.arange(4, dtype=np.int64) * _STEP_NS
    gyro = GyroSamples(tai_ns, np.zeros((4, 3)))
    attitudes = AttitudeMeasurements(
        tai_ns[:2], np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)), np.tile(np.eye(3) * 1e-10, (2, 1, 1))
    )
    x_axis = np.tile([1.0, 0.0, 0.0], (2, 1))
    directions = DirectionMeasurements(tai_ns[2:], x_axis, x_axis, np.full(2, 1e-5))
    result = filter_attitude(model, gyro, attitudes, directions)
    assert result.innovations.accepted[1:].all()
    smooth(result, model)
