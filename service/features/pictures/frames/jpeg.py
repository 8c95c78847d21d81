"""A check that JPEG data are complete: their codes must end where the data end.

JPEG has no checksum.  A changed bit makes a decoder see one block of 8 x 8 pixels more or less, and
everything after it lies 8 px from its place; libjpeg reports this only where more than about eight
bytes are left over or missing.  This module reads the lengths of all codes, without their values,
and compares to the bit.  Source: ITU-T T.81, annexes B (markers), C, F.2.2 and G.1.2 (codes).
"""

import math
import re
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.features.pictures.frames.frame import bad_frame
from service.features.pictures.kernels import ends_whole

_MARKER = re.compile(rb"\xff+([^\x00\xff])")
_STUFFED = re.compile(rb"\xff+\x00")
_TABLES, _SCAN, _RESTARTS, _END = 0xC4, 0xDA, 0xDD, 0xD9
_BASELINE, _EXTENDED, _PROGRESSIVE = 0xC0, 0xC1, 0xC2
_OTHER_CODINGS = {*range(0xC3, 0xD0)} - {_TABLES}
_BEYOND = 1024
"""Bytes by which a JPEG block may be read beyond its data before the check stops."""
_WINDOW = 1 << 16
"""Number of values of a 16-bit window, which the longest JPEG code fills."""


class _Component(NamedTuple):
    """A JPEG colour component: blocks per unit, size in blocks, and width of the padded grid."""

    across: int
    down: int
    columns: int
    rows: int
    grid_columns: int
    first: int
    """The index of the component's first block among the blocks of all components."""


class _Picture(NamedTuple):
    """A JPEG header: components by id, numbers of units, and true if the coding is progressive."""

    components: dict[int, _Component]
    unit_columns: int
    unit_rows: int
    blocks: int
    is_progressive: bool


def require_whole(data: bytes, max_pixels: int) -> None:
    """Raise `BadFile` for JPEG data whose scans hold more or fewer bits than their blocks need.

    Truncated data or segments raise IndexError or ValueError.
    """
    at, interval = 2, 0
    tables = np.zeros((8, _WINDOW), np.uint16)
    picture: _Picture | None = None
    known = np.zeros(0, np.uint64)
    while (found := _MARKER.match(data, at)) is not None and found[1][0] != _END:
        marker, at = found[1][0], found.end()
        length = int.from_bytes(data[at : at + 2])
        segment, at = data[at + 2 : at + length], at + max(length, 2)
        if marker == _TABLES:
            _read_tables(segment, tables)
        elif marker == _RESTARTS:
            interval = int.from_bytes(segment[:2])
        elif marker in _OTHER_CODINGS:
            raise bad_frame("is a JPEG in lossless or arithmetic coding, which is not read")
        elif marker in (_BASELINE, _EXTENDED, _PROGRESSIVE):
            picture = _read_header(segment, marker == _PROGRESSIVE, max_pixels)
            known = np.zeros(picture.blocks + 1 if picture.is_progressive else 1, np.uint64)
        elif marker == _SCAN:
            if picture is None:
                raise ValueError("a scan before the header")
            parts, at = _parts(data, at)
            if not _is_whole(segment, parts, picture, interval, tables, known):
                raise bad_frame(
                    "is a damaged JPEG: its coded data have not the length that its size needs, "
                    "so that parts of the picture may be moved; send an undamaged copy"
                )
    if found is None:
        raise ValueError("no marker where a segment ends")


def _read_tables(segment: bytes, tables: npt.NDArray[np.uint16]) -> None:
    """Fill the JPEG code tables: for every 16-bit value, length and symbol of its first code."""
    while segment:
        counts, symbols = segment[1:17], segment[17 : 17 + sum(segment[1:17])]
        kind, name = divmod(segment[0], 16)
        if kind > 1 or name > 3:
            raise ValueError("a table of codes of no known kind")
        table = tables[4 * kind + name]
        table[:] = 0
        start, number = 0, 0
        for bits, count in enumerate(counts, 1):
            for symbol in symbols[number : number + count]:
                table[start : start + (_WINDOW >> bits)] = bits << 8 | symbol
                start += _WINDOW >> bits
            number += count
        if start > _WINDOW or number > len(symbols):
            raise ValueError("a table with more codes than there can be")
        segment = segment[17 + number :]


