"""How a sample spacecraft turns: pointings held for a while, with slews between them.

Body rates are constant from one batch to the next and the attitude follows
from them, so that rates, attitudes and the stars' own times agree.
"""

from collections.abc import Iterator

import numpy as np

from service.missions.mission import Band, Mission
from service.vectors import Matrix, Vector, rotate_about, unit

CAP_SLEW_DEG_PER_S = 0.1
CAP_JITTER_DEG_PER_S = 5e-4
BAND_ROLL_DEG_PER_S = 0.02
BAND_JITTER_DEG_PER_S = 2e-5


def body_rates_deg_per_s(mission: Mission, batches: int, rng: np.random.Generator) -> Vector:
    """Rates (batches, 3) of the body relative to inertial, in body axes.

    A mission with a cap slews about any axis; one with a band rolls about the
    axis that it keeps on its pole.
    """
    rolls = isinstance(mission.zone, Band)
    jitter = BAND_JITTER_DEG_PER_S if rolls else CAP_JITTER_DEG_PER_S
    rates = rng.normal(0.0, jitter, (batches, 3))
    at = int(rng.integers(4, 13))
    while at < batches:
        turning = int(rng.integers(2, 9))
        share = rng.uniform(0.3, 1.0) * rng.choice((-1.0, 1.0))
        axis = mission.axis_body * BAND_ROLL_DEG_PER_S if rolls else random_axis(rng)
        rates[at : at + turning] = share * axis * (1.0 if rolls else CAP_SLEW_DEG_PER_S)
        at += turning + int(rng.integers(4, 13))
    # What is written is what was flown.
    return np.round(rates, 7)


def slewing_attitudes(rates_deg_per_s: Vector, cadence_s: float, first: Matrix) -> Iterator[Matrix]:
    """Attitude matrices, inertial to body, one a batch."""
    attitude = first
    for rates in rates_deg_per_s:
        yield attitude
        attitude = turned(attitude, np.radians(rates) * cadence_s)
        # A product of many rotations drifts from being one.
        u, _, vt = np.linalg.svd(attitude)
        attitude = u @ vt


def turned(attitude: Matrix, rotation_vector_rad: Vector) -> Matrix:
    """The attitude after the body has turned by a rotation vector in body axes."""
    return rotate_about(-rotation_vector_rad, attitude.T).T


def pointed(axis_body: Vector, direction: Vector, roll_rad: float) -> Matrix:
    """The attitude that has a body axis along an inertial direction, turned about it by a roll."""

    def frame(first: Vector) -> Matrix:
        second = unit(np.cross(first, np.eye(3)[int(np.argmin(np.abs(first)))]))
        return np.stack([first, second, np.cross(first, second)])

    return turned(frame(axis_body).T @ frame(direction), axis_body * roll_rad)


def random_axis(rng: np.random.Generator) -> Vector:
    """A direction (3,) drawn evenly over the sphere."""
    return unit(rng.normal(size=3))


def tilted(direction: Vector, angle_rad: float, rng: np.random.Generator) -> Vector:
    """A direction moved by an angle to a side drawn at random."""
    side = unit(np.cross(direction, random_axis(rng)))
    return rotate_about(side * angle_rad, direction)
