"""From identified stars to what an attitude is solved from: pairs of vectors, in one pass."""

import math

import numpy as np

from service.attitude.kernels import FitWorkspace, fit_attitude
from service.attitude.solution import AttitudeSolution, NoAttitude
from service.attitude.solve import (
    METHODS,
    WORST_AXIS_RAD,
    fit_workspace,
    solution_of,
    tracker_fits,
)
from service.compiled.jit import njit, njit_no_refcount
from service.identify.identification import Integers
from service.vectors import Vector

SUN_SCHWARZSCHILD_AU = 1.97412574336e-8
"""The Sun's gravitational radius, as ERFA has it."""


def attitude_of(
    direction_body: Vector,
    sigma_rad: Vector,
    star: Integers,
    tracker_of: Integers | None,
    trackers: tuple[str, ...],
    catalog_direction: Vector,
    velocity_c: Vector,
    sun_distance_au: float,
    method: str,
) -> AttitudeSolution | NoAttitude:
    """`solve_attitude` of the `matched_vectors` of n stars, in one compiled call.

    `tracker_of` (n,) may be None where there is one of `trackers`.  The
    solution's residuals have one row an observed star, NaN for those without an
    identity.
    """
    given = direction_body, sigma_rad, star, catalog_direction, velocity_c, sun_distance_au
    workspace = fit_workspace(len(star))
    matched = _match_and_fit(*given, WORST_AXIS_RAD, METHODS.index(method), workspace)
    if matched < 0:
        return NoAttitude.DEGENERATE_GEOMETRY
    if matched < 2:
        return NoAttitude.FEWER_THAN_TWO_UNIQUE_STARS
    if tracker_of is None:
        return solution_of(workspace, matched, method)
    observed, reference, sigma = matched_vectors(*given)
    used = tracker_of[star >= 0]
    fits = tracker_fits(observed, reference, sigma, workspace, used, trackers)
    return solution_of(workspace, matched, method, fits)


@njit(error_model="numpy")
def _match_and_fit(  # type: ignore[no-untyped-def]
    direction_body,
    sigma_rad,
    star,
    catalog_direction,
    velocity,
    sun_distance_au,
    worst_rad,
    chosen,
    workspace,
):
    """How many stars are matched, or -1 where they are enough and yet give no attitude."""
    observed, reference, sigma = matched_vectors(
        direction_body, sigma_rad, star, catalog_direction, velocity, sun_distance_au
    )
    count = len(sigma)
    if count < 2:
        return count
    of_matched = FitWorkspace(
        workspace.quaternions,
        workspace.attitude,
        workspace.covariance_arcsec2,
        np.empty(count),
        workspace.figures,
    )
    if not fit_attitude(observed, reference, sigma, worst_rad, chosen, of_matched):
        return -1
    at = 0
    for k in range(len(star)):
        workspace.residual_arcsec[k] = math.nan
        if star[k] >= 0:
            workspace.residual_arcsec[k] = of_matched.residual_arcsec[at]
            at += 1
    return count


@njit(error_model="numpy")
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
    # One array: to make arrays and to cut them takes longer than the rest.
    both = np.empty((2, count, 3))
    observed, reference = both[0], both[1]
    sigma = np.empty(count)
    given = direction_body, sigma_rad, star, catalog_direction, velocity, sun_distance_au
    match(*given, observed, reference, sigma)
    return observed, reference, sigma


@njit_no_refcount
def match(
    direction_body: Vector,
    sigma_rad: Vector,
    star: Integers,
    catalog_direction: Vector,
    velocity: Vector,
    sun_distance_au: float,
    observed: Vector,
    reference: Vector,
    sigma: Vector,
) -> int:
    """`matched_vectors` into arrays that are long enough; how many there are."""
    at_rest = velocity[0] == 0.0 and velocity[1] == 0.0 and velocity[2] == 0.0
    at = 0
    for k in range(len(star)):
        row = star[k]
        if row >= 0:
            # Number by number, as is quickest.
            for i in range(3):
                observed[at, i] = direction_body[k, i]
                reference[at, i] = catalog_direction[row, i]
            sigma[at] = sigma_rad[k]
            if not at_rest:
                aberrate(catalog_direction[row], velocity, sun_distance_au, reference[at])
            at += 1
    return at


@njit_no_refcount
def aberrate(natural, velocity, sun_distance_au, apparent):  # type: ignore[no-untyped-def]
    """The apparent direction of a natural one, by the formula of ERFA's `ab`.

    ERFA's own is called wherever a call may cost what numpy's calls do.
    """
    speed2 = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
    if speed2 == 0.0:
        for i in range(3):
            apparent[i] = natural[i]
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
