"""Charts of attitude, rate and standard deviations about the body axes over a period."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.storage.queries.period import PeriodAttitudes
from service.times import Utc
from service.vectors import ARCSEC_PER_RADIAN, Vector, rotation_vectors
from service.web.console.charts.panels import HEIGHT, WIDTH, Mask, Scale, TimeAxis, Values, band_of

AXES = ("x", "y", "z")
LARGEST_STEP_S = 600.0
"""Greatest time in seconds between two attitudes from which a rate is computed."""
GAP = 3.0
"""Greatest time between joined attitudes, as a multiple of their median time."""
LEAST_BAND = 1.5
"""Width in units of the narrowest visible band of one sigma to either side."""
SMALL_DEG, SMALL_DEG_PER_S = 0.05, 0.005
"""Limits below which a chart of attitudes or rates uses arcseconds."""


@dataclass(frozen=True)
class Panel:
    """Panel for one axis: line, band of one sigma to either side, dots, marks if suspect."""

    axis: str
    line: str
    band: str
    dots: str
    suspect: str
    low: float
    high: float
    farthest: float | None
    """Farthest value of a suspect attitude beyond the others; None if there is none."""
    median_sigma: float | None


@dataclass(frozen=True)
class AttitudeChart:
    """Chart of three panels; `has_band` is true if a band is wide enough to be seen."""

    id: str
    title: str
    unit: str
    panels: tuple[Panel, ...]
    count: int
    has_band: bool
    width: int = WIDTH
    height: int = HEIGHT


@dataclass(frozen=True, eq=False)
class _Values:
    """Values (n, 3) with times and sigmas; `joins` marks those joined with the previous one."""

    time_ns: npt.NDArray[np.int64]
    value: Vector
    sigma: Vector | None
    is_suspect: Mask
    joins: Mask

    @property
    def fits(self) -> Mask:
        """Mask of the values that set the scale: all but suspect ones, which may be anywhere."""
        return self.is_suspect if self.is_suspect.all() else ~self.is_suspect


def attitude_charts(attitudes: PeriodAttitudes, start: Utc, end: Utc) -> list[AttitudeChart]:
    """Charts of attitude, rate and sigma, without those that have no value.

    The attitude is the rotation from the first good one.  The rate is that between neighbouring
    attitudes, at the middle of their time.
    """
    axis = TimeAxis(start, end)
    known = np.isfinite(attitudes.quaternion[:, 0])
    if not known.any():
        return []
    time_ns, quaternion = attitudes.time_ns[known], attitudes.quaternion[known]
    sigma = _sigma_rad(attitudes.covariance_arcsec2[known])
    is_suspect = np.array([each == "suspect" for each in attitudes.status])[known]
    # Neighbours: with no other batch between them, not even one without an attitude.
    follows = (attitudes.follows & np.roll(known, 1))[known]
    follows[0] = False
    reference = quaternion[int(np.argmin(is_suspect))]
    turned = rotation_vectors(reference, quaternion)
    joins = follows & _is_near(time_ns, follows)
    # Beyond half a turn the shorter way round begins on the other side.
    joins[1:] &= np.max(np.abs(np.diff(turned, axis=0)), axis=1) < np.pi / 2
    drawn = [_chart("attitude", _Values(time_ns, turned, sigma, is_suspect, joins), axis)]
    rates = _rates(time_ns, quaternion, sigma, is_suspect, follows)
    if len(rates.time_ns):
        drawn.append(_chart("rate", rates, axis))
    sigmas = _Values(time_ns, sigma, None, is_suspect, joins)
    return [*drawn, _chart("sigma", sigmas, axis)]


def _sigma_rad(covariance_arcsec2: Vector) -> Vector:
    squares = np.diagonal(covariance_arcsec2, axis1=1, axis2=2)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)) / ARCSEC_PER_RADIAN)


def _is_near(time_ns: npt.NDArray[np.int64], follows: Mask) -> Mask:
    """Mask of the times that follow the previous one as closely as is usual."""
    step = np.diff(time_ns, prepend=time_ns[0])
    usual = float(np.median(step[follows])) if follows.any() else 0.0
    return np.asarray(step <= GAP * usual)


def _rates(
    time_ns: npt.NDArray[np.int64],
    quaternion: Vector,
    sigma: Vector,
    is_suspect: Mask,
    follows: Mask,
) -> _Values:
    step_s = np.diff(time_ns, prepend=time_ns[0]) * 1e-9
    own = np.flatnonzero(follows & (step_s > 0.0) & (step_s <= LARGEST_STEP_S))
    before, step = own - 1, step_s[own][:, None]
    middle_ns = time_ns[before] + (time_ns[own] - time_ns[before]) // 2
    joins = np.diff(own, prepend=-2) == 1
    return _Values(
        middle_ns,
        rotation_vectors(quaternion[before], quaternion[own]) / step,
        np.hypot(sigma[before], sigma[own]) / step,
        is_suspect[before] | is_suspect[own],
        joins & _is_near(middle_ns, joins) if len(own) else joins,
    )


_TITLES = {
    "attitude": "Attitude: turn from the first one of the period",
    "rate": "Rate between neighbouring batches",
    "sigma": "Standard deviation of the attitude",
}


def _chart(id: str, values: _Values, time: TimeAxis) -> AttitudeChart:
    unit, scale = _unit(id, values.value[values.fits])
    panels = tuple(_panel(axis, values, time, scale, from_zero=id == "sigma") for axis in range(3))
    return AttitudeChart(
        id=id,
        title=f"{_TITLES[id]}, about the body axes",
        unit=unit,
        panels=panels,
        count=len(values.time_ns),
        has_band=any(panel.band for panel in panels),
    )


def _unit(id: str, values: Vector) -> tuple[str, float]:
    """Unit of a chart, and the value of one radian in it."""
    degrees = float(np.degrees(np.max(np.abs(values))))
    if id == "sigma":
        return "″", ARCSEC_PER_RADIAN
    if id == "rate":
        is_small = degrees < SMALL_DEG_PER_S
        return ("″/s", ARCSEC_PER_RADIAN) if is_small else ("°/s", np.degrees(1.0))
    return ("″", ARCSEC_PER_RADIAN) if degrees < SMALL_DEG else ("°", np.degrees(1.0))


def _panel(axis: int, values: _Values, time: TimeAxis, unit: float, *, from_zero: bool) -> Panel:
    value = values.value[:, axis] * unit
    sigma = np.zeros_like(value) if values.sigma is None else values.sigma[:, axis] * unit
    fits = values.fits
    low = 0.0 if from_zero else float(np.min((value - sigma)[fits]))
    scale = Scale(low, float(np.max((value + sigma)[fits])))
    beyond = value[(value < scale.low) | (value > scale.high)]
    drawn = Values(values.time_ns, value, values.joins).trace("", time, scale)
    is_wide = float(np.max(sigma[fits])) / scale.range_with_room * HEIGHT > LEAST_BAND
    x, at = time.x(values.time_ns[values.is_suspect]), scale.y(value[values.is_suspect])
    at = np.clip(at, 9, HEIGHT - 6)
    return Panel(
        axis=AXES[axis],
        line=drawn.line,
        band=band_of(values.time_ns, value - sigma, value + sigma, values.joins, time, scale)
        if is_wide
        else "",
        dots=drawn.dots,
        suspect="".join(
            f"M{a} {b - 9}l8 15h-16z" for a, b in zip(x.tolist(), at.tolist(), strict=True)
        ),
        low=float(np.min(value[fits])),
        high=float(np.max(value[fits])),
        farthest=float(beyond[np.argmax(np.abs(beyond))]) if len(beyond) else None,
        median_sigma=None if values.sigma is None else float(np.median(sigma)),
    )