def _read_header(segment: bytes, is_progressive: bool, max_pixels: int) -> _Picture:
    height, width = int.from_bytes(segment[1:3]), int.from_bytes(segment[3:5])
    parts = [segment[at : at + 3] for at in range(6, 6 + 3 * segment[5], 3)]
    sampling = [divmod(part[1], 16) for part in parts]
    largest = max(across for across, _ in sampling), max(down for _, down in sampling)
    if width * height > max_pixels or not all(1 <= n <= 4 for pair in sampling for n in pair):
        raise ValueError(f"a header of {width} x {height} px that is not possible")
    unit_columns, unit_rows = -(-width // (8 * largest[0])), -(-height // (8 * largest[1]))
    components: dict[int, _Component] = {}
    first = 0
    for part, (across, down) in zip(parts, sampling, strict=True):
        # Sizes are rounded up first, then numbers of blocks: T.81, A.1.1 and A.2.
        columns = math.ceil(math.ceil(width * across / largest[0]) / 8)
        rows = math.ceil(math.ceil(height * down / largest[1]) / 8)
        grid_columns = unit_columns * across
        components[part[0]] = _Component(across, down, columns, rows, grid_columns, first)
        first += grid_columns * unit_rows * down
    if len(components) < len(parts):
        raise ValueError("components of one name")
    return _Picture(components, unit_columns, unit_rows, first, is_progressive)


def _parts(data: bytes, at: int) -> tuple[list[tuple[int, bytes]], int]:
    """The coded pieces of a JPEG scan, each with the restart marker before it, and their end."""
    parts: list[tuple[int, bytes]] = []
    before = -1
    for found in _MARKER.finditer(data, at):
        parts.append((before, _STUFFED.sub(b"\xff", data[at : found.start()])))
        if not 0xD0 <= found[1][0] <= 0xD7:
            return parts, found.start()
        before, at = found[1][0] - 0xD0, found.end()
    raise ValueError("no marker behind a scan")


def _is_whole(
    segment: bytes,
    parts: list[tuple[int, bytes]],
    picture: _Picture,
    interval: int,
    tables: npt.NDArray[np.uint16],
    known: npt.NDArray[np.uint64],
) -> bool:
    """True if every restart interval of a JPEG scan has exactly the bits that its blocks need."""
    number = segment[0]
    chosen = [picture.components[segment[1 + 2 * k]] for k in range(number)]
    names = [divmod(segment[2 + 2 * k], 16) for k in range(number)]
    first, last, refines = segment[1 + 2 * number], segment[2 + 2 * number], segment[-1] > 15
    if not picture.is_progressive:
        first, last, refines = 0, 63, False
    elif last > 63 or first > last or (first == 0) != (last == 0) or (first and number > 1):
        raise ValueError("a scan of no known kind")
    columns, rows = picture.unit_columns, picture.unit_rows
    if number == 1:
        # In a scan of its own, a component has only the blocks of its actual size, one per unit.
        columns, rows = chosen[0].columns, chosen[0].rows
        chosen = [chosen[0]._replace(across=1, down=1)]
    units = np.array(
        [
            (each.across, each.down, each.grid_columns, each.first, dc & 3, 4 + (ac & 3))
            for each, (dc, ac) in zip(chosen, names, strict=True)
        ],
        np.int64,
    )
    used = [*(units[:, 4] if first == 0 and not refines else ()), *(units[:, 5] if last else ())]
    if not all(tables[table, 0] for table in used):
        raise ValueError("a scan without its tables of codes")
    total = columns * rows
    step = interval or total
    if [before for before, _ in parts] != [-1, *(k % 8 for k in range(-(-total // step) - 1))]:
        return False
    ends = np.cumsum([len(part) for _, part in parts])
    coded = np.frombuffer(b"".join(part for _, part in parts) + bytes(_BEYOND), np.uint8)
    kind = np.array([first, last, refines, picture.is_progressive], np.int64)
    size = np.array([columns, total, step], np.int64)
    return bool(ends_whole(coded, ends, size, units, kind, tables, known, np.zeros(1, np.int64)))
