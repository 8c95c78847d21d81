"""Whole sky in an equal-area projection, with boresights of trackers by outcome.

The projection is Hammer's (Hammer 1892; FITS calls it AIT): an ellipse in which equal
areas of the sky have equal areas.  Right ascension grows to the left, as seen from
inside, and 180 deg is in the middle.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import erfa
import numpy as np
import numpy.typing as npt

from service.sky.zones import SearchRegion
from service.storage.queries.period import PeriodStars, TrackerStarsOfPeriod
from service.vectors import Vector, angle_between_deg, from_ra_dec, to_ra_dec, unit

WIDTH, HEIGHT = 720.0, 360.0
EDGE = 14.0
MIDDLE_RA_DEG = 180.0
STEP_DEG = 2.0
GRID_DEG = 30
SUN_POINTS = 24
JOINED_DEG = 20.0
"""Greatest angle between the boresights of neighbouring batches that a line joins."""

Place = tuple[float, float]
Path = str


@dataclass(frozen=True)
class ZoneEdge:
    """The edges of the search zone of a tracker's latest batch."""

    tracker: str
    path: Path


@dataclass(frozen=True)
class Track:
    """Boresights of one tracker on the sky: a line, and marks by outcome."""

    tracker: str
    line: Path
    good: Path
    suspect: Path
    no_attitude: Path
    last: Place | None
    counts: dict[str, int]
    without_place: int
    first_ra_dec_deg: tuple[float, float] | None
    last_ra_dec_deg: tuple[float, float] | None
    least_sun_angle_deg: float | None


@dataclass(frozen=True)
class GridLabel:
    """Label of a right ascension or a declination beside its grid line."""

    text: str
    x: float
    y: float


@dataclass(frozen=True)
class AllSkyChart:
    """Chart of the whole sky: grid, galactic plane, Sun, zones and tracks."""

    outline: Path
    grid: Path
    labels: tuple[GridLabel, ...]
    galactic: Path
    galactic_centre: Place
    sun: Place | None
    sun_path: Path
    zones: tuple[ZoneEdge, ...]
    tracks: tuple[Track, ...]
    points: tuple[tuple[int, int, str], ...]
    """Position in pixels and time of each batch, ordered by time."""
    width: float = WIDTH + 2 * EDGE
    height: float = HEIGHT + 2 * EDGE


def hammer(direction: Vector) -> Vector:
    """Positions (n, 2) in pixels of inertial directions (n, 3); x to the right, y downwards."""
    ra_deg, dec_deg = to_ra_dec(direction)
    return _hammer(np.radians(ra_deg - MIDDLE_RA_DEG), np.radians(dec_deg))


def _hammer(longitude_rad: Vector, latitude_rad: Vector) -> Vector:
    half = longitude_rad / 2.0
    root = np.sqrt(1.0 + np.cos(latitude_rad) * np.cos(half))
    # Each in units of its own half axis, 2 sqrt(2) and sqrt(2).
    across = np.cos(latitude_rad) * np.sin(half) / root
    up = np.sin(latitude_rad) / root
    x = EDGE + WIDTH / 2 - across * WIDTH / 2
    return np.stack([x, EDGE + HEIGHT / 2 - up * HEIGHT / 2], axis=-1)


