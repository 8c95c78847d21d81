"""The steady state of a filter of one axis, in closed form.

Farrenkopf's solution as Markley & Reynolds (Analytic Steady-State Accuracy of a
Spacecraft Attitude Estimator, 2000) give it, without noise of the gyro's angle.
"""

import math


def steady_sigmas(
    sigma_rad: float, step_s: float, sigma_v: float, sigma_u: float
) -> tuple[float, float]:
    """Sigmas of the angle before and after an update, in the unit of `sigma_rad`.

    The angle is measured every `step_s` with `sigma_rad`; the gyro has the densities
    `sigma_v` (rad/s^.5) and `sigma_u` (rad/s^1.5).
    """
    s_v = sigma_v * math.sqrt(step_s) / sigma_rad
    s_u = sigma_u * step_s**1.5 / sigma_rad
    gamma = math.sqrt(1.0 + s_v**2 / 4.0 + s_u**2 / 48.0)
    zeta = gamma + s_u / 4.0 + 0.5 * math.sqrt(2.0 * gamma * s_u + s_v**2 + s_u**2 / 3.0)
    return sigma_rad * math.sqrt(zeta**2 - 1.0), sigma_rad * math.sqrt(1.0 - zeta**-2)
