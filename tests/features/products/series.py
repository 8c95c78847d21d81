"""Series of attitudes, as the records would give them."""

import math

import numpy as np

from service.ephemerides.rows import AttitudeRows
from service.features.products.attitude_formats import write_attitudes
from service.features.products.attitudes import SeriesInfo, series_of
from service.times import parse_utc, shifted

ABOUT = SeriesInfo("XTE", "live", "2026-01-01T00:00:00.000Z", "0.2.0")
START = "1996-01-10T12:00:00.000Z"
GOLDEN = [0.0, 0.0, math.sin(math.radians(15.0)), math.cos(math.radians(15.0))]
"""The axes turned by +30 deg about Z."""


def texts(values):
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column


def rows(quaternions, times=START, *, step_s=1.0, status="good", rates=None):
    """Rows of attitudes at the times, or from one on; a status of None is a batch without one."""
    quaternions = np.array(quaternions, dtype=float).reshape(-1, 4)
    n = len(quaternions)
    if isinstance(times, str):
        times = [shifted(parse_utc(times), step_s * k) for k in range(n)]
    statuses = [status] * n if status is None or isinstance(status, str) else status
    known = np.array([[1.0 if each else math.nan] for each in statuses])
    return AttitudeRows(
        time_ns=np.array([each.tai_ns for each in times], dtype=np.int64),
        time=texts([each.text for each in times]),
        id=texts([f"{each.tai_ns:026d}" for each in times]),
        batch=texts([f"b-{each.tai_ns}" for each in times]),
        status=texts(statuses),
        method=texts(["quest" if each else None for each in statuses]),
        quaternion=quaternions * known,
        covariance_arcsec2=np.tile([1.5, 0.1, 0.2, 2.5, 0.3, 30.0], (n, 1)) * known,
        rate_deg_per_s=np.full((n, 3), math.nan) if rates is None else np.array(rates, dtype=float),
        residual_rms_arcsec=known[:, 0] * 1.25,
        predicted_rms_arcsec=known[:, 0] * 1.5,
        stars=np.tile([9, 6, 2, 1], (n, 1)),
        model=texts([None] * n),
        revision=np.zeros(n, dtype=np.int64),
        bias_deg_per_h=np.full((n, 3), math.nan),
        bias_sigma_deg_per_h=np.full((n, 3), math.nan),
    )


def random_quaternions(rng, n):
    """Attitudes all over, at most 60 deg apart from one to the next; qc >= 0, as recorded.

    The first and some others have a scalar near zero.
    """
    from service.vectors import turned_quaternion

    q = np.empty((n, 4))
    last = rng.normal(size=4) * [1.0, 1.0, 1.0, 1e-9]
    for k in range(n):
        turn = rng.normal(size=3)
        turn *= rng.uniform(0.0, 0.5) / np.linalg.norm(turn)
        last = turned_quaternion(last, turn) if k else last
        if abs(last[3]) < 0.2 * np.linalg.norm(last):
            last[3] *= 1e-9
        last /= np.linalg.norm(last)
        q[k] = last
    return np.where(q[:, 3:] < 0, -q, q)


def slew(n, step_s=1.0, rate_deg_per_s=(0.3, -0.5, 0.8), begin=(0.1, 0.2, 0.3)):
    """Quaternions of a body that turns at a constant rate, qc >= 0, as recorded."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(np.radians(rate_deg_per_s) * step_s * np.arange(n)[:, None])
    # scipy rotates vectors: the body's turns come last, in its own axes.
    q = (Rotation.from_rotvec(begin) * turn).as_quat()
    return np.where(q[:, 3:] < 0, -q, q)


def series(*pages, about=ABOUT):
    return series_of(about, pages)


def whole(*pages, about=ABOUT):
    """The blocks of a series, drawn together."""
    blocks = list(series(*pages, about=about).blocks)
    joined = blocks[0]
    for each in blocks[1:]:
        joined = joined.followed_by(each)
    return joined


def written(name, *pages, about=ABOUT):
    return b"".join(write_attitudes(name, series(*pages, about=about)))
