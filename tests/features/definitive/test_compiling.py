"""The kernels of filter and smoother are there once they were compiled at the start."""

import numpy as np

from service.features.definitive.kernels.filter import filter_attitude
from service.features.definitive.kernels.forward import run_filter
from service.features.definitive.kernels.inputs import ConstantRateModel
from service.features.definitive.kernels.result import joined
from service.features.definitive.kernels.smoother import (
    compile_kernels,
    run_smoother,
    settle,
    smooth,
)
from service.gyro.samples import GyroModel, GyroSamples
from tests.features.definitive.simulated import attitudes_of, gyro_of, slews, truth_of


def test_every_use_finds_what_was_compiled_at_the_start(rng):
    compile_kernels()
    truth, model = truth_of(slews, 300.0), GyroModel(3e-7, 3e-10)
    gyro, _ = gyro_of(truth, model, rng)
    attitudes = attitudes_of(truth, np.arange(0, 301, 8), (6.0, 6.0, 40.0), rng)
    result = filter_attitude(model, gyro, attitudes)
    smooth(result, model)
    later = GyroSamples(gyro.tai_ns[-1:] + 10**9, gyro.rate_rad_s[-1:])
    smooth(joined([result, filter_attitude(model, later, state=result.state)]), model)
    constant = ConstantRateModel(1e-6)
    smooth(filter_attitude(constant, attitudes=attitudes), constant)
    # Another kind of array would be compiled for itself.
    assert [len(each.overloads) for each in (run_filter, run_smoother, settle)] == [1, 1, 1]
