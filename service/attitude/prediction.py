"""Prediction of an attitude to a later time, by gyro samples or at a constant rate.

A rotation vector theta turns an attitude as in `attitude.quaternions`: A' = exp(-[theta x]) A.
The rate of a body without a gyro is a random walk of density q (rad/s^1.5), so that after t
seconds the angle has the variance q^2 t^3 / 3 where the rate is known at the beginning, and
q^2 t^3 / 12 where the mean of the rates at both ends is used.
"""

import math
from dataclasses import dataclass

import numpy as np

from service.gyro.samples import GyroModel, GyroSamples
from service.vectors import (
    ARCSEC_PER_RADIAN,
    Matrix,
    Vector,
    attitude_error_arcsec,
    matrix_from_quaternion,
)

NS = 1e-9


@dataclass(frozen=True, eq=False)
class Known:
    """Known attitude: quaternion (4,) inertial to body, time (`Utc.tai_ns`), covariance (3, 3)."""

    tai_ns: int
    quaternion: Vector
    covariance_rad2: Matrix


@dataclass(frozen=True, eq=False)
class Rate:
    """The mean rate (3,) about the body axes after a known attitude, in rad/s, with its errors.

    `variance` (3, 3) is its covariance in (rad/s)^2, and `walk_s3` the factor of q^2 in the
    variance of the angle, in s^3.
    """

    rad_s: Vector
    variance: Matrix
    walk_s3: float


def given_rate(rates_rad_s: list[Vector], sigma_rad_s: float, passed_s: float) -> Rate:
    """The mean rate from the rates sent with the earlier and later batch, one or both."""
    share = 12.0 if len(rates_rad_s) > 1 else 3.0
    variance = np.eye(3) * sigma_rad_s**2
    return Rate(np.mean(rates_rad_s, axis=0), variance, passed_s**3 / share)


def derived_rate(before: Known, known: Known, passed_s: float) -> Rate:
    """The mean rate between two attitudes, used after the second.

    A random-walk rate differs from its mean over h seconds by a variance of q^2 h / 3 at the end.
    """
    h = (known.tai_ns - before.tai_ns) * NS
    was, now = (matrix_from_quaternion(each.quaternion) for each in (before, known))
    turned = attitude_error_arcsec(now, was) / ARCSEC_PER_RADIAN
    variance = (before.covariance_rad2 + known.covariance_rad2) / h**2
    return Rate(turned / h, variance, passed_s**3 / 3.0 + passed_s**2 * h / 3.0)


def unknown_rate(sigma_rad_s: float, passed_s: float) -> Rate:
    """A zero rate with the uncertainty of how fast the body may rotate."""
    return Rate(np.zeros(3), np.eye(3) * sigma_rad_s**2, passed_s**3 / 3.0)


def predict_at_rate(known: Known, tai_ns: int, rate: Rate, walk_rad_s1_5: float) -> Known:
    """The attitude predicted to a later time at a constant rate with a random walk."""
    passed_s = (tai_ns - known.tai_ns) * NS
    turn = _quaternions(rate.rad_s[None] * passed_s)[0]
    added = rate.variance * passed_s**2 + np.eye(3) * walk_rad_s1_5**2 * rate.walk_s3
    return _turned(known, tai_ns, turn, added)


def predict_by_gyro(
    known: Known, tai_ns: int, model: GyroModel, samples: GyroSamples, walk_rad_s1_5: float
) -> Known | None:
    """The attitude predicted to a later time by gyro samples; None if they leave a gap.

    The last sample may be one step old. The bias is assumed zero, with the model's sigma.
    """
    times_ns, rates = samples.tai_ns, samples.rate_rad_s
    if len(times_ns) < 2:
        return None
    start_ns, end_ns = times_ns[:-1], times_ns[1:]
    first, last = np.maximum(start_ns, known.tai_ns), np.minimum(end_ns, tai_ns)
    used = last > first
    step_s = (last - first)[used] * NS
    steps_s = (end_ns - start_ns)[used] * NS
    passed_s = (tai_ns - known.tai_ns) * NS
    left_s = max(0.0, (tai_ns - int(times_ns[-1])) * NS)
    covered = step_s.sum() + left_s >= passed_s - 1e-6
    longest_s = model.largest_step_s
    if not covered or left_s > longest_s or (len(steps_s) and steps_s.max() > longest_s + 1e-6):
        return None
    rotations = rates[1:][used] * step_s[:, None]
    if left_s > 0.0:
        rotations = np.vstack([rotations, rates[-1] * left_s])
    angle_rad = float(np.linalg.norm(rotations, axis=1).sum())
    variance = (
        model.sigma_v_rad_s0_5**2 * passed_s
        + (model.bias_sigma_rad_s * passed_s) ** 2
        + model.sigma_u_rad_s1_5**2 * passed_s**3 / 3.0
        + (math.hypot(model.scale, model.misalignment_rad) * angle_rad) ** 2
        + walk_rad_s1_5**2 * left_s**3 / 3.0
    )
    return _turned(known, tai_ns, _product(_quaternions(rotations)), np.eye(3) * variance)


def _turned(known: Known, tai_ns: int, turn: Vector, added_rad2: Matrix) -> Known:
    """A known attitude after a rotation, given as a quaternion; covariance about the new axes."""
    quaternion = _compose(turn[None], known.quaternion[None])[0]
    if quaternion[3] < 0.0:
        quaternion = -quaternion
    rotation = matrix_from_quaternion(turn)
    covariance = rotation @ known.covariance_rad2 @ rotation.T + added_rad2
    # Rounding must not make it asymmetric.
    covariance = 0.5 * (covariance + covariance.T)
    return Known(tai_ns, quaternion / np.linalg.norm(quaternion), covariance)


def _quaternions(rotation_vectors_rad: Vector) -> Vector:
    """The quaternions (n, 4) of the rotations exp(-[theta x]) for rotation vectors theta (n, 3)."""
    half = 0.5 * np.linalg.norm(rotation_vectors_rad, axis=1, keepdims=True)
    vector = 0.5 * np.sinc(half / np.pi) * rotation_vectors_rad
    return np.hstack([vector, np.cos(half)])


def _compose(after: Vector, before: Vector) -> Vector:
    """The quaternions (n, 4) of the products A(after) A(before)."""
    a, b = after[:, :3], before[:, :3]
    ac, bc = after[:, 3:], before[:, 3:]
    vector = ac * b + bc * a - np.cross(a, b)
    return np.hstack([vector, ac * bc - (a * b).sum(axis=1, keepdims=True)])


def _product(quaternions: Vector) -> Vector:
    """Quaternion (4,) of the product of all rotations, the last one leftmost, taken in pairs."""
    while len(quaternions) > 1:
        odd = quaternions[-1:] if len(quaternions) % 2 else quaternions[:0]
        even = len(quaternions) - len(odd)
        pairs = _compose(quaternions[1:even:2], quaternions[0:even:2])
        quaternions = np.vstack([pairs, odd])
    product: Vector = quaternions[0]
    return product
