"""SVG map of the zones of a mission file."""

from typing import TYPE_CHECKING

import numpy as np

from service.mission_checks.zone_census import ZoneCensus, axes_deg
from service.vectors import Vector, from_ra_dec, to_ra_dec, unit

if TYPE_CHECKING:
    from service.cli.mission_report import MissionReport


PICTURE_WIDTH, MAP_HEIGHT, MAP_HEAD, MAP_FOOT = 960, 480, 34, 46
COLORS = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
"""Colour scale Viridis, dark for small values; also readable with colour blindness."""


def zones_picture(report: "MissionReport") -> str:
    """Draw zones as SVG: pairs by zone axis over the sky, and the richest zone with its stars."""
    height = len(report.zones) * (MAP_HEAD + MAP_HEIGHT + MAP_FOOT)
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {PICTURE_WIDTH} {height}" '
            'font-family="sans-serif" font-size="14" fill="#222">'
        ),
        f'<rect width="{PICTURE_WIDTH}" height="{height}" fill="#fff"/>',
    ]
    for k, zone in enumerate(report.zones):
        parts.append(f'<g transform="translate(0 {k * (MAP_HEAD + MAP_HEIGHT + MAP_FOOT)})">')
        parts += _panel(report, zone)
        parts.append("</g>")
    return "\n".join([*parts, "</svg>", ""])


def _panel(report: "MissionReport", zone: ZoneCensus) -> list[str]:
    ra_deg, dec_deg = axes_deg()
    least, most = zone.spread["pairs"].least, zone.spread["pairs"].most
    half_ra, half_dec = 180.0 / len(ra_deg), 90.0 / len(dec_deg)
    parts = [f'<text x="12" y="22">{report.mission.name}: pairs in a {zone.of} by its axis</text>']
    for row, dec in enumerate(dec_deg):
        for column, ra in enumerate(ra_deg):
            level = (int(zone.pairs[row, column]) - least) / max(1, most - least)
            corners = _projected(
                np.array([ra - half_ra, ra + half_ra, ra + half_ra, ra - half_ra]),
                np.array([dec - half_dec, dec - half_dec, dec + half_dec, dec + half_dec]),
            )
            color = _color(level)
            # The stroke of the same colour closes the seam between neighbours.
            parts.append(
                f'<polygon points="{_star_points(corners)}" fill="{color}" stroke="{color}"/>'
            )
    parts += _richest(report, zone)
    y = MAP_HEAD + MAP_HEIGHT + 14
    for x, text in ((12, "RA 360"), (PICTURE_WIDTH - 52, "RA 0")):
        parts.append(f'<text x="{x}" y="{MAP_HEAD + 14}">{text}</text>')
    for k in range(60):
        parts.append(
            f'<rect x="{12 + 4 * k}" y="{y}" width="4" height="14" fill="{_color(k / 59)}"/>'
        )
    ra, dec = zone.richest_deg()
    note = (
        f"{least:,} to {most:,} pairs; the outline is the zone about RA {ra:.1f}, "
        f"Dec {dec:+.0f} deg, the richest, with its stars"
    )
    return [*parts, f'<text x="264" y="{y + 12}">{note}</text>']


def _richest(report: "MissionReport", zone: ZoneCensus) -> list[str]:
    """SVG outline of the zone with the most pairs, and its stars."""
    axis = from_ra_dec(*zone.richest_deg())
    parts = []
    turn = np.radians(np.linspace(0.0, 360.0, 721))
    first = unit(np.cross(axis, (0.0, 0.0, 1.0)))
    second = np.cross(axis, first)
    for edge_deg in (zone.least_deg, zone.most_deg):
        if not 0.0 < edge_deg < 180.0:
            continue
        angle = np.radians(edge_deg)
        ring = np.cos(angle) * axis + np.sin(angle) * (
            np.outer(np.cos(turn), first) + np.outer(np.sin(turn), second)
        )
        places = _projected(*to_ra_dec(ring))
        # Cut the outline where it leaves the map on one side and re-enters on the other.
        breaks = np.flatnonzero(np.abs(np.diff(places[:, 0])) > PICTURE_WIDTH / 4) + 1
        parts += [
            f'<polyline points="{_star_points(piece)}" fill="none" stroke="#fff" stroke-width="2"/>'
            for piece in np.split(places, breaks)
        ]
    angle_deg = np.degrees(np.arccos(np.clip(report.run_catalog.direction @ axis, -1.0, 1.0)))
    inside = (zone.least_deg <= angle_deg) & (angle_deg <= zone.most_deg)
    places = _projected(report.run_catalog.ra_deg[inside], report.run_catalog.dec_deg[inside])
    parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1" fill="#fff"/>' for x, y in places]
    return parts


def _projected(ra_deg: Vector, dec_deg: Vector) -> Vector:
    """Points (n, 2) on Hammer's equal-area map of the sky, centred on right ascension 180 deg."""
    # Stay slightly inside the edge: 0 and 360 deg are its two sides.
    longitude = np.radians(np.clip(180.0 - ra_deg % 360.01, -179.99, 179.99)) / 2.0
    latitude = np.radians(dec_deg)
    root = np.sqrt(1.0 + np.cos(latitude) * np.cos(longitude))
    x = np.cos(latitude) * np.sin(longitude) / root
    y = np.sin(latitude) / root
    middle, half = PICTURE_WIDTH / 2.0, PICTURE_WIDTH / 2.0 - 12.0
    return np.column_stack([middle + half * x, MAP_HEAD + MAP_HEIGHT / 2.0 * (1.0 - y)])


def _star_points(places: Vector) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in places.tolist())


def _color(level: float) -> str:
    stops = np.linspace(0.0, 1.0, len(COLORS))
    mixed = [
        round(float(np.interp(level, stops, channel))) for channel in zip(*COLORS, strict=True)
    ]
    return "#" + "".join(f"{each:02x}" for each in mixed)
