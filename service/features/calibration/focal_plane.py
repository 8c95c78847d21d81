"""Chart of a tracker's residuals over its focal plane, before and after a calibration."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from service.features.calibration.records import ResidualCell, ResidualMap
from service.web.console.charts.focal_plane import (
    LEAST_STARS,
    SIZE,
    arrow,
    cut,
    longest_drawn,
    round_below,
)

LONGEST_RESIDUAL = 1.3
"""Length of the longest arrow of a residual chart, in cells."""

Side = Literal["before", "after"]


@dataclass(frozen=True)
class ResidualPicture:
    """Chart of residuals as arrows over a focal plane; `key_arcsec` is drawn `key_px` long."""

    title: str
    tracker: str
    radius_deg: float
    cells: tuple[tuple[float, float, int], ...]
    """Left and upper edge of each cell of the chart, and its number of stars."""
    side: float
    arrows: str
    cut_arrows: str
    """Arrows of residuals that are longer than drawn."""
    key_arcsec: float
    key_px: float
    size: float = SIZE


def residual_pictures(map: ResidualMap) -> tuple[ResidualPicture, ...]:
    """Residual charts: before calibration, after at the same scale, and after with longer arrows.

    A cell with fewer than `LEAST_STARS` stars has no arrow.
    """
    longest = {side: _longest(map.cells, side) for side in ("before", "after")}
    return (
        _picture("before", map, "before", longest["before"]),
        _picture("after, same scale", map, "after", longest["before"]),
        _picture("after, enlarged", map, "after", longest["after"]),
    )


def _of(cell: ResidualCell, side: str) -> Sequence[float]:
    return cell.before_arcsec if side == "before" else cell.after_arcsec


def _longest(cells: Sequence[ResidualCell], side: str) -> float:
    return longest_drawn(
        [math.hypot(*_of(each, side)) for each in cells if each.stars >= LEAST_STARS]
    )


def _picture(title: str, map: ResidualMap, side: Side, longest: float) -> ResidualPicture:
    px_per_deg = SIZE / (2.0 * map.radius_deg)
    cell_px = map.step_deg * px_per_deg
    px_per_arcsec = LONGEST_RESIDUAL * cell_px / longest if longest else 0.0
    cells, arrows = [], {False: "", True: ""}
    for each in map.cells:
        x = (each.h_deg + map.radius_deg) * px_per_deg
        y = SIZE - (each.v_deg + map.radius_deg) * px_per_deg
        cells.append((x - cell_px / 2.0, y - cell_px / 2.0, each.stars))
        if each.stars >= LEAST_STARS:
            h, v = _of(each, side)
            scaled = h * px_per_arcsec, -v * px_per_arcsec
            along, down, is_cut = cut(*scaled, LONGEST_RESIDUAL * cell_px)
            arrows[is_cut] += arrow(x - along / 2.0, y - down / 2.0, along, down)
    key_arcsec = round_below(longest)
    return ResidualPicture(
        title=title,
        tracker=map.tracker,
        radius_deg=map.radius_deg,
        cells=tuple(cells),
        side=cell_px,
        arrows=arrows[False],
        cut_arrows=arrows[True],
        key_arcsec=key_arcsec,
        key_px=key_arcsec * px_per_arcsec,
    )
