"""Extraction of stars from the line sums of a raster (report on star images, 7.8).

Columns give the h of the stars and rows their v, unpaired. The report's pattern constant needs no
pairs; an attitude does. A star has the same light in its columns as in its rows, by which pairs are
found.
"""

import math
from typing import NamedTuple

import numpy as np

from service.errors import BadBatch, Fault, shown_value
from service.missions.scan import Raster
from service.observations.scans.lines import BREAKDOWN_RATIO, line_peaks, moment
from service.vectors import Vector

SAME_LIGHT_SIGMAS = 4.0
SAME_LIGHT_SHARE = 0.02
"""Largest difference of a star's light in columns and in rows, as a share of the light."""
NOISE_SIGMAS = 2.0
"""Difference of light in sigmas that noise alone often causes, and no hidden star."""


class LinePlace(NamedTuple):
    """A star along one axis of a raster: its place in lines from the first one, and its light."""

    line: float
    sigma_lines: float
    light_counts: float
    sigma_light_counts: float


class RasterStars(NamedTuple):
    """Stars of a raster, brightest first: angles and sigmas (n, 2) along h and v, light (n,)."""

    angles_deg: Vector
    sigma_arcsec: Vector
    light_counts: Vector


def raster_stars(columns: Vector, rows: Vector, scan: Raster, field: str) -> RasterStars:
    """The stars of a raster whose column and row can be paired without ambiguity.

    Stars are left out if they overlap another star's lines, lie at the edge, or have light that
    fits several columns or rows. Raises `BadBatch` naming `field` for a number of lines other than
    the mission's, and for saturated lines.
    """
    along_h = _places(columns, scan.columns, scan, f"{field}.column_counts")
    along_v = _places(rows, scan.rows, scan, f"{field}.row_counts")
    pairs = sorted(_pairs(along_h, along_v), key=lambda pair: -pair[0].light_counts)
    middles = scan.middle("h"), scan.middle("v")
    angles = [[(place.line - m) for place, m in zip(pair, middles, strict=True)] for pair in pairs]
    hidden = [_hidden_shift_lines(*pair, scan.half_width_lines) for pair in pairs]
    sigmas = [
        [math.hypot(place.sigma_lines, shift) for place in pair]
        for pair, shift in zip(pairs, hidden, strict=True)
    ]
    light = [0.5 * (h.light_counts + v.light_counts) for h, v in pairs]
    return RasterStars(
        np.array(angles).reshape(-1, 2) * scan.step_deg,
        np.array(sigmas).reshape(-1, 2) * scan.step_deg * 3600.0,
        np.array(light),
    )


def _places(counts: Vector, lines: int, scan: Raster, field: str) -> list[LinePlace]:
    if len(counts) != lines:
        raise BadBatch(Fault(field, f"has {len(counts)} lines; the raster has {lines}"))
    if scan.saturation_counts is not None:
        full = np.flatnonzero(counts >= scan.saturation_counts)
        if len(full):
            at = int(full[0])
            message = f"is full: a line saturates at {scan.saturation_counts:g} counts"
            raise BadBatch(Fault(f"{field}.{at}", message, shown_value(float(counts[at]))))
    light = counts - scan.background_counts
    per_count = 0.0 if scan.gain_e_per_count is None else 1.0 / scan.gain_e_per_count
    variance = scan.noise_counts**2 + counts * per_count
    # The noise of a line without a star.
    noise = math.sqrt(scan.noise_counts**2 + scan.background_counts * per_count)
    peaks = np.round(line_peaks(light, scan.threshold_sigma * noise)).astype(np.intp)
    half = scan.half_width_lines
    places = []
    for k, peak in enumerate(peaks.tolist()):
        others = np.abs(np.delete(peaks, k) - peak)
        if peak < half or peak + half >= lines or (others <= 2 * half).any():
            continue
        around = slice(peak - half, peak + half + 1)
        found = moment(light[around], variance[around])
        if found.signal_ratio >= BREAKDOWN_RATIO:
            place = peak + found.displacement, math.sqrt(found.variance)
            places.append(LinePlace(*place, found.total, math.sqrt(found.total_variance)))
    return places


def _hidden_shift_lines(h: LinePlace, v: LinePlace, half_width_lines: int) -> float:
    """The largest shift, in lines, of a star along one axis by another star hidden beside it.

    The hidden star's light is in the sum of one axis only; it lies within the half width.
    """
    noise = math.hypot(h.sigma_light_counts, v.sigma_light_counts)
    more = max(0.0, abs(h.light_counts - v.light_counts) - NOISE_SIGMAS * noise)
    return half_width_lines * more / min(h.light_counts, v.light_counts)


def _pairs(along_h: list[LinePlace], along_v: list[LinePlace]) -> list[tuple[LinePlace, LinePlace]]:
    """Pairs of a column's and a row's place with equal light, where each fits only the other."""
    light, sigma = (
        [np.array([place[k] for place in along]) for along in (along_h, along_v)] for k in (2, 3)
    )
    apart = np.abs(light[0][:, None] - light[1][None, :])
    allowed = SAME_LIGHT_SIGMAS * np.hypot(sigma[0][:, None], sigma[1][None, :])
    same = apart <= allowed + SAME_LIGHT_SHARE * np.maximum(light[0][:, None], light[1][None, :])
    alone = same & (same.sum(axis=1, keepdims=True) == 1) & (same.sum(axis=0) == 1)
    return [(along_h[i], along_v[j]) for i, j in np.argwhere(alone).tolist()]
