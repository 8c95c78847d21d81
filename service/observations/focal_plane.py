"""Conversion between the angles that a tracker measures and directions in tracker axes."""

import numpy as np

from service.missions.mission import Calibration
from service.vectors import Vector, unit


def tracker_vectors(angles_deg: Vector, calibration: Calibration) -> Vector:
    """Unit vectors (n, 3) in tracker axes for measured angles (n, 2) in degrees.

    The direction is (tan h, tan v, 1), where h and v are the true angles.
    """
    plane = np.ones((len(angles_deg), 3))
    plane[:, :2] = true_tangents(angles_deg, calibration)
    return unit(plane)


def true_tangents(angles_deg: Vector, calibration: Calibration) -> Vector:
    """Tangents (n, 2) of the true angles for measured angles (n, 2) in degrees."""
    h, v = angles_deg.T
    true = angles_deg.copy()
    for axis, terms in enumerate((calibration.h_terms, calibration.v_terms)):
        if terms:
            true[:, axis] += sum(c * h**i * v**j for i, j, c in terms)
    return np.asarray(np.tan(np.radians(calibration.scale * true)))


def measured_angles_deg(direction: Vector, calibration: Calibration) -> Vector:
    """The angles (n, 2) in degrees that a tracker would measure for directions (n, 3)."""
    true = np.degrees(np.arctan2(direction[:, :2], direction[:, 2:]))
    measured = true / calibration.scale
    # The terms are small, so the fixed-point iteration converges in a few rounds.
    for _ in range(20):
        h, v = measured.T
        bent = [
            sum((c * h**i * v**j for i, j, c in terms), np.zeros_like(h))
            for terms in (calibration.h_terms, calibration.v_terms)
        ]
        measured = true / calibration.scale - np.stack(bent, axis=1)
    return np.asarray(measured)
