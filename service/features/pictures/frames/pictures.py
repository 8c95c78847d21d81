"""Reader of frames from PNG, JPEG, GIF, BMP and PGM files: grey or colour, of up to 16 bits."""

import re
import sys
from typing import Any

import numpy as np
import numpy.typing as npt

from service.features.pictures.frames.bounded_file import BoundedFile, decoding
from service.features.pictures.frames.exif import (
    TAG,
    as_shown,
    exif_of,
    exposure_of,
    require_small_exif,
    timing_remarks,
)
from service.features.pictures.frames.files import as_counts, full_scale_of
from service.features.pictures.frames.frame import Frame, FrameLimits, bad_frame
from service.features.pictures.frames.jpeg import require_whole
from service.features.pictures.frames.several import part_of_jpeg, sought_frame

GREY = ("L", "I;16", "I;16B", "I;16L", "F")
"""Pillow's mode names for images of one channel."""
_PILLOW_NAMES = {"PGM": "PPM"}
COLORS = ("RGB", "RGBA", "RGBX", "LA", "P", "PA", "CMYK", "YCbCr")
"""Pillow's mode names for images that are converted to red, green and blue; opacity is ignored."""


def read_picture(file: BoundedFile, file_format: str, limits: FrameLimits, digest: str) -> Frame:
    """The frame in a PNG, JPEG, GIF, BMP or PGM file; raises `BadFile` with the reason.

    The counts of a colour picture are the sums of red, green and blue.
    """
    if file_format == "JPEG":
        file, remarks = _one_jpeg(file, limits)
    with decoding(file_format), _opened(file, file_format) as image:
        limits.require_either_way(*image.size)
        if file_format != "JPEG":
            number, remarks = sought_frame(image, file, limits)
            if number and image.mode not in (*COLORS, "L"):
                raise bad_frame("is a moving picture of 16 bits, of which the first can be read")
        # Access to EXIF may decode the picture and so lose its depth; the depth is read first.
        deep, grey, plain = is_deep(image), is_deep_grey(image), _is_plain(image)
        tag = exif_of(image).get(TAG)
        time, exposure_s = exposure_of(image)
        values: npt.NDArray[Any]
        if deep:
            values, full_scale = deep_light(image, file, file_format), 3.0 * 65535.0
        elif grey:
            values, full_scale = deep_grey(file, file_format), 65535.0
        elif plain:
            values, full_scale = _plain_light(image, file)
        else:
            values, full_scale = _light(image)
        if file_format == "JPEG":
            file.seek(0)
            require_whole(file.read(), limits.max_pixels)
    counts, orientation = as_shown(as_counts(values), tag)
    limits.require(counts.shape[1], counts.shape[0])
    return Frame(
        *(counts, file_format, digest, full_scale, time, exposure_s),
        orientation=orientation,
        remarks=(*remarks, *timing_remarks(time, exposure_s)),
    )


def _one_jpeg(file: BoundedFile, limits: FrameLimits) -> tuple[BoundedFile, tuple[str, ...]]:
    """The data of the chosen image of a JPEG file, which may hold several (MPO), and remarks."""
    require_small_exif(file)
    with decoding("JPEG"), _opened(file, "JPEG") as image:
        part = part_of_jpeg(image, file, limits.image)
    if part is None:
        return file, ()
    require_small_exif(part[0])
    return part


def _opened(file: BoundedFile, file_format: str) -> Any:
    """Picture opened by Pillow as one format, not decoded; raises `BadFile` for another format."""
    from PIL import Image, UnidentifiedImageError

    try:
        return Image.open(file.stream, formats=(_PILLOW_NAMES.get(file_format, file_format),))
    except UnidentifiedImageError:
        raise bad_frame(f"cannot be read as {file_format}: its header has no known form") from None


def _is_plain(image: Any) -> bool:
    """True if a picture that Pillow opened is a binary portable map, which this module decodes.

    Raises `BadFile` for colours in text with more than 8 bits, since Pillow keeps 8 of them.
    """
    if image.format != "PPM" or not image.tile:
        return False
    decoder, _, _, arguments = image.tile[0]
    if decoder == "ppm_plain" and image.mode == "RGB" and arguments[-1] > 255:
        raise bad_frame("is a colour PPM in text of more than 8 bits; save it binary (P6)")
    return decoder in ("raw", "ppm")


