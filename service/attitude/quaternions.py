"""Compiled functions for quaternions (scalar last, inertial to body), matrices, small rotations.

theta is a rotation vector about the body axes, in radians, such as the error of an attitude:
A_true = A(theta) A, where A(theta) = exp(-[theta x]).
"""

import math

from service.compiled.jit import njit_no_refcount


@njit_no_refcount
def to_matrix(q, a):  # type: ignore[no-untyped-def]
    """Write the attitude matrix A(q) of a quaternion into `a` (3, 3)."""
    q1, q2, q3, qc = q[0], q[1], q[2], q[3]
    a[0, 0] = q1 * q1 - q2 * q2 - q3 * q3 + qc * qc
    a[0, 1] = 2 * (q1 * q2 + q3 * qc)
    a[0, 2] = 2 * (q1 * q3 - q2 * qc)
    a[1, 0] = 2 * (q1 * q2 - q3 * qc)
    a[1, 1] = -q1 * q1 + q2 * q2 - q3 * q3 + qc * qc
    a[1, 2] = 2 * (q2 * q3 + q1 * qc)
    a[2, 0] = 2 * (q1 * q3 + q2 * qc)
    a[2, 1] = 2 * (q2 * q3 - q1 * qc)
    a[2, 2] = -q1 * q1 - q2 * q2 + q3 * q3 + qc * qc


@njit_no_refcount
def to_quaternion(a, q):  # type: ignore[no-untyped-def]
    """Write the quaternion of an attitude matrix into `q`, qc >= 0, by Shepperd's method."""
    trace = a[0, 0] + a[1, 1] + a[2, 2]
    if trace >= a[0, 0] and trace >= a[1, 1] and trace >= a[2, 2]:
        q[0], q[1], q[2] = a[1, 2] - a[2, 1], a[2, 0] - a[0, 2], a[0, 1] - a[1, 0]
        q[3] = 1.0 + trace
    elif a[0, 0] >= a[1, 1] and a[0, 0] >= a[2, 2]:
        q[0], q[1] = 1.0 + a[0, 0] - a[1, 1] - a[2, 2], a[0, 1] + a[1, 0]
        q[2], q[3] = a[0, 2] + a[2, 0], a[1, 2] - a[2, 1]
    elif a[1, 1] >= a[2, 2]:
        q[0], q[1] = a[0, 1] + a[1, 0], 1.0 - a[0, 0] + a[1, 1] - a[2, 2]
        q[2], q[3] = a[1, 2] + a[2, 1], a[2, 0] - a[0, 2]
    else:
        q[0], q[1] = a[0, 2] + a[2, 0], a[1, 2] + a[2, 1]
        q[2], q[3] = 1.0 - a[0, 0] - a[1, 1] + a[2, 2], a[0, 1] - a[1, 0]
    normalise(q)


@njit_no_refcount
def normalise(q):  # type: ignore[no-untyped-def]
    """Scale a quaternion to norm one in place, with qc >= 0."""
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[3] < 0.0:
        norm = -norm
    for i in range(4):
        q[i] /= norm


@njit_no_refcount
def turn(q, theta, out):  # type: ignore[no-untyped-def]
    """Write the quaternion of A(theta) A(q) into `out` (4,), which may be q."""
    angle = math.sqrt(theta[0] * theta[0] + theta[1] * theta[1] + theta[2] * theta[2])
    half = 0.5 * angle
    scale = 0.5 if half < 1e-9 else math.sin(half) / angle
    c, x, y, z = math.cos(half), scale * theta[0], scale * theta[1], scale * theta[2]
    q1, q2, q3, qc = q[0], q[1], q[2], q[3]
    out[0] = c * q1 + qc * x - (y * q3 - z * q2)
    out[1] = c * q2 + qc * y - (z * q1 - x * q3)
    out[2] = c * q3 + qc * z - (x * q2 - y * q1)
    out[3] = c * qc - (x * q1 + y * q2 + z * q3)
    normalise(out)


@njit_no_refcount
def rotation_between(q, to, theta):  # type: ignore[no-untyped-def]
    """Write the rotation vector theta (3,) with A(to) = A(theta) A(q), at most half a turn."""
    c = q[3] * to[3] + q[0] * to[0] + q[1] * to[1] + q[2] * to[2]
    theta[0] = q[3] * to[0] - to[3] * q[0] + (to[1] * q[2] - to[2] * q[1])
    theta[1] = q[3] * to[1] - to[3] * q[1] + (to[2] * q[0] - to[0] * q[2])
    theta[2] = q[3] * to[2] - to[3] * q[2] + (to[0] * q[1] - to[1] * q[0])
    sine = math.sqrt(theta[0] * theta[0] + theta[1] * theta[1] + theta[2] * theta[2])
    if c < 0.0:
        scale = -2.0 if sine == 0.0 else -2.0 * math.atan2(sine, -c) / sine
    else:
        scale = 2.0 if sine == 0.0 else 2.0 * math.atan2(sine, c) / sine
    for i in range(3):
        theta[i] *= scale
