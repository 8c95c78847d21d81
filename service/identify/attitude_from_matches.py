"""Attitudes from identified stars: vector pairs of observed and catalog stars, and their fit."""

import math
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from service.attitude.kernels import TASTE, FitWorkspace, fit_attitude
from service.attitude.solution import (
    METHODS,
    WORST_AXIS_RAD,
    AttitudeSolution,
    NoAttitude,
    solution_of,
    taste_bound,
    tracker_fits,
)
from service.compiled.jit import njit, njit_no_refcount
from service.identify.identification import Integers
from service.vectors import Vector, locked

SUN_SCHWARZSCHILD_AU = 1.97412574336e-8
"""The Sun's gravitational radius in au, with ERFA's value."""


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
    """The attitude solution of n identified stars, or the reason for none, in one compiled call.

    It is `solve_attitude` of the `matched_vectors`. `tracker_of` (n,) may be None for a single
    tracker. The solution's residuals have one row per observed star, NaN for stars without an
    identity.
    """
    fits = room_for_fits(1, len(star))
    fit_sightings(
        *(
            np.zeros(1, np.int64),
            np.array((0, len(star))),
            np.array(direction_body),
            np.array(sigma_rad),
        ),
        *(np.array(star), catalog_direction, np.array((velocity_c,)), np.array((sun_distance_au,))),
        *(WORST_AXIS_RAD, METHODS.index(method), fits),
    )
    found = fits.of_batch(0, 0, len(star), method)
    if tracker_of is None or len(trackers) < 2 or isinstance(found, NoAttitude):
        return found
    seen = direction_body, sigma_rad, star, catalog_direction, velocity_c, sun_distance_au
    return with_tracker_fits(found, *seen, tracker_of, trackers)


def with_tracker_fits(
    solution: AttitudeSolution,
    direction_body: Vector,
    sigma_rad: Vector,
    star: Integers,
    catalog_direction: Vector,
    velocity_c: Vector,
    sun_distance_au: float,
    tracker_of: Integers,
    trackers: tuple[str, ...],
) -> AttitudeSolution:
    """An attitude solution extended by the agreement of each tracker's stars with the attitude."""
    observed, reference, sigma = matched_vectors(
        direction_body, sigma_rad, star, catalog_direction, velocity_c, sun_distance_au
    )
    used = tracker_of[star >= 0]
    fits = tracker_fits(observed, reference, sigma, solution, used, trackers)
    return replace(solution, trackers=fits)


class FitColumns(NamedTuple):
    """The attitude solutions of n batches with m stars in all, as arrays filled by kernels.

    `matched` (n,) is the number of identified stars of a batch, or -1 if there are enough but their
    geometry gives no attitude. The other fields are those of `FitWorkspace`, by batch (n, ...) or
    by star, and undefined for batches without an attitude; `residual_arcsec` (m,) is NaN for stars
    without an identity.
    """

    matched: Any
    quaternions: Any
    attitude: Any
    covariance_arcsec2: Any
    residual_arcsec: Any
    figures: Any

    def is_good(self, row: int) -> bool:
        """True if a batch has an attitude that is consistent with its residuals."""
        matched = int(self.matched[row])
        return matched >= 2 and bool(self.figures[row, TASTE] <= taste_bound(2 * matched - 3))

    def of_batch(
        self, row: int, first: int, last: int, method: str
    ) -> AttitudeSolution | NoAttitude:
        """The attitude solution of one batch, or the reason for none, from the columns of many."""
        matched = int(self.matched[row])
        if matched < 0:
            return NoAttitude.DEGENERATE_GEOMETRY
        if matched < 2:
            return NoAttitude.FEWER_THAN_TWO_UNIQUE_STARS
        of_one = FitWorkspace(
            self.quaternions[row],
            self.attitude[row],
            self.covariance_arcsec2[row],
            self.residual_arcsec[first:last],
            self.figures[row],
        )
        return solution_of(of_one, matched, method)


