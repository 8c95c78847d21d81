"""Rotations between attitudes, of whole arrays of quaternions: scalar last, inertial to body."""

import numpy as np

from service.vectors import Vector


def rotation_vectors(first: Vector, second: Vector) -> Vector:
    """The rotations (n, 3) of the body from attitudes (n, 4) to others, radians in body axes.

    The vector w satisfies A(second) = exp(-[w x]) A(first); it is the shorter of both turns.
    Accurate at every angle.
    """
    v, c = first[..., :3], first[..., 3:]
    w, d = second[..., :3], second[..., 3:]
    part = c * w - d * v + np.cross(w, v)
    scalar = c * d + np.sum(v * w, axis=-1, keepdims=True)
    part, scalar = np.where(scalar < 0, -part, part), np.abs(scalar)
    sine = np.sqrt(np.sum(part * part, axis=-1, keepdims=True))
    angle = 2.0 * np.arctan2(sine, scalar)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(sine == 0.0, 2.0, angle / sine)
    return np.asarray(part * scale)


def turned_quaternion(quaternion: Vector, rotation_vector_rad: Vector) -> Vector:
    """The attitude (..., 4) after the body has turned by vectors (..., 3) in body axes.

    The inverse of `rotation_vectors`.
    """
    half = 0.5 * np.sqrt(np.sum(rotation_vector_rad**2, axis=-1, keepdims=True))
    p = 0.5 * np.sinc(half / np.pi) * rotation_vector_rad
    s = np.cos(half)
    v, c = quaternion[..., :3], quaternion[..., 3:]
    part = s * v + c * p - np.cross(p, v)
    scalar = s * c - np.sum(p * v, axis=-1, keepdims=True)
    return np.concatenate([part, scalar], axis=-1)


def matrices(quaternion: Vector) -> Vector:
    """The attitude matrices A(q), (n, 3, 3), of quaternions (n, 4): body = A @ inertial."""
    v, c = quaternion[:, :3], quaternion[:, 3]
    x, y, z = v.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    square = c * c - np.sum(v * v, axis=1)
    return np.asarray(
        square[:, None, None] * np.eye(3)
        + 2.0 * v[:, :, None] * v[:, None, :]
        - 2.0 * c[:, None, None] * cross
    )
