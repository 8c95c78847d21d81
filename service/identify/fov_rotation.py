"""Van Bezooijen's test of the field of view's rotation, which the prototype left out.

A candidate pair says how the tracker would have to be turned for the observed
pair to fall on it.  The part of that turn that is about the boresight must be
small, for the roll of the tracker is known better than where it points.

In a cap that part is what remains when the boresight has gone the short way.
In a band the rotation about the pole is open: there it is the angle, seen along
the turned boresight, between the pole and where the turn would put it.
"""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def rotation_rad(first, second, a, b, boresight, axis, is_band):  # type: ignore[no-untyped-def]
    """The rotation about the boresight, 0 to pi, if `first` is candidate `a` and `second` is `b`.

    All are unit vectors (3,), inertial through the a priori attitude.
    """
    observed, candidate = np.empty((3, 3)), np.empty((3, 3))
    _frame(first, second, observed)
    _frame(a, b, candidate)
    turned = candidate.T @ (observed @ boresight)
    if is_band:
        expected, found = axis, candidate.T @ (observed @ axis)
    else:
        # What lies across the boresight, carried the short way to where the boresight comes.
        across = observed[1] - (observed[1] @ boresight) * boresight
        share = (across @ turned) / (1.0 + boresight @ turned)
        expected = across - share * (boresight + turned)
        found = candidate.T @ (observed @ across)
    sine = _triple(turned, expected, found)
    cosine = expected @ found - (expected @ turned) * (found @ turned)
    return abs(math.atan2(sine, cosine))


@njit(cache=True, nogil=True, inline="always")
def _frame(first, second, out):  # type: ignore[no-untyped-def]
    """Rows: the middle of two unit vectors, the direction from one to the other, their normal."""
    out[0] = first + second
    out[1] = second - first
    out[0] /= math.sqrt(out[0] @ out[0])
    out[1] /= math.sqrt(out[1] @ out[1])
    out[2, 0] = out[0, 1] * out[1, 2] - out[0, 2] * out[1, 1]
    out[2, 1] = out[0, 2] * out[1, 0] - out[0, 0] * out[1, 2]
    out[2, 2] = out[0, 0] * out[1, 1] - out[0, 1] * out[1, 0]


@njit(cache=True, nogil=True, inline="always")
def _triple(u, v, w):  # type: ignore[no-untyped-def]
    """The triple product u . (v x w)."""
    return (
        u[0] * (v[1] * w[2] - v[2] * w[1])
        + u[1] * (v[2] * w[0] - v[0] * w[2])
        + u[2] * (v[0] * w[1] - v[1] * w[0])
    )