def all_sky_chart(period: PeriodStars, shown: list[TrackerStarsOfPeriod]) -> AllSkyChart:
    """Chart of the whole sky in a period: tracks of the shown trackers, the Sun and zones."""
    longitudes = np.radians(np.arange(0.0, 360.0 + STEP_DEG, STEP_DEG))
    plane = from_ra_dec(*np.degrees(erfa.g2icrs(longitudes, np.zeros_like(longitudes))))
    centre = from_ra_dec(*np.degrees(erfa.g2icrs(0.0, 0.0)))
    return AllSkyChart(
        outline=_outline(),
        grid=_grid(),
        labels=tuple(_labels()),
        galactic=_line(plane),
        galactic_centre=_place(hammer(centre)),
        sun=_place(hammer(period.sun[-1])) if len(period.sun) else None,
        sun_path=_line(period.sun[:: 1 + len(period.sun) // SUN_POINTS]),
        zones=tuple(
            ZoneEdge(each.tracker, _edges(each.region)) for each in shown if each.region is not None
        ),
        tracks=tuple(_track(period, each) for each in shown),
        points=tuple(_points(period, shown)),
    )


def _points(
    period: PeriodStars, shown: list[TrackerStarsOfPeriod]
) -> Iterator[tuple[int, int, str]]:
    """Positions and times of batches, each from the first tracker with a known boresight."""
    for number, time in enumerate(period.attitudes.time):
        known = [each for each in shown if np.isfinite(each.boresight[number, 0])]
        if known:
            x, y = np.round(hammer(known[0].boresight[number])).tolist()
            yield int(x), int(y), time


def _track(period: PeriodStars, tracker: TrackerStarsOfPeriod) -> Track:
    known = np.isfinite(tracker.boresight[:, 0])
    direction, places = tracker.boresight[known], np.empty((0, 2))
    status = np.array(period.attitudes.status, dtype=object)
    marks = dict.fromkeys(("good", "suspect", "no_attitude"), "")
    first = last = at = least_sun = None
    if len(direction):
        places = hammer(direction)
        shapes = {"good": "h0", "suspect": "m0 -4l4 7h-8z", "no_attitude": "m-3 -3l6 6m0 -6l-6 6"}
        for name, shape in shapes.items():
            marks[name] = _marks(places[status[known] == name], shape)
        ra_deg, dec_deg = to_ra_dec(direction[[0, -1]])
        first, last = zip(ra_deg.tolist(), dec_deg.tolist(), strict=True)
        at = _place(places[-1])
        least_sun = float(np.min(angle_between_deg(direction, period.sun[known])))
    return Track(
        tracker=tracker.tracker,
        line=_joined(direction),
        **marks,
        last=at,
        counts={name: int(np.sum(status == name)) for name in marks},
        without_place=int(np.sum(~known)),
        first_ra_dec_deg=first,
        last_ra_dec_deg=last,
        least_sun_angle_deg=least_sun,
    )


def _marks(places: Vector, shape: str) -> Path:
    """SVG path with a mark of a shape at every position, but only one per pixel."""
    whole = np.unique(np.round(places), axis=0).astype(int).tolist()
    return "".join(f"M{x} {y}{shape}" for x, y in whole)


def _joined(direction: Vector) -> Path:
    if len(direction) < 2:
        return ""
    apart_deg = angle_between_deg(direction[1:], direction[:-1])
    return _line(direction, apart_deg > JOINED_DEG)


def _edges(region: SearchRegion) -> Path:
    """SVG path of the bounds of a zone: one circle for a cap, two for a band."""
    bounds = (region.least_deg, region.most_deg)
    return "".join(_line(_circle(region.axis, each)) for each in bounds if 0.0 < each < 180.0)


def _circle(axis: Vector, angle_deg: float) -> Vector:
    """Unit vectors (n, 3) along the circle at an angle from an axis."""
    first = unit(np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))]))
    second = np.cross(axis, first)
    turn = np.radians(np.arange(0.0, 360.0 + STEP_DEG, STEP_DEG))[:, None]
    across = first * np.cos(turn) + second * np.sin(turn)
    return np.asarray(axis * np.cos(np.radians(angle_deg)) + across * np.sin(np.radians(angle_deg)))


def _outline() -> Path:
    a, b = WIDTH / 2, HEIGHT / 2
    return f"M{EDGE} {EDGE + b}a{a} {b} 0 1 0 {WIDTH} 0a{a} {b} 0 1 0 {-WIDTH} 0z"


def _grid() -> Path:
    # Short of the poles, where every meridian ends, and of the seam, which is the outline.
    along = np.linspace(0.01, 359.99, 61)
    up = np.arange(-90.0, 90.1, 2 * STEP_DEG)
    rows = [from_ra_dec(along, dec_deg) for dec_deg in range(-60, 90, GRID_DEG)]
    columns = [from_ra_dec(ra_deg, up) for ra_deg in range(GRID_DEG, 360, GRID_DEG)]
    return "".join(_line(each) for each in (*rows, *columns))


def _labels() -> list[GridLabel]:
    found = []
    for ra_deg in range(60, 360, 60):
        x, y = _hammer(np.radians(ra_deg - MIDDLE_RA_DEG), np.radians(0.0)).tolist()
        found.append(GridLabel(f"{ra_deg}°", x + 3, y - 4))
    for dec_deg in (-60, -30, 30, 60):
        x, y = _hammer(np.radians(0.0), np.radians(float(dec_deg))).tolist()
        found.append(GridLabel(f"{dec_deg:+d}°".replace("-", "−"), x + 3, y - 4))
    return found


def _place(point: Vector) -> Place:
    x, y = np.asarray(point).tolist()
    return x, y


def _line(direction: Vector, breaks: npt.NDArray[np.bool_] | None = None) -> Path:
    """SVG path through directions, broken at the seam of the projection and at given places.

    `breaks` tells for every direction but the first whether the line begins anew there.
    """
    if len(direction) < 2:
        return ""
    ra_deg, _ = to_ra_dec(direction)
    # The shorter way round from one to the next leads over the seam.
    begins = np.abs(np.diff(ra_deg)) > 180.0
    if breaks is not None:
        begins |= breaks
    steps, before = [], (math.nan, math.nan)
    places = np.round(hammer(direction), 1).tolist()
    for (x, y), is_begin in zip(places, (True, *begins.tolist()), strict=True):
        if is_begin or (x, y) != before:
            steps.append(f"{'M' if is_begin else 'L'}{x:g} {y:g}")
        before = (x, y)
    return "".join(steps)
