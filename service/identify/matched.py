"""From identified stars to what an attitude is solved from: pairs of vectors, in one pass."""

import math

import numpy as np
from numba import njit

SUN_SCHWARZSCHILD_AU = 1.97412574336e-8
"""The Sun's gravitational radius, as ERFA has it."""


@njit(cache=True)
def matched_vectors(  # type: ignore[no-untyped-def]
    direction_body, sigma_rad, star, catalog_direction, velocity, sun_distance_au
):
    """Observed (N, 3) in body axes, reference (N, 3) inertial, and sigmas (N,) of the unique stars.

    `star` (n,) holds rows of the run catalog, -1 for stars without one.  The
    references are apparent as a moving observer sees them; a `velocity` of zero
    (units of c) leaves them geometric.
    """
    count = 0
    for k in range(len(star)):
        if star[k] >= 0:
            count += 1
    observed, reference = np.empty((count, 3)), np.empty((count, 3))
    sigma = np.empty(count)
    at = 0
    for k in range(len(star)):
        if star[k] >= 0:
            observed[at] = direction_body[k]
            sigma[at] = sigma_rad[k]
            aberrate(catalog_direction[star[k]], velocity, sun_distance_au, reference[at])
            at += 1
    return observed, reference, sigma


@njit(cache=True, nogil=True)
def aberrate(natural, velocity, sun_distance_au, apparent):  # type: ignore[no-untyped-def]
    """The apparent direction of a natural one, by the formula of ERFA's `ab`.

    ERFA's own is called wherever a call may cost what numpy's calls do.
    """
    speed2 = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
    if speed2 == 0.0:
        apparent[:] = natural
        return
    inverse_lorentz = math.sqrt(1.0 - speed2)
    along = natural[0] * velocity[0] + natural[1] * velocity[1] + natural[2] * velocity[2]
    w1 = 1.0 + along / (1.0 + inverse_lorentz)
    w2 = SUN_SCHWARZSCHILD_AU / sun_distance_au
    norm2 = 0.0
    for i in range(3):
        part = (
            natural[i] * inverse_lorentz
            + w1 * velocity[i]
            + w2 * (velocity[i] - along * natural[i])
        )
        apparent[i] = part
        norm2 += part * part
    norm = math.sqrt(norm2)
    for i in range(3):
        apparent[i] /= norm
