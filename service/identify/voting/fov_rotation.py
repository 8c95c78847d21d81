"""Van Bezooijen's test of the field of view's rotation, which the prototype left out.

A candidate pair says how the tracker would have to be turned for the observed
pair to fall on it.  The part of that turn that is about the boresight must be
small, for the roll of the tracker is known better than where it points.

In a cap that part is what remains when the boresight has gone the short way.
In a band the rotation about the pole is open: there it is the angle, seen along
the turned boresight, between the pole and where the turn would put it.
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
    """The rotation about the boresight, 0 to pi, if `first` is candidate `a` and `second` is `b`.

    All are unit vectors, inertial through the a priori attitude, of whose arrays
    the first three numbers are read.  It is worked out in plain numbers, so that
    it neither allocates nor can fail.
    """
    observed, candidate = _frame(first, second), _frame(a, b)
    looking = boresight[0], boresight[1], boresight[2]
    turned = _carried(looking, observed, candidate)
    if is_band:
        pole = axis[0], axis[1], axis[2]
        expected, found = pole, _carried(pole, observed, candidate)
    else:
        # What lies across the boresight, carried the short way to where the boresight comes.
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
    """The middle of two unit vectors, the direction from one to the other, and their normal."""
    middle = first[0] + second[0], first[1] + second[1], first[2] + second[2]
    along = second[0] - first[0], second[1] - first[1], second[2] - first[2]
    middle, along = _unit(middle), _unit(along)
    return middle, along, _cross(middle, along)


@njit_no_refcount
def _carried(v: Triple, observed: Axes, candidate: Axes) -> Triple:
    """The vector, turned as the observed frame is turned to the candidate's."""
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
