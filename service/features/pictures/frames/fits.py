"""Reader and writer of frames in FITS files (FITS Standard 4.0).

By default the first image of a file is read, and three planes are summed as colours.
"""

import math
from collections.abc import Sequence
from importlib.util import find_spec
from typing import IO, Any

import numpy as np

from service.errors import BadFile
from service.features.pictures.frames import fits_header, fits_tiles
from service.features.pictures.frames.bounded_file import BoundedFile, decoding
from service.features.pictures.frames.files import as_counts
from service.features.pictures.frames.fits_time import (
    NOTHING_STATED,
    time_of_header,
    timing_remarks,
)
from service.features.pictures.frames.frame import (
    AS_STORED,
    CountArray,
    Frame,
    FrameLimits,
    bad_frame,
)

ABSENT = (
    "is compressed by tiles, which needs the package astropy: install the extra `images` "
    "(pip install '.[images]'), or unpack the file with funpack"
)
SAFE_METHODS = ("RICE_1", "RICE_ONE", "GZIP_1", "GZIP_2", "NOCOMPRESS")
"""FITS compression methods with safe decoders; HCOMPRESS_1's writes beyond its memory."""
COLOURS = 3
LEAST_UNEQUAL, MOST_UNEQUAL = 0.002, 8.0
"""Least difference of the ratio of a pixel's sides from 1, and largest ratio."""
MAX_NAMED = 8


def read_fits(file: BoundedFile, limits: FrameLimits, digest: str) -> Frame:
    """The frame in a FITS file; raises `BadFile` with the reason if it cannot be read."""
    images, primary = _images(file)
    unit, plane, remarks = _chosen(images, limits.image)
    header = unit.header
    planes, interleaved = _planes(header, plane)
    width_px, height_px = header.image_axes[1:3] if interleaved else header.image_axes[:2]
    limits.require(width_px, height_px)
    reader = _Compressed(file, unit) if header.is_compressed else _Plain(file, unit)
    counts = reader.interleaved() if interleaved else reader.plane(planes[0])
    for number in [] if interleaved else planes[1:]:
        counts = counts + reader.plane(number)
    full_scale = _full_scale(header) * len(planes)
    if len(planes) > 1:
        remarks = (*remarks, "image: its three planes were summed as colours")
    timing = time_of_header(header, primary)
    if timing.reason and not timing.reason.startswith(NOTHING_STATED):
        remarks = (*remarks, f"no_time: {timing.reason}")
    remarks = (*remarks, *timing_remarks(timing))
    counts, orientation = _as_shown(counts, header.behind(primary))
    return Frame(
        *(counts, "FITS", digest, full_scale, timing.time, timing.exposure_s),
        no_time=f"the file has no time of exposure: {timing.reason}",
        orientation=orientation,
        remarks=remarks,
        pixel_ratio=_pixel_ratio(header.behind(primary)),
    )


def _pixel_ratio(header: fits_header.Header) -> float | None:
    """The width of a pixel over its height by its sizes, or else by its binning; None if equal."""
    for keys in (("XPIXSZ", "YPIXSZ"), ("PIXSIZE1", "PIXSIZE2"), ("XBINNING", "YBINNING")):
        sides = [header.cards.get(key) for key in keys]
        width, height = (
            0.0 if each is None or isinstance(each, (bool, str)) else float(each) for each in sides
        )
        if min(width, height) <= 0.0:
            continue
        ratio = width / height
        if abs(ratio - 1.0) > LEAST_UNEQUAL and 1.0 / MOST_UNEQUAL <= ratio <= MOST_UNEQUAL:
            return ratio
    return None


