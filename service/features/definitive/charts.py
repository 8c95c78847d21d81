"""Charts of attitude, rate and standard deviations about the body axes over a period.

Also charts of gyro bias, measured minus smoothed attitudes, and innovations.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from service.attitude.definitive import Integers, MeasuredInnovations, Status
from service.features.definitive.chart_panels import (
    Chart,
    ChartPanel,
    joined_moments,
    marks_of,
    scale_of,
)
from service.features.definitive.kernels.inputs import FilterSettings
from service.features.definitive.period import PARTS, DefinitivePeriod
from service.missions.mission import Tracker
from service.vectors import (
    Vector,
    attitude_matrices,
    rotation_vectors,
    to_ra_dec,
)
from service.web.console.charts.panels import FINE_HEIGHT, Mask, Scale, TimeAxis, Values, band_of
from service.web.console.formatting import level

AXES = ("x", "y", "z")
SMALL_DEG, SMALL_DEG_PER_S = 0.05, 0.005
"""Bounds below which all values of a chart are shown in arcseconds."""


BOUND = 3.0
"""Half width of the drawn error band, in sigmas."""
WIDEST = 2.0
"""Half height of a chart, in multiples of the usual error band."""


def definitive_charts(
    found: DefinitivePeriod, axis: TimeAxis, tracker: Tracker | None = None
) -> list[Chart]:
    """Charts of filtered and smoothed attitudes in a period, in page order; empty ones are left
    out.

    With a tracker the first chart shows the direction of its boresight.
    """
    drawn = [] if tracker is None else [direction_chart(found, axis, tracker)]
    drawn += [_attitude(found, axis), _rate(found, axis), _sigma(found, axis)]
    if found.innovations is not None and len(found.innovations):
        drawn.append(_differences(found.innovations, axis))
    return [*(each for each in drawn if each), *_bias(found, axis)]


def _joins(found: DefinitivePeriod, axis: TimeAxis) -> Mask:
    is_gyro = found.is_gyro
    same = np.append(False, is_gyro[1:] == is_gyro[:-1])[: len(is_gyro)]
    return joined_moments(found.samples["smoothed"].tai_ns, axis, PARTS, same)


def _known(status: Integers) -> Mask:
    return np.asarray(~np.isin(status, (Status.NONE, Status.LOST)))


def _by_grade(found: DefinitivePeriod, name: str) -> dict[str, Vector]:
    """Values (n, ...) of filtered and smoothed attitudes by grade, NaN without an attitude."""
    return {
        grade: np.where(_known(each.status)[:, None], getattr(each, name), np.nan)
        for grade, each in found.samples.items()
    }


def direction_chart(found: DefinitivePeriod, axis: TimeAxis, tracker: Tracker) -> Chart | None:
    """Chart of a boresight's right ascension, declination and roll; lines break at 360 degrees."""
    samples = found.samples["smoothed"]
    known = _known(samples.status)
    if not known.any():
        return None
    # Rows are the tracker's axes in inertial components.
    axes = tracker.body_from_tracker.T @ attitude_matrices(samples.quaternion)
    ra_deg, dec_deg = to_ra_dec(axes[:, 2])
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    north = np.column_stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    east = np.column_stack([-np.sin(ra), np.cos(ra), np.zeros(len(ra))])
    up = axes[:, 1]
    roll = np.arctan2(np.sum(up * east, axis=1), np.sum(up * north, axis=1))
    joins = _joins(found, axis)
    panels, rows = [], []
    for name, value in (("RA", ra_deg), ("Dec", dec_deg), ("roll", np.degrees(roll) % 360.0)):
        shown = np.where(known, value, np.nan)
        wrapped = np.abs(np.diff(shown, prepend=shown[:1])) > 180.0
        scale = replace(scale_of({"smoothed": shown}) or Scale(0.0, 360.0), height=FINE_HEIGHT)
        trace = Values(samples.tai_ns, shown, joins & ~wrapped).trace("smoothed", axis, scale)
        low, high = f"{level(scale.low)}°", f"{level(scale.high)}°"
        rows.append((name, low, high))
        panels.append(ChartPanel(name, (trace,), "", "", (), f"{low} to {high}", scale, "°"))
    return Chart(
        "direction",
        f"Boresight of {tracker.name}; roll: position angle of its +Y, from north through east",
        tuple(panels),
        ("angle", "least", "greatest"),
        tuple(rows),
        height=FINE_HEIGHT,
    )


