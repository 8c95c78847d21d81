"""Geometry of the picture of a star field: positions, sizes, arrows and labels in pixels.

The picture is the tracker's tangent plane, h to the right and v upwards, as
the tracker sees the sky.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from service.storage.queries.star_field import Boresight, ObservedStarPlace, TrackerField
from service.web.console.charts.focal_plane import cut, longest_drawn, round_below

SIZE = 640
"""Width and height of the picture, in pixels."""
LONGEST_ARROW = 70.0
"""Length of the longest residual arrow, in pixels."""
MARK_RADIUS = 13.0
"""Radius of the mark about an observed star; a triangle's corners reach slightly farther."""


# Positions of numbers and names in the picture of a star field, without overlaps.
#
# Every text is placed at the first free position about its star, close ones first.  The size of
# the text is estimated, slightly larger than browsers draw it.

Place = tuple[float, float]
Box = tuple[float, float, float, float]
"""Box in a picture: left, top, right and bottom, in pixels."""
Circle = tuple[float, float, float]
"""Circle in a picture: centre and radius, in pixels."""

GAPS = (14.0, 22.0, 32.0, 44.0, 60.0)
"""Distances in pixels from a star to its label, the nearest first."""
ASIDE = 0.75
"""Part of the gap used if the label is placed diagonally from its star."""
ABOUT_NUMBERS = ((-1, -1), (1, -1), (-1, 1), (1, 1), (-1, 0), (1, 0), (0, -1), (0, 1))
ABOUT_NAMES = ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))
"""Directions from a star for its label, to the right and downwards, the best first."""
ANCHORS = {-1: "end", 0: "middle", 1: "start"}
EDGE = 3.0
"""Least distance in pixels of a label from the edge of the picture."""
MOST = 200
"""Greatest number of placed labels: more would fill the picture, and take seconds."""
CELL = 2.0
"""Size in pixels of the cells of the map of occupied places."""


@dataclass(frozen=True)
class Font:
    """Font of labels: width of a character and height of a line, in pixels."""

    character: float
    height: float


NUMBER = Font(9.4, 16.0)
NAME = Font(7.2, 14.5)


@dataclass(frozen=True)
class Label:
    """Placed text with the position of its baseline; `anchor` as SVG's `text-anchor`."""

    text: str
    x: float
    y: float
    anchor: str
    box: Box


class Labels:
    """Labels of one picture, placed one after the other on a map of occupied cells.

    What is taken is kept as a map of the picture.
    """

    def __init__(
        self, size: float, marks: Iterable[Circle], taken: Iterable[Box], lines: Iterable[Place]
    ) -> None:
        """Keep labels off the `marks` and the `taken` boxes, and off the `lines` if possible."""
        self._size = size
        self._count = 0
        cells = math.ceil(size / CELL)
        self._taken = np.zeros((cells, cells), dtype=np.bool_)
        self._lines = np.zeros((cells, cells), dtype=np.bool_)
        down, right = np.mgrid[:cells, :cells] * CELL + CELL / 2
        for x, y, radius in marks:
            near = _cells((x - radius, y - radius, x + radius, y + radius))
            inside = np.hypot(right[near] - x, down[near] - y) < radius
            self._taken[near] |= inside
        for box in taken:
            self._taken[_cells(box)] = True
        for x, y in lines:
            self._lines[_cells((x, y, x, y))] = True

    def number(self, text: str, at: Place) -> Label:
        """Place a number, over another one if all places are occupied."""
        first = next(_places(text, at, NUMBER, ABOUT_NUMBERS))
        return self._take(self._free(_places(text, at, NUMBER, ABOUT_NUMBERS)) or first)

    def name(self, text: str, at: Place) -> Label | None:
        """Place a name; None if there is no room, since the table has the name by its number."""
        found = self._free(_places(text, at, NAME, ABOUT_NAMES))
        return found and self._take(found)

    def _take(self, label: Label) -> Label:
        self._taken[_cells(label.box)] = True
        self._count += 1
        return label

    def _free(self, places: Iterable[Label]) -> Label | None:
        if self._count >= MOST:
            return None
        first = None
        for each in places:
            if self._is_free(each.box):
                first = first or each
                if not self._lines[_cells(each.box)].any():
                    return each
        return first

    def _is_free(self, box: Box) -> bool:
        is_inside = min(box[:2]) >= EDGE and max(box[2:]) <= self._size - EDGE
        return is_inside and not self._taken[_cells(box)].any()


def text_box(text: str, x: float, y: float, font: Font = NAME) -> Box:
    """Box covered by a text whose baseline begins at a position."""
    top = y - 0.8 * font.height
    return x, top, x + font.character * len(text), top + font.height


