"""Quaternions and attitude matrices, compiled; scalar last, inertial to body."""

import math

from service.compiled.jit import njit_no_refcount


@njit_no_refcount
def to_matrix(q, a):  # type: ignore[no-untyped-def]
    """A(q) into a (3, 3)."""
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
    """The quaternion of an attitude matrix, qc >= 0, by Shepperd's largest component."""
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
    """Scale a quaternion to norm one, with qc >= 0."""
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[3] < 0.0:
        norm = -norm
    for i in range(4):
        q[i] /= norm