def write_fits(
    file: IO[bytes], counts: CountArray, cards: dict[str, bool | int | float | str]
) -> None:
    """Write counts, unsigned 16-bit integers, as a FITS file with additional header cards."""
    height_px, width_px = counts.shape
    # FITS has signed integers only: BZERO shifts them by half of the range (4.4.2.5).
    header: dict[str, bool | int | float | str] = {
        "SIMPLE": True, "BITPIX": 16, "NAXIS": 2, "NAXIS1": width_px, "NAXIS2": height_px,
        "BZERO": 32768, "BSCALE": 1, **cards,
    }  # fmt: skip
    fits_header.write_header(file, header)
    data = (counts.astype(np.int32) - 32768).astype(">i2").tobytes()
    file.write(data.ljust(-(-len(data) // fits_header.BLOCK) * fits_header.BLOCK, b"\0"))


def _images(file: BoundedFile) -> tuple[list[fits_header.Unit], fits_header.Header]:
    """The FITS units that hold images, and the primary header; raises `BadFile` if none does."""
    images: list[fits_header.Unit] = []
    primary: fits_header.Header | None = None
    try:
        for unit in fits_header.units_of(file):
            primary = primary or unit.header
            if unit.header.is_image:
                images.append(unit)
    except BadFile:
        # Units after an image may be broken.
        if not images:
            raise
    if not images or primary is None:
        raise bad_frame("holds no image of two dimensions")
    return images, primary


def _chosen(
    images: Sequence[fits_header.Unit], choice: str | None
) -> tuple[fits_header.Unit, int | None, tuple[str, ...]]:
    """The chosen FITS unit with an image, the number of its chosen plane or None, and remarks."""
    named = ", ".join(f"{each.number} {each.header.name}".strip() for each in images[:MAX_NAMED])
    if choice is None:
        if len(images) == 1:
            return images[0], None, ()
        taken = f"{images[0].number} {images[0].header.name}".strip()
        return images[0], None, (f"image: {taken} was taken, the first of {named}",)
    name, _, plane = choice.strip().partition(":")
    if plane and not plane.isdecimal():
        raise bad_frame("has planes that are chosen by number, from 1", choice[:40])
    number = int(plane) if plane else None
    for each in images:
        is_number = name.isdecimal() and int(name) == each.number
        if is_number or (name and name.upper() == each.header.name) or not name:
            return each, number, (f"image: {choice[:40]} was chosen",)
    raise bad_frame(f"holds the images {named}; choose one of them", choice[:40])


def _planes(header: fits_header.Header, plane: int | None) -> tuple[list[int], bool]:
    """The planes of a FITS image to sum, from 0, and true if its colours alternate by pixel."""
    axes = header.image_axes
    count = 1
    for length in axes[2:]:
        count = min(count * length, 1 << 60)
    if plane is not None:
        if not 1 <= plane <= count:
            raise bad_frame(f"has the planes 1 to {count}", str(plane)[:40])
        return [plane - 1], False
    if count == 1:
        return [0], False
    if len(axes) == 3 and axes[2] == COLOURS:
        return list(range(COLOURS)), False
    if len(axes) == 3 and axes[0] == COLOURS:
        return list(range(COLOURS)), True
    message = f"holds a cube of {count} planes; choose one, the first as image `:1`"
    raise bad_frame(message, " x ".join(str(length) for length in axes[:6]))


def _scaling(header: fits_header.Header) -> tuple[float, float]:
    scale = header.number("BSCALE", 1.0)
    if scale == 0.0:
        raise bad_frame("has a FITS header with an impossible BSCALE", "0")
    return scale, header.number("BZERO", 0.0)


class _Plain:
    """A reader of the pixel values of an uncompressed FITS image."""

    def __init__(self, file: BoundedFile, unit: fits_header.Unit) -> None:
        self._file, self._unit = file, unit
        self._kind = np.dtype(fits_header.TYPES[unit.header.bitpix])
        self._scaling = _scaling(unit.header)

    def plane(self, number: int) -> CountArray:
        """One plane (rows, columns) of counts of an uncompressed FITS image; planes from 0."""
        width, height = self._unit.header.image_axes[:2]
        return self._counts(self._read(number * width * height, width * height), (height, width))

    def interleaved(self) -> CountArray:
        """The sums of each pixel's colours (rows, columns) in an uncompressed FITS image."""
        colours, width, height = self._unit.header.image_axes
        stored = self._read(0, colours * width * height)
        return np.asarray(self._counts(stored, (height, width, colours)).sum(axis=2))

    def _read(self, first: int, count: int) -> Any:
        self._file.seek(self._unit.start + first * self._kind.itemsize)
        return np.frombuffer(self._file.exactly(count * self._kind.itemsize), self._kind)

    def _counts(self, stored: Any, shape: tuple[int, ...]) -> CountArray:
        scale, zero = self._scaling
        header = self._unit.header
        counts = as_counts(stored)
        if (scale, zero) != (1.0, 0.0):
            if not (scale.is_integer() and zero.is_integer()):
                # Single precision would lose small steps above a large zero.
                counts = counts.astype(np.float64)
            counts = (counts * scale + zero).astype(counts.dtype, copy=False)
        if self._kind.kind in "iu" and "BLANK" in header.cards:
            # One that the pixels cannot hold marks none of them.
            counts[stored == header.whole("BLANK", least=-(1 << 63))] = np.nan
        return counts.reshape(shape)


class _Compressed:
    """A reader of the pixel values of a tile-compressed FITS image, through astropy."""

    def __init__(self, file: BoundedFile, unit: fits_header.Unit) -> None:
        if find_spec("astropy") is None:
            raise bad_frame(ABSENT)
        self._header = header = unit.header
        method = str(header.cards.get("ZCMPTYPE") or "").strip().upper()
        if method not in SAFE_METHODS:
            known = ", ".join(SAFE_METHODS)
            raise bad_frame(f"is compressed by another method than {known}", method[:40])
        axes = header.image_axes
        tile = math.prod(fits_tiles.tile_of(header))
        if tile > axes[0] * axes[1] * min(axes[2] if len(axes) > 2 else 1, COLOURS):
            raise bad_frame("has compressed tiles of more pixels than a picture", str(tile)[:40])
        self._table = fits_tiles.rewritten(file, unit)

    def plane(self, number: int) -> CountArray:
        """One plane (rows, columns) of counts of a tile-compressed FITS image; planes from 0."""
        return self._section(number)

    def interleaved(self) -> CountArray:
        """The sums of each pixel's colours (rows, columns) in a tile-compressed FITS image."""
        return np.asarray(self._section(None).sum(axis=2))

    def _section(self, number: int | None) -> CountArray:
        from astropy.io import fits

        axes = self._header.image_axes
        self._table.seek(0)
        with decoding("compressed FITS"):
            opened = fits.open(self._table, memmap=False, lazy_load_hdus=True)
            try:
                section = opened[1].section
                shape = tuple(reversed(axes[2:]))
                place = () if number is None else np.unravel_index(number, shape) if shape else ()
                extra = len(section.shape) - len(axes)
                values = section[(0,) * extra + tuple(int(each) for each in place)]
            finally:
                opened.close(closed=False)
        return as_counts(np.asarray(values))


def _full_scale(header: fits_header.Header) -> float:
    """The largest count that a FITS image can hold; infinite for floating-point numbers."""
    kind = np.dtype(fits_header.TYPES[header.bitpix])
    if kind.kind not in "iu":
        return float(np.inf)
    scale, zero = _scaling(header)
    return max(float(np.iinfo(kind).max) * scale, float(np.iinfo(kind).min) * scale) + zero


def _as_shown(counts: CountArray, header: fits_header.Header) -> tuple[CountArray, str]:
    """Counts with rows from the top down, by the keyword ROWORDER, and the change in words."""
    order = str(header.cards.get("ROWORDER") or "").strip().upper().replace("_", "-")
    if order != "BOTTOM-UP":
        return counts, AS_STORED
    how = "as shown: rows in reverse order (ROWORDER = 'BOTTOM-UP')"
    return np.ascontiguousarray(counts[::-1]), how