def room_for_fits(batches: int, stars: int) -> FitColumns:
    """Empty arrays for the attitude solutions of given numbers of batches and stars."""
    return FitColumns(
        matched=np.zeros(batches, np.int64),
        quaternions=np.empty((batches, 3, 4)),
        attitude=np.empty((batches, 3, 3)),
        covariance_arcsec2=np.empty((batches, 3, 3)),
        residual_arcsec=np.empty(stars),
        figures=np.empty((batches, 4)),
    )


@njit(error_model="numpy")
def fit_sightings(  # type: ignore[no-untyped-def]
    which,
    offsets,
    direction_body,
    sigma_rad,
    star,
    catalog_direction,
    velocity,
    sun_distance_au,
    worst_rad,
    chosen,
    fits,
):
    """Solve the attitudes of the batches named by `which`, each from the stars of all its trackers.

    The stars of batch i are rows from `offsets[i]` to before `offsets[i + 1]`; `velocity` (n, 3)
    and `sun_distance_au` (n,) are by batch. The function keeps the interpreter's lock, since
    acquiring the lock again may take longer than solving a few attitudes.
    """
    for i in which:
        first, last = offsets[i], offsets[i + 1]
        observed, reference, sigma = _matched_vectors(
            direction_body[first:last],
            sigma_rad[first:last],
            star[first:last],
            catalog_direction,
            velocity[i],
            sun_distance_au[i],
        )
        fits.matched[i] = len(sigma)
        if len(sigma) < 2:
            continue
        of_matched = FitWorkspace(
            fits.quaternions[i],
            fits.attitude[i],
            fits.covariance_arcsec2[i],
            np.empty(len(sigma)),
            fits.figures[i],
        )
        if not fit_attitude(observed, reference, sigma, worst_rad, chosen, of_matched):
            fits.matched[i] = -1
            continue
        at = 0
        for k in range(first, last):
            fits.residual_arcsec[k] = math.nan
            if star[k] >= 0:
                fits.residual_arcsec[k] = of_matched.residual_arcsec[at]
                at += 1


def matched_vectors(
    direction_body: Vector,
    sigma_rad: Vector,
    star: Integers,
    catalog_direction: Vector,
    velocity_c: Vector,
    sun_distance_au: float,
) -> tuple[Vector, Vector, Vector]:
    """Body vectors (N, 3), inertial reference vectors (N, 3) and sigmas (N,) of identified stars.

    `star` (n,) holds rows of the run catalog, -1 for stars without one.  The
    references are apparent as a moving observer sees them; a `velocity_c` of zero
    (units of c) leaves them geometric.
    """
    # Of the kinds of array that `fit_sightings` has.
    stars = (np.array(each, order="C") for each in (direction_body, sigma_rad, star))
    found: tuple[Vector, Vector, Vector] = _matched_vectors(
        *(*stars, locked(catalog_direction), np.array(velocity_c), sun_distance_au)
    )
    return found


# numba derives the types of its arguments from those of each call.
@njit(error_model="numpy")
def _matched_vectors(  # type: ignore[no-untyped-def]
    direction_body, sigma_rad, star, catalog_direction, velocity, sun_distance_au
):
    """Compiled arrays of the vectors and sigmas of identified stars; see `matched_vectors`."""
    count = 0
    for k in range(len(star)):
        if star[k] >= 0:
            count += 1
    # One array, because allocating and slicing several arrays would take longer than the rest.
    both = np.empty((2, count, 3))
    observed, reference = both[0], both[1]
    sigma = np.empty(count)
    stars = direction_body, sigma_rad, star, catalog_direction, velocity, sun_distance_au
    match(*stars, observed, reference, sigma)
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
    """Fill arrays with the vectors and sigmas of identified stars; returns their number."""
    at_rest = velocity[0] == 0.0 and velocity[1] == 0.0 and velocity[2] == 0.0
    at = 0
    for k in range(len(star)):
        row = star[k]
        if row >= 0:
            # Copying number by number is fastest.
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
    """Write the apparent direction of a star for a moving observer, by the formula of ERFA's `ab`.

    ERFA's own function is used wherever the overhead of a numpy call is acceptable.
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
