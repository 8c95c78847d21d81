"""A solved case in a line: exact or noisy vectors in, the service's solution out."""

import numpy as np

from service.attitude.solution import solve_attitude
from tests.reference.batches import quaternion_matrix, random_quaternion

ARCSEC = 206264.80624709636


def seen(rng, truth, inertial, sigma_arcsec):
    """Body vectors of inertial ones with two-axis Gaussian noise."""
    body = np.asarray(inertial) @ truth.T
    sigma = np.broadcast_to(sigma_arcsec, len(body))[:, None] / ARCSEC
    aside = rng.normal(size=body.shape)
    aside -= np.sum(aside * body, axis=1, keepdims=True) * body
    noisy = body + sigma * aside
    return noisy / np.linalg.norm(noisy, axis=1, keepdims=True)


def field_of_stars(rng, boresight, radius_deg, count):
    """Inertial unit vectors within a radius of a boresight."""
    boresight = np.asarray(boresight, float) / np.linalg.norm(boresight)
    aside = rng.normal(size=(count, 3))
    aside -= (aside @ boresight)[:, None] * boresight
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    angle = np.radians(radius_deg) * np.sqrt(rng.uniform(size=(count, 1)))
    return np.cos(angle) * boresight + np.sin(angle) * aside


def random_attitude(rng):
    return quaternion_matrix(random_quaternion(rng))


def solved(observed, reference, sigma_arcsec, trackers=None, method="quest"):
    """`trackers` gives the number of the tracker of each star; one tracker without it."""
    tracker_of = np.zeros(len(observed), np.int64) if trackers is None else np.asarray(trackers)
    names = tuple(f"TRACKER_{k + 1}" for k in range(int(tracker_of.max(initial=0)) + 1))
    sigma = np.broadcast_to(np.asarray(sigma_arcsec, float), len(observed)).copy()
    return solve_attitude(
        np.ascontiguousarray(observed),
        np.ascontiguousarray(reference),
        sigma / ARCSEC,
        tracker_of,
        names,
        method,
    )