def points_along(start: Place, end: Place) -> list[Place]:
    """Points along a line at most five pixels apart."""
    (x1, y1), (x2, y2) = start, end
    count = 1 + int(max(abs(x2 - x1), abs(y2 - y1)) / 5.0)
    return [(x1 + (x2 - x1) * k / count, y1 + (y2 - y1) * k / count) for k in range(count + 1)]


def _places(
    text: str, at: Place, font: Font, directions: Sequence[tuple[int, int]]
) -> Iterator[Label]:
    width, height = font.character * len(text), font.height
    for gap in GAPS:
        for right, down in directions:
            away = gap * (ASIDE if right and down else 1.0)
            # Half of the text on either side, or all of it on one side.
            left = at[0] + right * away + (right - 1) / 2 * width
            top = at[1] + down * away + (down - 1) / 2 * height
            x = left + (1 - right) / 2 * width
            box = (left, top, left + width, top + height)
            yield Label(text, x, top + 0.8 * height, ANCHORS[right], box)


def _cells(box: Box) -> tuple[slice, slice]:
    """Cells that a box touches, up to the edge of the picture."""
    left, top, right, bottom = (max(0, math.floor(each / CELL)) for each in box)
    return slice(top, bottom + 1), slice(left, right + 1)


AXES: tuple[Box, ...] = (
    (SIZE - 30.0, SIZE / 2 - 20.0, SIZE, SIZE / 2 - 2.0),
    (SIZE / 2, 0.0, SIZE / 2 + 34.0, 18.0),
)
"""Boxes covered by the names of the chart's axes."""


@dataclass(frozen=True)
class CatalogStar:
    """Catalog star of the zone on a chart; `role`: chosen for an observed star, rival, or none."""

    id: str
    magnitude: float
    x: float
    y: float
    radius: float
    role: str


@dataclass(frozen=True)
class ChartLine:
    """Straight line between two positions of the picture."""

    x1: float
    y1: float
    x2: float
    y2: float
    is_cut: bool = False


@dataclass(frozen=True)
class ObservedStar:
    """Observed star with its number, residual arrow, and lines to rivals."""

    number: int
    outcome: str
    star: str | None
    magnitude: float | None
    x: float
    y: float
    arrow: ChartLine | None
    head: str
    residual_arcsec: float | None
    is_cut: bool
    """True if the residual is longer than its arrow."""
    rivals: tuple[ChartLine, ...]
    label: Label


@dataclass(frozen=True)
class Ring:
    """Circle of the grid with its label."""

    radius: float
    label: str

    @property
    def label_at(self) -> tuple[float, float]:
        """Position where the label begins: at the top of the circle."""
        return SIZE / 2 + 3, SIZE / 2 - self.radius - 3


@dataclass(frozen=True)
class SkyChart:
    """Picture of one tracker's field; an arrow of `key_px` represents `key_arcsec`."""

    tracker: str
    boresight: Boresight
    field_of_view: Ring
    rings: tuple[Ring, ...]
    edges: tuple[str, ...]
    catalog: tuple[CatalogStar, ...]
    observed: tuple[ObservedStar, ...]
    names: tuple[Label, ...]
    key_arcsec: float
    key_px: float
    magnitudes: tuple[tuple[int, float], ...]
    through: str
    size: int = SIZE


@dataclass(frozen=True)
class _Projection:
    """Gnomonic projection to the pixels of a chart with the radius `radius_deg`."""

    radius_deg: float

    @property
    def scale(self) -> float:
        """Length in pixels of the tangent of 45 degrees."""
        return SIZE / 2 / math.tan(math.radians(self.radius_deg))

    def place(self, h_deg: float, v_deg: float) -> Place:
        """Pixel position of a direction: x to the right, y downwards."""
        x = SIZE / 2 + self.scale * math.tan(math.radians(h_deg))
        return x, SIZE / 2 - self.scale * math.tan(math.radians(v_deg))

    def ring(self, radius_deg: float) -> Ring:
        """Circle of the grid at a radius about the boresight, with its label."""
        return Ring(self.scale * math.tan(math.radians(radius_deg)), f"{radius_deg:g}°")


