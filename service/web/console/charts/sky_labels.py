"""Where numbers and names stand in the picture of a star field: none over another one.

Every text is put at the first free place about its star, close ones first.  The
text's size is estimated, a little larger than browsers draw it.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

Place = tuple[float, float]
Box = tuple[float, float, float, float]
"""Left, top, right, bottom."""
Circle = tuple[float, float, float]
"""Centre and radius."""

GAPS = (14.0, 22.0, 32.0, 44.0, 60.0)
"""Pixels from a star to its text, the nearest first."""
ASIDE = 0.75
"""Of the gap, where the text stands diagonally from its star."""
ABOUT_NUMBERS = ((-1, -1), (1, -1), (-1, 1), (1, 1), (-1, 0), (1, 0), (0, -1), (0, 1))
ABOUT_NAMES = ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))
"""Directions from a star, to the right and downwards, the best first."""
ANCHORS = {-1: "end", 0: "middle", 1: "start"}
EDGE = 3.0
"""Pixels that a text stays away from the edge of the picture."""
MOST = 200
"""Labels for which a place is looked for: more fill the picture, and would take seconds."""
CELL = 2.0
"""Pixels of a cell of the map of what is taken."""


@dataclass(frozen=True)
class Font:
    """The size of a text, in pixels."""

    character: float
    height: float


NUMBER = Font(9.4, 16.0)
NAME = Font(7.2, 14.5)


@dataclass(frozen=True)
class Label:
    """A text with the place of its baseline; `anchor` as SVG's `text-anchor`."""

    text: str
    x: float
    y: float
    anchor: str
    box: Box


class Labels:
    """The labels of one picture, placed one after the other.

    What is taken is kept as a map of the picture.
    """

    def __init__(
        self, size: float, marks: Iterable[Circle], taken: Iterable[Box], lines: Iterable[Place]
    ) -> None:
        """Labels keep off the `marks` and what is `taken`, and off the `lines` if possible."""
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
        """The place of a number, which must stand somewhere: over another one if all is full."""
        first = next(_places(text, at, NUMBER, ABOUT_NUMBERS))
        return self._take(self._free(_places(text, at, NUMBER, ABOUT_NUMBERS)) or first)

    def name(self, text: str, at: Place) -> Label | None:
        """The place of a name; None where there is none, since the table has it by its number."""
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
    """The box of a text that begins at the place of its baseline."""
    top = y - 0.8 * font.height
    return x, top, x + font.character * len(text), top + font.height


def points_along(start: Place, end: Place, step: float = 5.0) -> list[Place]:
    """Points of a line."""
    (x1, y1), (x2, y2) = start, end
    count = 1 + int(max(abs(x2 - x1), abs(y2 - y1)) / step)
    return [(x1 + (x2 - x1) * k / count, y1 + (y2 - y1) * k / count) for k in range(count + 1)]


def _places(
    text: str, at: Place, font: Font, directions: Sequence[tuple[int, int]]
) -> Iterator[Label]:
    width, height = font.character * len(text), font.height
    for gap in GAPS:
        for right, down in directions:
            away = gap * (ASIDE if right and down else 1.0)
            # A half of the text on either side, or all of it on one.
            left = at[0] + right * away + (right - 1) / 2 * width
            top = at[1] + down * away + (down - 1) / 2 * height
            x = left + (1 - right) / 2 * width
            box = (left, top, left + width, top + height)
            yield Label(text, x, top + 0.8 * height, ANCHORS[right], box)


def _cells(box: Box) -> tuple[slice, slice]:
    """The cells that a box lies in, those that it touches included; none beyond the edge."""
    left, top, right, bottom = (max(0, math.floor(each / CELL)) for each in box)
    return slice(top, bottom + 1), slice(left, right + 1)
