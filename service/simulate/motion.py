"""How a sample spacecraft turns: pointings held for a while, with slews between them.

Body rates are constant from one batch to the next and the attitude follows
from them, so that rates, attitudes and the stars' own times agree.
"""

import math
from collections.abc import Iterator

import numpy as np

from service.missions.mission import Band, Mission
from service.vectors import Matrix, Vector, rotate_about, unit

SLEW_DEG_PER_S = 0.1
CAP_JITTER_DEG_PER_S = 5e-4
BAND_JITTER_DEG_PER_S = 2e-5
CAP_HELD, BAND_HELD = (4, 13), (2, 5)
"""From, and below, so many batches between two slews; a band's roll goes round in steps."""


def body_rates_deg_per_s(mission: Mission, batches: int, rng: np.random.Generator) -> Vector:
    """Rates (batches, 3) of the body relative to inertial, in body axes.

    A mission with a cap slews about any axis; one with a band rolls about the
    axis that it keeps on its pole, in steps that lead all along the band, as
    in a roll calibration.
    """
    rolls = isinstance(mission.zone, Band)
    jitter = BAND_JITTER_DEG_PER_S if rolls else CAP_JITTER_DEG_PER_S
    held = BAND_HELD if rolls else CAP_HELD
    rates = rng.normal(0.0, jitter, (batches, 3))
    at = int(rng.integers(*held))
    while at < batches:
        turning = int(rng.integers(2, 9))
        share = rng.uniform(0.3, 1.0) * rng.choice((-1.0, 1.0))
        axis = mission.axis_body if rolls else random_axis(rng)
        rates[at : at + turning] = share * axis * SLEW_DEG_PER_S
        at += turning + int(rng.integers(*held))
    # What is written is what was flown.
    return np.round(rates, 7)


def slewing_attitudes(rates_deg_per_s: Vector, cadence_s: float, first: Matrix) -> Iterator[Matrix]:
    """Attitude matrices, inertial to body, one a batch."""
    attitude = first
    for rates in rates_deg_per_s:
        yield attitude
        attitude = turned_by(attitude, np.radians(rates) * cadence_s)
        # A product of many rotations drifts from being one.
        u, _, vt = np.linalg.svd(attitude)
        attitude = u @ vt


def turned_by(attitude: Matrix, rotation_vector_rad: Vector) -> Matrix:
    """The attitude after the body has turned by a rotation vector in body axes."""
    return rotate_about(-rotation_vector_rad, attitude.T).T


def pointed(axis_body: Vector, direction: Vector, roll_rad: float) -> Matrix:
    """The attitude that has a body axis along an inertial direction, turned about it by a roll."""
    body, inertial = (np.stack([each, *across(each)]) for each in (axis_body, direction))
    return turned_by(body.T @ inertial, axis_body * roll_rad)


def across(direction: Vector) -> tuple[Vector, Vector]:
    """Two directions at right angles to each unit vector (..., 3) and to each other."""
    # The coordinate axis that it leans to least is never along it.
    aside = unit(np.cross(direction, np.eye(3)[np.argmin(np.abs(direction), axis=-1)]))
    return aside, np.cross(direction, aside)


def random_axis(rng: np.random.Generator) -> Vector:
    """A direction (3,) drawn evenly over the sphere."""
    return unit(rng.normal(size=3))


def tilted(direction: Vector, angle_rad: float, rng: np.random.Generator) -> Vector:
    """A direction moved by an angle to a side drawn at random."""
    aside, above = across(direction)
    bearing = rng.uniform(0.0, math.tau)
    about = math.cos(bearing) * aside + math.sin(bearing) * above
    return rotate_about(about * angle_rad, direction)
