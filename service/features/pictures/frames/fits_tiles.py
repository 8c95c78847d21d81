"""Checks of tile-compressed FITS images before a decoder follows their table.

astropy allocates the size that a table's descriptor states, decompresses gzip tiles of any size,
and reads beyond its memory for some settings of Rice. So it gets a file with checked keywords.
Source: FITS Standard 4.0, 7.3.5 (variable-length arrays) and 10.1 (compressed images).
"""

import io
import math
import re
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from service.features.pictures.frames.bounded_file import BoundedFile
from service.features.pictures.frames.fits_header import BLOCK, Header, Unit, write_header
from service.features.pictures.frames.frame import bad_frame

MAX_TILES = 1 << 16
"""Largest number of compressed tiles; a decoder takes about 50 microseconds for each."""
MAX_DEPTH = 3
"""Largest number of planes in a compressed tile: three colours, decompressed at once."""
_SETTINGS = {"BLOCKSIZE": range(1, 1 << 16), "BYTEPIX": (1, 2, 4, 8)}
_COPIED = re.compile(
    r"(PCOUNT|GCOUNT|TFIELDS|THEAP|BSCALE|BZERO|BLANK|ZIMAGE|Z?(NAXIS|BITPIX)|Z?NAXIS\d+|"
    r"(TTYPE|TFORM|ZNAME|ZVAL)\d+|Z(CMPTYPE|QUANTIZ|DITHER0|BLANK|SCALE|ZERO))"
)
_NUMBER_BYTES = 8
"""Size in bytes of the largest number type that a compressed FITS image can have."""
_SPARE_BYTES = 4096
_FORM = re.compile(r"(\d{0,9})([A-Z])(?:([A-Z])\(\d*\))?")
_BYTES = dict(zip("LXBIJKAEDCMPQ", (1, 1, 1, 2, 4, 8, 1, 4, 8, 8, 16, 8, 16), strict=True))
_DESCRIPTORS = {"P": ">i4", "Q": ">i8"}
_GZIP = 31
"""Window parameter of zlib for data with a gzip header."""
_BLOCK_BYTES = 1 << 16


def rewritten(file: BoundedFile, unit: Unit) -> io.BytesIO:
    """A FITS file with the compressed table of one unit, under a header of checked keywords only.

    Raises `BadFile` where a tile lies outside of the data, or decompresses to more than its pixels.
    """
    header = unit.header
    file.seek(unit.start)
    data = file.exactly(header.data_bytes)
    cards: dict[str, bool | int | float | str] = {"XTENSION": "BINTABLE", "BITPIX": 8}
    cards |= {
        key: value
        for key, value in header.cards.items()
        if _COPIED.fullmatch(key) and value is not None
    }
    cards |= _checked(header)
    _require_bounded(header, data, math.prod(tile_of(header)))
    result = io.BytesIO()
    write_header(result, {"SIMPLE": True, "BITPIX": 8, "NAXIS": 0, "EXTEND": True})
    write_header(result, cards)
    result.write(data.ljust(-(-len(data) // BLOCK) * BLOCK, b"\0"))
    return result


def tile_of(header: Header) -> list[int]:
    """The sides of an image's compressed tiles, none longer than the image; raises `BadFile`."""
    axes = header.image_axes
    sides = []
    for number, length in enumerate(axes, 1):
        # The default tile is one row of the image (10.1.1).
        side = header.whole(f"ZTILE{number}", length if number == 1 else 1)
        sides.append(min(side, length) if side else length)
    if math.prod(sides[2:]) > MAX_DEPTH:
        message = f"has compressed tiles of more than {MAX_DEPTH} planes"
        raise bad_frame(message, " x ".join(str(side) for side in sides[:6]))
    return sides


def _checked(header: Header) -> dict[str, bool | int | float | str]:
    """The header cards that control a decoder's memory accesses; raises `BadFile` for bad ones."""
    cards: dict[str, bool | int | float | str] = {
        f"ZTILE{number}": side for number, side in enumerate(tile_of(header), 1)
    }
    for number in range(1, 1000):
        if f"ZNAME{number}" not in header.cards:
            break
        allowed = _SETTINGS.get(str(header.cards[f"ZNAME{number}"]).upper())
        if allowed is not None and header.whole(f"ZVAL{number}") not in allowed:
            value = str(header.cards[f"ZVAL{number}"])
            raise bad_frame(f"has a FITS header with an impossible ZVAL{number}", value[:40])
    for key, least, most in (("ZDITHER0", 0, 10_000), ("TFIELDS", 1, 999), ("NAXIS", 2, 2)):
        if not least <= header.whole(key, least) <= most:
            value = str(header.cards[key])
            raise bad_frame(f"has a FITS header with an impossible {key}", value[:40])
    return cards


def _require_bounded(header: Header, data: bytes, tile_pixels: int) -> None:
    rows, row_bytes = header.whole("NAXIS2"), header.whole("NAXIS1")
    if rows > MAX_TILES:
        raise bad_frame(f"may have at most {MAX_TILES} compressed tiles", str(rows))
    table = np.frombuffer(data[: rows * row_bytes], np.uint8).reshape(rows, row_bytes)
    heap = header.whole("THEAP", rows * row_bytes)
    method = str(header.cards.get("ZCMPTYPE"))
    for name, number_bytes, places in _columns(header, table):
        is_gzip = name == "GZIP_COMPRESSED_DATA" or (name == "COMPRESSED_DATA" and "GZIP" in method)
        for count, place in places.tolist():
            first = heap + place
            end = first + count * number_bytes
            if count < 0 or place < 0 or end > len(data):
                raise bad_frame("has compressed tiles that lie beyond its data", name)
            if is_gzip:
                _require_unfolded(data[first:end], tile_pixels)


def _columns(
    header: Header, table: npt.NDArray[np.uint8]
) -> Iterator[tuple[str, int, npt.NDArray[np.int64]]]:
    """Columns of arrays in a compressed FITS table: name, bytes per number, counts and offsets."""
    at = 0
    for number in range(1, header.whole("TFIELDS") + 1):
        text = str(header.cards.get(f"TFORM{number}") or "").strip()
        form = _FORM.match(text)
        if form is None or form[2] not in _BYTES or form[3] not in {None, *_BYTES}:
            raise bad_frame(f"has a FITS header with an impossible TFORM{number}", text[:40])
        count = int(form[1] or 1)
        size = -(-count // 8) if form[2] == "X" else count * _BYTES[form[2]]
        if at + size > table.shape[1]:
            raise bad_frame("has columns that are wider than its rows", f"TFORM{number}")
        if form[2] in _DESCRIPTORS and count == 1:
            places: Any = np.ascontiguousarray(table[:, at : at + size]).view(_DESCRIPTORS[form[2]])
            name = str(header.cards.get(f"TTYPE{number}") or "").strip().upper()
            yield name, _BYTES[form[3] or "B"], places.astype(np.int64)
        at += size


def _require_unfolded(data: bytes, tile_pixels: int) -> None:
    """Raise `BadFile` for gzip data that decompress to more than the numbers of a tile."""
    most, unfolded = tile_pixels * _NUMBER_BYTES + _SPARE_BYTES, 0
    while data:
        source = zlib.decompressobj(_GZIP)
        while data and not source.eof:
            unfolded += len(source.decompress(data, _BLOCK_BYTES))
            if unfolded > most:
                raise bad_frame("has a compressed tile that unfolds into more than its pixels")
            data = source.unconsumed_tail
        data = source.unused_data.lstrip(b"\0")
