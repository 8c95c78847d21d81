"""From a mission and its recorded gyro samples to what the filter takes.

This is the one place where recorded rates are converted: to body axes, to mean rates, and to
samples that the gyro can have measured.
"""

import math

import numpy as np
import numpy.typing as npt

from service.filtering.gyro import ConstantRateModel, GyroModel
from service.filtering.samples import GyroSamples
from service.gyro.block import Nanoseconds
from service.missions.gyro import GyroSettings, MotionSettings
from service.vectors import ARCSEC_PER_RADIAN, Vector

GAP_IN_STEPS = 1.5
"""Of the median step: a longer one is a gap, where the mission says nothing else."""
NS = 1e-9


def believed(settings: GyroSettings, rates_rad_s: Vector) -> npt.NDArray[np.bool_]:
    """Which of the rates (n, 3) about the gyro's axes are within the mission's largest, as (n,).

    Blocks beyond it are refused on arrival; the mission may have named another number since.
    """
    largest = math.radians(settings.largest_rate_deg_per_s)
    return np.asarray((np.abs(rates_rad_s) <= largest).all(axis=1))


def gyro_samples(
    settings: GyroSettings, tai_ns: Nanoseconds, rates_rad_s: Vector
) -> tuple[GyroModel, GyroSamples]:
    """The model and the samples of a stretch: mean rates since the sample before, in body axes.

    `tai_ns` (n,) rise, and `rates_rad_s` (n, 3) are as recorded, about the gyro's axes.
    """
    step_s = np.diff(tai_ns) * NS
    largest_step_s = settings.largest_step_s
    if largest_step_s is None:
        largest_step_s = GAP_IN_STEPS * float(np.median(step_s)) if len(step_s) else 1.0
    body = rates_rad_s @ settings.body_from_gyro.T
    if settings.samples == "instant":
        # Across a gap the filter itself takes the mean of both sides.
        between = 0.5 * (body[1:] + body[:-1])
        body = np.vstack([body[:1], np.where(step_s[:, None] > largest_step_s, body[1:], between)])
    widest = float(np.abs(settings.body_from_gyro).sum(axis=1).max())
    model = GyroModel(
        sigma_v_rad_s0_5=settings.sigma_v_rad_s0_5,
        sigma_u_rad_s1_5=settings.sigma_u_rad_s1_5,
        bias_sigma_rad_s=settings.bias_sigma_rad_s,
        scale=settings.scale,
        misalignment_rad=settings.misalignment_arcsec / ARCSEC_PER_RADIAN,
        largest_step_s=largest_step_s,
        # The mission's is about each axis of the gyro, the filter's about each of the body.
        largest_rate_rad_s=math.radians(settings.largest_rate_deg_per_s) * widest * (1.0 + 1e-9),
    )
    return model, GyroSamples(tai_ns, body)


def constant_rate(settings: MotionSettings | None) -> ConstantRateModel:
    """The model of a body without a gyro."""
    settings = settings or MotionSettings()
    return ConstantRateModel(settings.rate_walk_rad_s1_5, settings.rate_sigma_rad_s)