def _attitude(found: DefinitivePeriod, axis: TimeAxis) -> Chart | None:
    """Chart of the rotation since the first good smoothed attitude, or else the first known one."""
    samples = found.samples["smoothed"]
    known = _known(samples.status)
    if not known.any():
        return None
    first = int(np.argmax(samples.status == Status.GOOD)) or int(np.argmax(known))
    turned = rotation_vectors(samples.quaternion[first], samples.quaternion)
    turned[~known] = np.nan
    joins = _joins(found, axis)
    # Beyond half a turn the shorter way round begins on the other side.
    jump = np.max(np.abs(np.diff(turned, axis=0, prepend=turned[:1])), axis=1) > np.pi / 2
    degrees = np.degrees(turned)
    is_small = np.nanmax(np.abs(degrees)) < SMALL_DEG
    unit, scale = ("″", 3600.0) if is_small else ("°", 1.0)
    return _lines(
        "attitude",
        "Attitude: turn from the first one of the period",
        unit,
        {"smoothed": degrees * scale},
        found,
        axis,
        joins & ~jump,
    )


def _rate(found: DefinitivePeriod, axis: TimeAxis) -> Chart | None:
    # Without a gyro the rate is not measured: until it is confirmed it is only the first guess.
    rates: dict[str, Vector] = {
        grade: np.where((found.is_gyro | (each.status == Status.GOOD))[:, None], rate, np.nan)
        for (grade, each), rate in zip(
            found.samples.items(), _by_grade(found, "rate_deg_per_s").values(), strict=True
        )
    }
    if not any(np.isfinite(each).any() for each in rates.values()):
        return None
    largest = max(float(np.nanmax(np.abs(each))) for each in rates.values())
    unit, scale = ("″/s", 3600.0) if largest < SMALL_DEG_PER_S else ("°/s", 1.0)
    rates = {grade: each * scale for grade, each in rates.items()}
    return _lines("rate", "Rate", unit, rates, found, axis, _joins(found, axis))


def _sigma(found: DefinitivePeriod, axis: TimeAxis) -> Chart | None:
    """Chart of the attitude's standard deviation by grade, on a logarithmic scale.

    The scale fits good attitudes; other values, as after a start, may lie far outside and are drawn
    at the edge.
    """
    by_grade = {
        grade: np.sqrt(np.maximum(each[:, [0, 3, 5]], 0.0))
        for grade, each in _by_grade(found, "covariance_arcsec2").items()
    }
    joins = _joins(found, axis)
    met = found.innovations
    not_good = {grade: each.status != Status.GOOD for grade, each in found.samples.items()}
    panels, rows = [], []
    for k, name in enumerate(AXES):
        values = {grade: each[:, k] for grade, each in by_grade.items()}
        raw = None
        if met is not None and len(met):
            raw = Values(met.tai_ns, np.sqrt(met.measured_arcsec2[:, (0, 3, 5)[k]]))
            values["raw"] = raw.value
        good = values | {
            grade: np.where(without, np.nan, values[grade]) for grade, without in not_good.items()
        }
        scale = scale_of(good, is_log=True) or scale_of(values, is_log=True)
        if scale is None:
            return None
        times = found.samples["smoothed"].tai_ns
        traces = [] if raw is None else [raw.trace("raw", axis, scale)]
        traces += [
            Values(times, by_grade[grade][:, k], joins).trace(grade, axis, scale)
            for grade in found.samples
        ]
        medians = {grade: f"{level(_median(each))}″" for grade, each in values.items()}
        cells = tuple(medians.get(grade, "–") for grade in ("raw", *found.samples))
        rows.append((name, *cells))
        note = f"{level(scale.low)} to {level(scale.high)}″, logarithmic"
        panels.append(ChartPanel(name, tuple(traces), "", "", (), note, scale, "″"))
    columns = ("axis", *(f"median of {grade}" for grade in ("raw", *found.samples)))
    return Chart("sigma", "One σ of the attitude, by grade", tuple(panels), columns, tuple(rows))


