"""Frames from TIFF and PNG files: one channel, of 8, 16 or 32 bits."""

import os
import struct
from typing import IO

import numpy as np

from service.errors import BadFile
from service.imaging.arrays import counts_of, full_scale_of
from service.imaging.frame import Frame, FrameLimits, refused

GREY = ("L", "I;16", "I;16B", "I;16L", "I", "F")
"""Pillow's words for one channel of light; all others are colours, or a bit a pixel."""

SEVERAL = "holds several images; send them one by one"

MAX_TAGS = 256
MAX_TAG_BYTES = 1 << 20
MAX_TILE_PIXELS = 1 << 22
_TILE_WIDTH, _TILE_LENGTH = 322, 323
_TAG_TYPE_BYTES = (1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4)


def read_picture(file: IO[bytes], file_format: str, limits: FrameLimits, digest: str) -> Frame:
    """The frame in a TIFF or PNG file; raises `BadFile` with what is wrong with it."""
    from PIL import Image

    if file_format == "TIFF":
        _require_small_tags(file)
    try:
        with Image.open(file, formats=(file_format,)) as image:
            limits.require(*image.size)
            if image.mode not in GREY:
                message = "must have one channel of grey; it is in colour or has a bit a pixel"
                raise refused(message, image.mode)
            if file_format == "PNG" and getattr(image, "n_frames", 1) > 1:
                raise refused(SEVERAL)
            values = np.asarray(image)
    except BadFile:
        raise
    except Exception as error:
        # A decoder that stumbles over what it reads does so in many ways.
        reason = str(error)[:200] or type(error).__name__
        raise refused(f"cannot be read as {file_format}: {reason}") from None
    # Pillow has one kind of integer beyond 16 bits; how full it can be is not known.
    full_scale = np.inf if image.mode == "I" else full_scale_of(values.dtype)
    return Frame(counts_of(values), file_format, digest, full_scale)


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
        file.seek(at)
        (tags,) = struct.unpack(order + "H", file.read(2))
        if tags > MAX_TAGS:
            raise refused(f"has more than {MAX_TAGS} tags", str(tags))
        entries = [struct.unpack(order + "HHL4s", file.read(12)) for _ in range(tags)]
        (following,) = struct.unpack(order + "L", file.read(4))
    except struct.error:
        raise refused(f"is cut off: its TIFF directory lies beyond its {end} bytes") from None
    if following:
        raise refused(SEVERAL)
    tile = 1
    for tag, kind, count, value in entries:
        size = _TAG_TYPE_BYTES[kind] if kind < len(_TAG_TYPE_BYTES) else 8
        if size * count > MAX_TAG_BYTES:
            raise refused(f"has a TIFF tag of more than {MAX_TAG_BYTES} bytes", f"tag {tag}")
        if tag in (_TILE_WIDTH, _TILE_LENGTH):
            tile *= struct.unpack(order + ("H2x" if kind == 3 else "L"), value)[0]
    if tile > MAX_TILE_PIXELS:
        raise refused(f"has tiles of more than {MAX_TILE_PIXELS} pixels", str(tile))
    file.seek(0)
