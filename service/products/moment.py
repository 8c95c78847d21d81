"""The attitude at a moment: the nearest one, or one interpolated within a stretch."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from service.errors import NotFound
from service.products import attitudes
from service.products.reading.known import between
from service.times import Utc
from service.vectors import full_matrices

AtMethod = Literal["nearest", "interpolated"]


@dataclass(frozen=True)
class AttitudeAt:
    """The attitude at a moment, with its error.

    `covariance_arcsec2` (3, 3) is that of the measured attitudes, about the body axes.
    `motion_arcsec` is the error that the motion adds: of the nearest attitude the angle that the
    body turns until the moment; between two attitudes, an eighth of the step times the change of
    the rate.  None where no rate is known.  `ids` names the results it is made of.
    """

    time: str
    method: AtMethod
    quaternion: list[float]
    covariance_arcsec2: list[list[float]]
    motion_arcsec: float | None
    offset_s: float
    """From the moment to the nearest attitude that was used."""
    ids: list[str]


def attitude_at(
    about: attitudes.SeriesInfo,
    pages: Iterable[attitudes.AttitudeRows],
    moment: Utc,
    method: AtMethod,
) -> AttitudeAt:
    """The attitude at a moment, from the rows around it in order of time.

    Raises `NotFound` where none is within the largest gap, or where the moment lies between two
    stretches and is to be interpolated.
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
    if not 0 < after < len(rows) or rows.stretch[after] != rows.stretch[after - 1]:
        raise _not_found(about, moment, "it lies within no stretch")
    return _interpolated(rows, after, moment)


def _not_found(about: attitudes.SeriesInfo, moment: Utc, why: str) -> NotFound:
    return NotFound(f"{about.described()} at {moment.text}: {why} ({about.largest_gap_s:g} s)")


def _nearest(
    rows: attitudes.AttitudeBlock, place: int, moment: Utc, method: AtMethod
) -> AttitudeAt:
    offset_s = float(rows.time_ns[place] - moment.tai_ns) * 1e-9
    rate = float(np.linalg.norm(rows.rate_deg_per_s[place])) * 3600.0
    motion = None if np.isnan(rate) else rate * abs(offset_s)
    return AttitudeAt(
        moment.text,
        method,
        rows.quaternion[place].tolist(),
        full_matrices(rows.covariance_arcsec2[place]).tolist(),
        0.0 if offset_s == 0.0 else motion,
        offset_s,
        [str(rows.id[place])],
    )


def _interpolated(rows: attitudes.AttitudeBlock, after: int, moment: Utc) -> AttitudeAt:
    pair = [after - 1, after]
    first_ns, second_ns = rows.time_ns[pair].tolist()
    share = (moment.tai_ns - first_ns) / (second_ns - first_ns)
    q = between(rows.quaternion[[after - 1]], rows.quaternion[[after]], np.array([share]))[0]
    one, other = rows.covariance_arcsec2[pair]
    # The errors of two batches are independent.  Those of a filter's samples are not: whatever
    # their correlation, the weighted mean of the covariances is no less than that of the mean.
    weights = (1.0 - share, share) if rows.revision[after] else ((1.0 - share) ** 2, share**2)
    change = float(np.linalg.norm(np.diff(rows.rate_deg_per_s[pair], axis=0))) * 3600.0
    step_s = (second_ns - first_ns) * 1e-9
    offset_s = min((first_ns, second_ns), key=lambda ns: abs(ns - moment.tai_ns)) - moment.tai_ns
    return AttitudeAt(
        moment.text,
        "interpolated",
        q.tolist(),
        full_matrices(weights[0] * one + weights[1] * other).tolist(),
        None if np.isnan(change) else change * step_s / 8.0,
        offset_s * 1e-9,
        list(dict.fromkeys(str(each) for each in rows.id[pair])),
    )
