"""Frames from TIFF, PNG, JPEG and BMP files: grey of up to 32 bits, or colours of up to 16."""

import math
import os
import struct
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from service.errors import BadFile
from service.imaging.frames.arrays import as_counts, full_scale_of
from service.imaging.frames.deep_color import deep_light, is_deep
from service.imaging.frames.exif import (
    MAX_EXIF_BYTES,
    bytes_beyond,
    directory,
    exposure_of,
    require_small_exif,
)
from service.imaging.frames.frame import Frame, FrameLimits, bad_frame

GREY = ("L", "I;16", "I;16B", "I;16L", "I", "F")
"""Pillow's words for one channel of light."""
COLORS = ("RGB", "RGBA", "RGBX", "LA", "P", "PA", "CMYK", "YCbCr")
"""Modes that are turned into red, green and blue; how opaque a pixel is is not looked at."""

SEVERAL = "holds several images; send them one by one"

MAX_TAGS = 256
MAX_TAG_BYTES = 1 << 20
MAX_TILE_PIXELS = 1 << 22
_TILE_WIDTH, _TILE_LENGTH = 322, 323


def read_picture(file: IO[bytes], file_format: str, limits: FrameLimits, digest: str) -> Frame:
    """The frame in a file of one of these formats; raises `BadFile` with what is wrong with it.

    Of a colour picture the counts are the sums of red, green and blue.
    """
    from PIL import Image

    if file_format == "TIFF":
        _require_small_tags(file)
    elif file_format == "JPEG":
        require_small_exif(file)
    try:
        with Image.open(file, formats=(file_format,)) as image:
            limits.require(*image.size)
            if file_format != "JPEG" and getattr(image, "n_frames", 1) > 1:
                raise bad_frame(SEVERAL)
            # To look for EXIF may decode the picture, and takes the word of its depth away.
            deep = is_deep(image)
            told = exposure_of(image)
            if deep:
                values, full_scale = deep_light(image, file, file_format), 3.0 * 65535.0
            else:
                values, full_scale = _light(image)
    except BadFile:
        raise
    except Exception as error:
        # A decoder that stumbles over what it reads does so in many ways.
        reason = str(error)[:200] or type(error).__name__
        raise bad_frame(f"cannot be read as {file_format}: {reason}") from None
    return Frame(as_counts(values), file_format, digest, full_scale, *told)


def _light(image: Any) -> tuple[npt.NDArray[Any], float]:
    """The counts of an image and the largest that there can be."""
    if image.mode in GREY:
        values = np.asarray(image)
        # Pillow has one kind of integer beyond 16 bits; how full it can be is not known.
        return values, math.inf if image.mode == "I" else full_scale_of(values.dtype)
    if image.mode not in COLORS:
        raise bad_frame("must be grey or in colour, not of a bit a pixel", image.mode)
    channels = np.asarray(image if image.mode == "RGB" else image.convert("RGB"))
    # Three bytes a pixel, summed into two.
    return channels.sum(axis=2, dtype=np.uint16), 3.0 * 255.0


def _require_small_tags(file: IO[bytes]) -> None:
    """Raise `BadFile` for a TIFF whose tags alone, or one tile, would take much memory.

    Pillow reads every tag whole before anything can be asked of it; many tags may
    point to the same bytes of a file.
    """
    start = file.read(8)
    end = file.seek(0, os.SEEK_END)
    order = "<" if start[:2] == b"II" else ">"
    try:
        (at,) = struct.unpack(order + "4xL", start)
        entries = directory(file, order, at)
        if len(entries) > MAX_TAGS:
            raise bad_frame(f"has more than {MAX_TAGS} tags", str(len(entries)))
        (following,) = struct.unpack(order + "L", file.read(4))
        told_bytes = bytes_beyond(file, order, entries)
    except struct.error:
        raise bad_frame(f"is cut off: its TIFF directory lies beyond its {end} bytes") from None
    if following:
        raise bad_frame(SEVERAL)
    if told_bytes > MAX_EXIF_BYTES:
        raise bad_frame(f"has more than {MAX_EXIF_BYTES} bytes of EXIF", str(told_bytes))
    tile = 1
    for entry in entries:
        if entry.size_bytes > MAX_TAG_BYTES:
            message = f"has a TIFF tag of more than {MAX_TAG_BYTES} bytes"
            raise bad_frame(message, f"tag {entry.tag}")
        if entry.tag in (_TILE_WIDTH, _TILE_LENGTH):
            tile *= entry.whole(order)
    if tile > MAX_TILE_PIXELS:
        raise bad_frame(f"has tiles of more than {MAX_TILE_PIXELS} pixels", str(tile))
    file.seek(0)
