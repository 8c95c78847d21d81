"""Frames from TIFF, PNG, JPEG and BMP files: grey of up to 32 bits, or colours of up to 16."""

import math
import os
import re
import struct
from contextlib import suppress
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from service.errors import BadFile
from service.imaging.frames.arrays import as_counts, full_scale_of
from service.imaging.frames.deep_color import deep_light, is_deep
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
_TAG_TYPE_BYTES = (1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4)
_EXIF, _EXPOSURE, _TAKEN, _OFFSET = 0x8769, 33434, 36867, 36881
_LONGEST_EXPOSURE_S = 3600.0
_TIME = re.compile(r"(\d{4}):(\d\d):(\d\d) (\d\d):(\d\d):(\d\d)")


def read_picture(file: IO[bytes], file_format: str, limits: FrameLimits, digest: str) -> Frame:
    """The frame in a file of one of these formats; raises `BadFile` with what is wrong with it.

    Of a colour picture the counts are the sums of red, green and blue.
    """
    from PIL import Image

    if file_format == "TIFF":
        _require_small_tags(file)
    try:
        with Image.open(file, formats=(file_format,)) as image:
            limits.require(*image.size)
            if file_format != "JPEG" and getattr(image, "n_frames", 1) > 1:
                raise bad_frame(SEVERAL)
            # To look for EXIF may decode the picture, and takes the word of its depth away.
            deep = is_deep(image)
            told = _told(image)
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


def _told(image: Any) -> tuple[str | None, float | None]:
    """The UTC of mid exposure and the exposure in seconds, each None where EXIF does not tell.

    A camera's clock without its offset from UTC tells no time.
    """
    try:
        exif = image.getexif().get_ifd(_EXIF)
    except Exception:
        # What is not EXIF is no reason to refuse a picture.
        return None, None
    exposure_s = None
    with suppress(TypeError, ValueError, ZeroDivisionError, OverflowError):
        value = float(exif[_EXPOSURE]) if _EXPOSURE in exif else math.nan
        exposure_s = value if 0.0 < value <= _LONGEST_EXPOSURE_S else None
    return _utc(exif.get(_TAKEN), exif.get(_OFFSET), exposure_s or 0.0), exposure_s


def _utc(taken: object, offset: object, exposure_s: float) -> str | None:
    from datetime import UTC, datetime, timedelta, timezone

    found = _TIME.match(taken) if isinstance(taken, str) else None
    zone = re.match(r"([+-])(\d\d):(\d\d)", offset) if isinstance(offset, str) else None
    if found is None or zone is None:
        return None
    try:
        minutes = (60 * int(zone[2]) + int(zone[3])) * (-1 if zone[1] == "-" else 1)
        local = datetime(*(int(each) for each in found.groups()))  # type: ignore[arg-type]
        local = local.replace(tzinfo=timezone(timedelta(minutes=minutes)))
        middle = local.astimezone(UTC) + timedelta(seconds=0.5 * exposure_s)
    except (ValueError, OverflowError):
        return None
    return middle.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"


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
            raise bad_frame(f"has more than {MAX_TAGS} tags", str(tags))
        entries = [struct.unpack(order + "HHL4s", file.read(12)) for _ in range(tags)]
        (following,) = struct.unpack(order + "L", file.read(4))
    except struct.error:
        raise bad_frame(f"is cut off: its TIFF directory lies beyond its {end} bytes") from None
    if following:
        raise bad_frame(SEVERAL)
    tile = 1
    for tag, kind, count, value in entries:
        size = _TAG_TYPE_BYTES[kind] if kind < len(_TAG_TYPE_BYTES) else 8
        if size * count > MAX_TAG_BYTES:
            raise bad_frame(f"has a TIFF tag of more than {MAX_TAG_BYTES} bytes", f"tag {tag}")
        if tag in (_TILE_WIDTH, _TILE_LENGTH):
            tile *= struct.unpack(order + ("H2x" if kind == 3 else "L"), value)[0]
    if tile > MAX_TILE_PIXELS:
        raise bad_frame(f"has tiles of more than {MAX_TILE_PIXELS} pixels", str(tile))
    file.seek(0)
