"""Small rotations of attitudes, compiled.

theta is the error of an attitude as a rotation vector about the body axes, in
radians: A_true = A(theta) A, where A(theta) = exp(-[theta x]).
"""

import math

from service.attitude.quaternions import normalise
from service.compiled.jit import njit_no_refcount


@njit_no_refcount
def turn(q, theta, out):  # type: ignore[no-untyped-def]
    """The quaternion of A(theta) A(q) into `out` (4,), which may be q."""
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
    """The rotation vector theta (3,) with A(to) = A(theta) A(q), of at most half a turn."""
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
