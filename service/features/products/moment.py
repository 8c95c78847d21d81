"""Attitude at a given time: the nearest one, or one interpolated within an interval."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from service.ephemerides.rows import AttitudeRows
from service.errors import NotFound
from service.features.products import attitudes
from service.interpolation import LARGEST_ERROR_RAD, steps_between
from service.times import Utc
from service.vectors import ARCSEC_PER_RADIAN, full_matrices

AtMethod = Literal["nearest", "interpolated"]


@dataclass(frozen=True)
class AttitudeAt:
    """Attitude at a given time, with its error.

    `covariance_arcsec2` (3, 3) is that of the measured attitudes and of the motion, about the body
    axes.  `motion_arcsec` is the error due to the motion: for the nearest attitude the angle that
    the body turns until the time; between two attitudes, an eighth of the step times the change of
    the rate or, if larger, of the angle by which the rates miss the second attitude; over more than
    a quarter turn the bound of `interpolation`.  None if no rate is known.  `ids` names the results
    used.
    """

    time: str
    method: AtMethod
    quaternion: list[float]
    covariance_arcsec2: list[list[float]]
    motion_arcsec: float | None
    offset_s: float
    """Seconds from the requested time to the nearest attitude that was used."""
    ids: list[str]


def attitude_at(
    about: attitudes.SeriesInfo,
    pages: Iterable[AttitudeRows],
    moment: Utc,
    method: AtMethod,
) -> AttitudeAt:
    """Attitude at a given time, from rows around it in order of time.

    Raises `NotFound` if no attitude is within the largest gap and, for interpolation, if the time
    lies within no interval, or the turn between the neighbouring attitudes is ambiguous.
    """
    blocks = list(attitudes.series_of(about, pages).blocks)
    if not blocks:
        raise _not_found(about, moment, "none is within the largest gap")
    rows = blocks[0]
    for block in blocks[1:]:
        rows = rows.followed_by(block)
    offset_ns = rows.time_ns - moment.tai_ns
    nearest = int(np.argmin(np.abs(offset_ns)))
    if abs(int(offset_ns[nearest])) > about.largest_gap_s * 1e9:
        raise _not_found(about, moment, "none is within the largest gap")
    if method == "nearest" or offset_ns[nearest] == 0:
        return _nearest(rows, nearest, moment, method)
    after = int(np.searchsorted(rows.time_ns, moment.tai_ns))
    if not 0 < after < len(rows) or not attitudes.follows(rows, about.largest_gap_s)[after - 1]:
        raise _not_found(about, moment, "it lies within no stretch")
    found = _interpolated(rows, after, moment)
    if found is None:
        why = "the turn between the attitudes before and after cannot be told from their rates"
        raise _not_found(about, moment, why)
    return found


def _not_found(about: attitudes.SeriesInfo, moment: Utc, why: str) -> NotFound:
    return NotFound(f"{about.described()} at {moment.text}: {why} ({about.largest_gap_s:g} s)")


def _nearest(
    rows: attitudes.AttitudeBlock, place: int, moment: Utc, method: AtMethod
) -> AttitudeAt:
    offset_s = float(rows.time_ns[place] - moment.tai_ns) * 1e-9
    turn = rows.rate_deg_per_s[place] * (offset_s * 3600.0)
    motion = None if np.isnan(turn[0]) else float(np.linalg.norm(turn))
    covariance = full_matrices(rows.covariance_arcsec2[place])
    if motion:
        covariance = covariance + np.outer(turn, turn)
    return AttitudeAt(
        moment.text,
        method,
        rows.quaternion[place].tolist(),
        covariance.tolist(),
        0.0 if offset_s == 0.0 else motion,
        offset_s,
        [str(rows.id[place])],
    )


def _interpolated(rows: attitudes.AttitudeBlock, after: int, moment: Utc) -> AttitudeAt | None:
    """Attitude interpolated between two rows; None if the error due to motion may be too large."""
    pair = [after - 1, after]
    first_ns, second_ns = rows.time_ns[pair].tolist()
    share = np.array([(moment.tai_ns - first_ns) / (second_ns - first_ns)])
    step_s = (second_ns - first_ns) * 1e-9
    known = np.radians(attitudes.known_rates(rows)[pair])
    q = rows.quaternion[pair][:, None]
    steps = steps_between(q[0], q[1], np.array([step_s]), known[:1], known[1:])
    missed = float(np.linalg.norm(steps.missing)) * ARCSEC_PER_RADIAN
    if attitudes.turns_far(rows)[after - 1]:
        motion: float | None = float(steps.error_rad[0]) * ARCSEC_PER_RADIAN
    else:
        # A cubic would add more noise of the rates than accuracy.
        steps = steps_between(q[0], q[1], np.array([step_s]))
        change = float(np.linalg.norm(np.diff(rows.rate_deg_per_s[pair], axis=0))) * 3600.0
        motion = None if np.isnan(change) else max(change * step_s, missed) / 8.0
    if motion is not None and motion > LARGEST_ERROR_RAD * ARCSEC_PER_RADIAN:
        return None
    one, other = rows.covariance_arcsec2[pair]
    # The errors of two batches are independent.  Those of a filter's samples are not: whatever
    # their correlation, the weighted mean of the covariances is no less than that of the mean.
    part = float(share[0])
    weights = (1.0 - part, part) if rows.revision[after] else ((1.0 - part) ** 2, part**2)
    covariance = full_matrices(weights[0] * one + weights[1] * other)
    offset_s = min((first_ns, second_ns), key=lambda ns: abs(ns - moment.tai_ns)) - moment.tai_ns
    return AttitudeAt(
        moment.text,
        "interpolated",
        steps.at(share)[0].tolist(),
        (covariance + np.eye(3) * (motion or 0.0) ** 2).tolist(),
        motion,
        offset_s * 1e-9,
        list(dict.fromkeys(str(each) for each in rows.id[pair])),
    )