def _differences(met: MeasuredInnovations, axis: TimeAxis) -> Chart:
    """Chart of measured minus smoothed attitudes with bounds; unused measurements are marked."""
    return bounded_chart(
        "difference",
        "Raw minus smoothed attitude",
        met,
        met.difference_arcsec,
        met.difference_sigma_arcsec,
        axis,
    )


def bounded_chart(
    id: str,
    title: str,
    met: MeasuredInnovations,
    value_arcsec: Vector,
    sigma_arcsec: Vector,
    axis: TimeAxis,
) -> Chart:
    """Chart of values (m, 3) as dots within a band of three sigmas.

    The scale fits the usual band and the used values: other values are marked at the edge, and
    after a gap the band may leave the chart.
    """
    used = met.is_used
    joins = joined_moments(met.tai_ns, axis, PARTS, np.arange(len(used)) > 0)
    panels, rows = [], []
    for k, name in enumerate(AXES):
        value, bound = value_arcsec[:, k], BOUND * sigma_arcsec[:, k]
        known = used & np.isfinite(value) & np.isfinite(bound)
        most = WIDEST * _median(bound[known])
        largest = min(most, _largest(np.append(np.abs(value[known]), bound[known]))) or 1.0
        scale = Scale(-largest, largest)
        dots = Values(met.tai_ns[used], value[used]).trace("raw", axis, scale)
        beyond = int(np.count_nonzero(np.abs(value[known]) > bound[known]))
        share = value[known] / np.where(bound[known] > 0.0, bound[known] / BOUND, np.nan)
        rms = float(np.sqrt(np.nanmean(share**2))) if known.any() else float("nan")
        mean = float(np.mean(value[known])) if known.any() else float("nan")
        rows.append(
            (
                name,
                f"{level(mean)}″" if np.isfinite(mean) else "–",
                f"{level(_median(bound) / BOUND)}″",
                f"{level(rms)}" if np.isfinite(rms) else "–",
                f"{beyond} of {int(known.sum())}",
                str(int(np.count_nonzero(~used))),
            )
        )
        panels.append(
            ChartPanel(
                name,
                (dots,),
                band_of(met.tai_ns, -bound, bound, joins, axis, scale),
                marks_of(met.tai_ns[~used], value[~used], axis, scale),
                (int(scale.y(np.zeros(1))[0]),),
                f"to ±{level(largest)}″, 3σ {level(_median(bound))}″",
                scale,
                "″",
            )
        )
    columns = ("axis", "mean", "median σ", "rms over σ", "beyond 3σ", "not used")
    return Chart(id, title, tuple(panels), columns, tuple(rows))


def _bias(found: DefinitivePeriod, axis: TimeAxis) -> list[Chart]:
    """Charts of the gyro bias with its standard deviation; none at a constant rate."""
    bias = _by_grade(found, "bias_deg_per_h")
    sigma = _by_grade(found, "bias_sigma_deg_per_h")
    if not np.isfinite(bias["smoothed"]).any():
        return []
    times = found.samples["smoothed"].tai_ns
    joins = _joins(found, axis)
    panels, rows = [], []
    for k, name in enumerate(AXES):
        best, width = bias["smoothed"][:, k], sigma["smoothed"][:, k]
        usual = _median(width[np.isfinite(best)])
        inner = scale_of({"low": best - usual, "high": best + usual}) or Scale(-1.0, 1.0)
        traces = [
            Values(times, bias[grade][:, k], joins).trace(grade, axis, inner) for grade in bias
        ]
        area = band_of(times, best - width, best + width, joins, axis, inner)
        note = f"{level(float(np.nanmin(best)))} to {level(float(np.nanmax(best)))}°/h"
        note += f", σ {level(usual)}°/h"
        panels.append(ChartPanel(name, tuple(traces), area, "", (), note, inner, "°/h"))
        of_filter = _median(sigma["filtered"][:, k])
        cells = f"{level(_median(best))}°/h", f"{level(usual)}°/h", f"{level(of_filter)}°/h"
        rows.append((name, *cells))
    columns = ("axis", "median", "median σ, smoothed", "median σ, filtered")
    return [Chart("bias", "Bias of the gyro", tuple(panels), columns, tuple(rows))]


