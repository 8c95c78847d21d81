"""Van Bezooijen's test of the field of view's rotation, which the paper's prototype left out.

A candidate pair implies a rotation of the tracker that maps the observed pair to it. The part of
that rotation about the boresight must be small, since the tracker's roll is known better than its
pointing.

In a cap that part is what remains after the shortest rotation of the boresight. In a band the
rotation about the pole is free: the part is the angle, seen along the rotated boresight, between
the pole and the rotated pole.
"""

import math

from service.compiled.jit import njit_no_refcount
from service.vectors import Vector

Triple = tuple[float, float, float]
Axes = tuple[Triple, Triple, Triple]


@njit_no_refcount
def rotation_rad(
    first: Vector,
    second: Vector,
    a: Vector,
    b: Vector,
    boresight: Vector,
    axis: Vector,
    is_band: bool,
) -> float:
    """The rotation about the boresight, 0 to pi, that maps the pair `first`, `second` to `a`, `b`.

    All are unit vectors, inertial by the a priori attitude; only the first three numbers of each
    array are read. Plain numbers are used, so that the function neither allocates nor fails.
    """
    observed, candidate = _frame(first, second), _frame(a, b)
    looking = boresight[0], boresight[1], boresight[2]
    turned = _carried(looking, observed, candidate)
    if is_band:
        pole = axis[0], axis[1], axis[2]
        expected, found = pole, _carried(pole, observed, candidate)
    else:
        # A direction perpendicular to the boresight, moved with the boresight's shortest rotation.
        across = _less(observed[1], _dot(observed[1], looking), looking)
        share = _dot(across, turned) / (1.0 + _dot(looking, turned))
        middle = looking[0] + turned[0], looking[1] + turned[1], looking[2] + turned[2]
        expected = _less(across, share, middle)
        found = _carried(across, observed, candidate)
    sine = _dot(turned, _cross(expected, found))
    cosine = _dot(expected, found) - _dot(expected, turned) * _dot(found, turned)
    return abs(math.atan2(sine, cosine))


@njit_no_refcount
def _frame(first: Vector, second: Vector) -> Axes:
    """The three axes of a pair of unit vectors: their middle, their difference, and the normal."""
    middle = first[0] + second[0], first[1] + second[1], first[2] + second[2]
    along = second[0] - first[0], second[1] - first[1], second[2] - first[2]
    middle, along = _unit(middle), _unit(along)
    return middle, along, _cross(middle, along)


@njit_no_refcount
def _carried(v: Triple, observed: Axes, candidate: Axes) -> Triple:
    """A vector after the rotation that turns the axes of the observed pair into the candidate's."""
    x, y, z = _dot(observed[0], v), _dot(observed[1], v), _dot(observed[2], v)
    one, two, three = candidate
    return (
        x * one[0] + y * two[0] + z * three[0],
        x * one[1] + y * two[1] + z * three[1],
        x * one[2] + y * two[2] + z * three[2],
    )


@njit_no_refcount
def _unit(v: Triple) -> Triple:
    norm = math.sqrt(_dot(v, v))
    return v[0] / norm, v[1] / norm, v[2] / norm


@njit_no_refcount
def _less(v: Triple, share: float, w: Triple) -> Triple:
    return v[0] - share * w[0], v[1] - share * w[1], v[2] - share * w[2]


@njit_no_refcount
def _dot(v: Triple, w: Triple) -> float:
    return v[0] * w[0] + v[1] * w[1] + v[2] * w[2]


@njit_no_refcount
def _cross(v: Triple, w: Triple) -> Triple:
    return v[1] * w[2] - v[2] * w[1], v[2] * w[0] - v[0] * w[2], v[0] * w[1] - v[1] * w[0]
