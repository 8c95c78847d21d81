"""The TRIAD method, compiled, with its covariance and the choice of vector pairs.

b are observed unit vectors in body axes, r the reference vectors in inertial
axes, weights are sigma^-2 with sigma in radians.
"""

import math

from service.compiled.jit import njit_no_refcount

LEAST_SINE = 1e-12
"""Least sine of the angle between two vectors that are not collinear."""


@njit_no_refcount
def sine(a, b):  # type: ignore[no-untyped-def]
    """The sine of the angle between two unit vectors."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    z = a[0] * b[1] - a[1] * b[0]
    return math.sqrt(x * x + y * y + z * z)


@njit_no_refcount
def widest_pair(b, r, weights):  # type: ignore[no-untyped-def]
    """The rows of the vector pair with the largest sine, the smaller sigma first, and that sine.

    The sine is that of the references, which have no noise: the widest observed pair would be
    biased. Two stars with the same identity have a sine of zero.
    """
    first, second, widest = 0, 1, 0.0
    for i in range(len(r) - 1):
        for j in range(i + 1, len(r)):
            apart = sine(r[i], r[j])
            if apart > widest and sine(b[i], b[j]) > LEAST_SINE:
                first, second, widest = i, j, apart
    if weights[second] > weights[first]:
        first, second = second, first
    return first, second, widest


@njit_no_refcount
def firmest_pair(b, r, weights):  # type: ignore[no-untyped-def]
    """The rows of the most accurate star, and of the star that best fixes the rotation about it.

    The second star has the largest weight times sine^2.
    """
    first, second, firmest = 0, 0, 0.0
    for i in range(len(b)):
        if weights[i] > weights[first]:
            first = i
    for j in range(len(b)):
        firmness = weights[j] * sine(b[first], b[j]) ** 2
        if firmness > firmest and sine(r[first], r[j]) > LEAST_SINE:
            second, firmest = j, firmness
    return first, second


@njit_no_refcount
def _triad_frame(anchor, other):  # type: ignore[no-untyped-def]
    """The second and third axis of a frame whose first axis is the anchor."""
    x = anchor[1] * other[2] - anchor[2] * other[1]
    y = anchor[2] * other[0] - anchor[0] * other[2]
    z = anchor[0] * other[1] - anchor[1] * other[0]
    norm = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / norm, y / norm, z / norm
    third = (
        anchor[1] * z - anchor[2] * y,
        anchor[2] * x - anchor[0] * z,
        anchor[0] * y - anchor[1] * x,
    )
    return (x, y, z), third


@njit_no_refcount
def triad(b1, b2, r1, r2, attitude):  # type: ignore[no-untyped-def]
    """Write the matrix that maps r1 to b1, and r2 into the plane of b1 and b2 (Black 1964)."""
    body2, body3 = _triad_frame(b1, b2)
    inertial2, inertial3 = _triad_frame(r1, r2)
    for i in range(3):
        for j in range(3):
            attitude[i, j] = b1[i] * r1[j] + body2[i] * inertial2[j] + body3[i] * inertial3[j]


@njit_no_refcount
def triad_covariance(b1, b2, variance1, variance2, covariance):  # type: ignore[no-untyped-def]
    """Covariance (3, 3) of TRIAD's attitude, body axes, to first order (Shuster & Oh 1981).

    It includes the noise of b1 along both of its tangent axes and that of b2 across the plane, but
    not that of b2 in the plane.
    """
    cosine = b1[0] * b2[0] + b1[1] * b2[1] + b1[2] * b2[2]
    sine2 = sine(b1, b2) ** 2
    along, beside = (variance2 - variance1) / sine2, variance1 * cosine / sine2
    for i in range(3):
        for j in range(3):
            covariance[i, j] = along * b1[i] * b1[j] + beside * (b1[i] * b2[j] + b2[i] * b1[j])
        covariance[i, i] += variance1
