"""Compiling the filter and the smoother before the first attitudes are filtered."""

import numpy as np

from service.filtering.filter import filter_attitude
from service.filtering.gyro import GyroModel
from service.filtering.samples import AttitudeMeasurements, DirectionMeasurements, GyroSamples
from service.filtering.smoother import smooth

_STEP_NS = 10**9


def compile_filtering() -> None:
    """Compile the kernels by filtering and smoothing three seconds of rest."""
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