def _lines(
    id: str,
    title: str,
    unit: str,
    values: dict[str, Vector],
    found: DefinitivePeriod,
    axis: TimeAxis,
    joins: Mask,
) -> Chart:
    times = found.samples["smoothed"].tai_ns
    panels, rows = [], []
    for k, name in enumerate(AXES):
        own = {grade: each[:, k] for grade, each in values.items()}
        scale = scale_of(own) or Scale(-1.0, 1.0)
        traces = [
            Values(times, each, joins).trace(grade, axis, scale) for grade, each in own.items()
        ]
        low, high = f"{level(scale.low)}{unit}", f"{level(scale.high)}{unit}"
        rows.append((name, low, high))
        panels.append(ChartPanel(name, tuple(traces), "", "", (), f"{low} to {high}", scale, unit))
    return Chart(id, title, tuple(panels), ("axis", "least", "greatest"), tuple(rows))


def _largest(values: Vector) -> float:
    return float(np.max(values, initial=0.0))


def _median(values: Vector) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0


DEGREES = 3
INSIDE = 0.95
"""Probability that chi-square lies between its two lower limits, if covariances are right."""


@lru_cache(maxsize=1)
def chi_square_bounds() -> tuple[float, float, float]:
    """Limits of chi-square: both ends of the 95 % region, and the limit of rejection."""
    # Imported here: loading it takes longer than drawing the page.
    from scipy.special import chdtri

    tail = (1.0 - INSIDE) / 2.0
    gate = FilterSettings().gate_tail
    low, high, most = (float(chdtri(DEGREES, each)) for each in (1.0 - tail, tail, gate))
    return low, high, most


def innovation_charts(met: MeasuredInnovations, axis: TimeAxis) -> list[Chart]:
    """Charts of innovations about the body axes, and of their chi-square."""
    known = met.taken(np.isfinite(met.nis))
    if not len(known):
        return []
    sigma = known.innovation_sigma_arcsec
    return [
        bounded_chart(
            "innovation",
            "Innovations: measured minus predicted attitude",
            known,
            known.innovation_arcsec,
            sigma,
            axis,
        ),
        _chi_square(known, axis),
    ]


def _chi_square(met: MeasuredInnovations, axis: TimeAxis) -> Chart:
    low, high, gate = chi_square_bounds()
    used = met.is_used
    scale = Scale(low / 4.0, gate * 2.0, is_log=True)
    inside = int(np.count_nonzero((met.nis[used] >= low) & (met.nis[used] <= high)))
    count = int(np.count_nonzero(used))
    mean = float(met.nis[used].mean()) / DEGREES if count else 0.0
    panel = ChartPanel(
        "χ²",
        (Values(met.tai_ns[used], met.nis[used]).trace("raw", axis, scale),),
        "",
        marks_of(met.tai_ns[~used], met.nis[~used], axis, scale),
        tuple(scale.y(np.array([low, high, gate])).tolist()),
        f"lines at {level(low)} and {level(high)} (95 %) and at {level(gate)} (gate); logarithmic",
        scale,
        "",
    )
    share = f"{100.0 * inside / count:.1f} %" if count else "–"
    row = ("χ²", level(mean), share, str(int(np.count_nonzero(~used))))
    columns = ("", "mean by degree, about 1", "inside 95 %", "not used")
    return Chart("chi-square", "Chi-square of each measurement", (panel,), columns, (row,))