def _plain_light(image: Any, file: BoundedFile) -> tuple[npt.NDArray[Any], float]:
    """The colour sums of a binary PGM or PPM, and the largest possible sum."""
    _, _, at, arguments = image.tile[0]
    is_tuple = isinstance(arguments, tuple)
    mode, largest = (arguments[0], arguments[1]) if is_tuple else (arguments, 255)
    if mode == "I;16B":
        mode, largest = "L", 65535
    if mode not in ("L", "RGB"):
        raise bad_frame("is a portable map of a kind that is not read", str(mode)[:20])
    colours, kind = (3 if mode == "RGB" else 1), np.dtype(">u2" if largest > 255 else "u1")
    file.seek(at)
    data = file.exactly(image.width * image.height * colours * kind.itemsize)
    if file.read(2) in _MAGICS:
        raise bad_frame("holds several images; write the one that is meant to a file of its own")
    values = np.frombuffer(data, kind).reshape(image.height, image.width, colours)
    return values.sum(axis=2, dtype=np.uint32), float(colours * largest)


def _light(image: Any) -> tuple[npt.NDArray[Any], float]:
    """The counts of an image, colours summed, and the largest possible count."""
    if image.mode in GREY:
        values = np.asarray(image)
        return values, full_scale_of(values.dtype)
    if image.mode == "I":
        # Pillow scales a PGM in text of more than 8 bits to 16 bits.
        return np.asarray(image), 65535.0
    if image.mode not in COLORS:
        raise bad_frame("must be grey or in colour, not of a bit a pixel", image.mode)
    channels = np.asarray(image if image.mode == "RGB" else image.convert("RGB"))
    # Three bytes per pixel are summed into a 16-bit number.
    return channels.sum(axis=2, dtype=np.uint16), 3.0 * 255.0


_MAGICS = (b"P1", b"P2", b"P3", b"P4", b"P5", b"P6")
_DEEP = re.compile(r"(RGB[AX]?;16)([BLN])")
_DEEP_GREY, _FOUR_BYTES = "LA;16B", "RGBA"
"""Pillow's raw modes of 16-bit grey with opacity, and of a plain copy of four bytes per pixel."""
_OTHER_BYTE = {"B": "L", "L": "B", "N": "B" if sys.byteorder == "little" else "L"}
"""For each byte order, the raw-mode letter that makes Pillow read the lower byte as the upper."""


def is_deep(image: Any) -> bool:
    """True if an image, opened and not yet decoded, has 16 bits per colour."""
    return bool(image.tile) and all(_DEEP.fullmatch(_raw_mode(tile)) for tile in image.tile)


def is_deep_grey(image: Any) -> bool:
    """True if an image, opened and not yet decoded, is 16-bit grey with opacity."""
    return bool(image.tile) and all(_raw_mode(tile) == _DEEP_GREY for tile in image.tile)


def deep_grey(file: BoundedFile, file_format: str) -> npt.NDArray[np.uint16]:
    """The greys (rows, columns) of a 16-bit grey picture with opacity, which is ignored."""
    from PIL import Image

    file.seek(0)
    with Image.open(file.stream, formats=(file_format,)) as image:
        image.tile = [_with_raw_mode(tile, _FOUR_BYTES) for tile in image.tile]
        upper, lower = (np.asarray(image)[:, :, k].astype(np.uint16) for k in (0, 1))
    return np.asarray(upper << 8 | lower)


def deep_light(image: Any, file: BoundedFile, file_format: str) -> npt.NDArray[np.uint32]:
    """The sums of red, green and blue (rows, columns) in 16 bits; the file is decoded twice."""
    from PIL import Image

    light = _sums(image) * np.uint32(256)
    file.seek(0)
    with Image.open(file.stream, formats=(file_format,)) as again:
        again.tile = [_lower(tile) for tile in again.tile]
        return light + _sums(again)


def _sums(image: Any) -> npt.NDArray[np.uint32]:
    channels = np.asarray(image)[:, :, :3]
    return np.asarray(channels.sum(axis=2, dtype=np.uint32))


def _raw_mode(tile: Any) -> str:
    arguments = tile[3]
    return str(arguments[0] if isinstance(arguments, tuple) else arguments)


def _lower(tile: Any) -> Any:
    """A tile descriptor of Pillow, changed to read the lower byte of each number as the upper."""
    mode = _DEEP.sub(lambda found: found[1] + _OTHER_BYTE[found[2]], _raw_mode(tile))
    return _with_raw_mode(tile, mode)


def _with_raw_mode(tile: Any, mode: str) -> Any:
    arguments = tile[3]
    changed = (mode, *arguments[1:]) if isinstance(arguments, tuple) else mode
    return type(tile)(*tile[:3], changed)