def sky_chart(tracker: TrackerField, through: str, view: str = "all") -> SkyChart:
    """Chart of one tracker of a star field (see `star_field.star_field_of`).

    `view` is "all", for everything that the answer names, or "field" of view.
    """
    field_deg = tracker.field_of_view_radius_deg
    limit_mag = tracker.magnitude_limit_mag
    projection = _Projection(tracker.radius_deg if view == "all" else field_deg * 1.12)
    catalog = _catalog_stars(tracker, projection)
    named = [star for star in catalog if star.role != "none"]
    places = [projection.place(each.h_deg, each.v_deg) for each in tracker.observed]
    residuals = [each.residual_arcsec for each in tracker.observed]
    longest = longest_drawn([math.hypot(*each) for each in residuals if each])
    px_per_arcsec, key_arcsec = (LONGEST_ARROW / longest if longest else 0.0), round_below(longest)
    arrows = [
        _arrow(place, residual, px_per_arcsec)
        for place, residual in zip(places, residuals, strict=True)
    ]
    rings = tuple(projection.ring(each) for each in _rings(projection.radius_deg, field_deg))
    labels = Labels(
        SIZE,
        marks=[(x, y, MARK_RADIUS) for x, y in places]
        + [(star.x, star.y, star.radius + 6.0) for star in named],
        taken=[*AXES, *(text_box(each.label, *each.label_at) for each in rings)],
        lines=[
            point
            for each in arrows
            if each is not None
            for point in points_along((each.x1, each.y1), (each.x2, each.y2))
        ],
    )
    # Numbers first: the table has a name by its number.
    observed = _observed_stars(tracker.observed, places, arrows, catalog, labels)
    names = [labels.name(star.id, (star.x, star.y)) for star in named]
    brightest = min((star.magnitude for star in catalog), default=limit_mag)
    steps = range(math.ceil(brightest), math.floor(limit_mag) + 1)
    return SkyChart(
        tracker=tracker.tracker,
        boresight=tracker.boresight,
        field_of_view=projection.ring(field_deg),
        rings=rings,
        edges=tuple(
            " ".join("{:.1f},{:.1f}".format(*projection.place(h, v)) for h, v in line)
            for line in tracker.zone_edges
        ),
        catalog=catalog,
        observed=observed,
        names=tuple(each for each in names if each is not None),
        key_arcsec=key_arcsec,
        key_px=key_arcsec * px_per_arcsec,
        magnitudes=tuple((step, star_radius(step, limit_mag)) for step in steps)[-6:],
        through=through,
    )


def _catalog_stars(tracker: TrackerField, projection: _Projection) -> tuple[CatalogStar, ...]:
    roles = {name: "rival" for each in tracker.observed for name in each.rivals}
    roles |= {each.star: "chosen" for each in tracker.observed if each.star}
    return tuple(
        CatalogStar(
            star.id,
            star.magnitude,
            *projection.place(star.h_deg, star.v_deg),
            star_radius(star.magnitude, tracker.magnitude_limit_mag),
            roles.get(star.id, "none"),
        )
        for star in tracker.catalog
    )


def _observed_stars(
    observed: Sequence[ObservedStarPlace],
    places: Sequence[Place],
    arrows: Sequence[ChartLine | None],
    catalog: Sequence[CatalogStar],
    labels: Labels,
) -> tuple[ObservedStar, ...]:
    at = {star.id: (star.x, star.y) for star in catalog}
    return tuple(
        ObservedStar(
            number,
            each.outcome,
            each.star,
            each.magnitude,
            x,
            y,
            arrow,
            "" if arrow is None else _head(arrow),
            math.hypot(*each.residual_arcsec) if each.residual_arcsec else None,
            arrow is not None and arrow.is_cut,
            tuple(ChartLine(x, y, *at[name]) for name in each.rivals if name in at),
            labels.number(str(number), (x, y)),
        )
        for number, (each, (x, y), arrow) in enumerate(
            zip(observed, places, arrows, strict=True), start=1
        )
    )


def _arrow(
    place: Place, residual_arcsec: Sequence[float] | None, px_per_arcsec: float
) -> ChartLine | None:
    if not residual_arcsec or not px_per_arcsec:
        return None
    (x, y), (along_h, along_v) = place, residual_arcsec
    along, down, is_cut = cut(along_h * px_per_arcsec, -along_v * px_per_arcsec, LONGEST_ARROW)
    return ChartLine(x, y, x + along, y + down, is_cut)


def star_radius(magnitude_mag: float, limit_mag: float) -> float:
    """Radius of a star's disc in pixels: 0.9 px more per magnitude; the faintest stay visible."""
    return min(9.0, 1.3 + 0.9 * max(0.0, limit_mag - magnitude_mag))


def _rings(radius_deg: float, field_deg: float) -> list[float]:
    """Up to four round radii within the picture, apart from the edge of the field of view."""
    steps = (0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
    step = next((each for each in steps if radius_deg / each <= 4.0), 20.0)
    count = int(radius_deg / step)
    return [step * k for k in range(1, count + 1) if abs(step * k - field_deg) > step / 4]


def _head(arrow: ChartLine) -> str:
    """Corner points of an arrow's head, as text for an SVG polygon; empty without a length."""
    length = math.hypot(arrow.x2 - arrow.x1, arrow.y2 - arrow.y1)
    if length == 0.0:
        return ""
    u, v = (arrow.x2 - arrow.x1) / length, (arrow.y2 - arrow.y1) / length
    back, wide = min(8.0, length), min(3.2, length * 0.4)
    x, y = arrow.x2 - u * back, arrow.y2 - v * back
    corners = ((arrow.x2, arrow.y2), (x - v * wide, y + u * wide), (x + v * wide, y - u * wide))
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in corners)
