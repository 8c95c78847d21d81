"""Frames from the raw files of cameras, through LibRaw: the extra `raw` installs it.

Pixels of a colour filter's pattern are summed, so that one count has light of all its colours.
"""

import importlib.util
import struct
from typing import IO

import numpy as np

from service.errors import BadFile
from service.imaging.frames.arrays import as_counts
from service.imaging.frames.frame import Frame, FrameLimits, bad_frame

ABSENT = (
    "is a camera's raw file, which needs the package rawpy: install the extra `raw` "
    "(pip install '.[raw]'), or convert the file to TIFF of 16 bits"
)
MAGICS = (b"FUJIFILMCCD-RAW", b"IIRO", b"IIRS", b"MMOR", b"IIU\0")
_CR2, _CR3 = b"CR", b"ftypcrx "
_REDUCED, _SUB_DIRECTORIES, _DNG_VERSION = 254, 330, 50706
_MAX_TAGS = 256


def is_raw(file: IO[bytes], start: bytes) -> bool:
    """Whether a file, whose first bytes are `start`, is a camera's raw file, also as a TIFF."""
    if start.startswith(MAGICS) or start[4:12] == _CR3:
        return True
    if not start.startswith((b"II*\0", b"MM\0*")):
        return False
    return start[8:10] == _CR2 or _has_tags_of_raw(file, "<" if start[:2] == b"II" else ">")


def _has_tags_of_raw(file: IO[bytes], order: str) -> bool:
    """A DNG says so; other makers begin with a small picture and have the large one inside."""
    try:
        file.seek(4)
        file.seek(struct.unpack(order + "L", file.read(4))[0])
        (count,) = struct.unpack(order + "H", file.read(2))
        if count > _MAX_TAGS:
            return False
        entries = [struct.unpack(order + "HHLL", file.read(12)) for _ in range(count)]
    except struct.error:
        return False
    tags = {tag: value for tag, _, _, value in entries}
    inside = _SUB_DIRECTORIES in tags and tags.get(_REDUCED, 0) != 0
    return _DNG_VERSION in tags or inside


def read_raw(file: IO[bytes], limits: FrameLimits, digest: str) -> Frame:
    """The frame in a camera's raw file; raises `BadFile` with what is wrong with it."""
    if not importlib.util.find_spec("rawpy"):
        raise bad_frame(ABSENT)
    import rawpy

    try:
        with rawpy.imread(file) as raw:
            sizes = raw.sizes
            pattern = raw.raw_pattern
            step = 1 if pattern is None else len(pattern)
            if sizes.raw_width * sizes.raw_height > step**2 * limits.max_pixels:
                limits.require(sizes.raw_width // step, sizes.raw_height // step)
            limits.require(sizes.width // step, sizes.height // step)
            values = raw.raw_image_visible
            if values is None or values.ndim != 2:
                raise bad_frame(
                    "holds colours that are already mixed; convert it to TIFF of 16 bits"
                )
            rows, columns = (side // step for side in values.shape)
            blocks = values[: rows * step, : columns * step].reshape(rows, step, columns, step)
            counts = blocks.sum(axis=(1, 3), dtype=np.uint32)
            full_scale = float(step**2 * raw.white_level)
            shutter_s = float(getattr(raw.other, "shutter", 0.0) or 0.0)
    except BadFile:
        raise
    except Exception as error:
        # LibRaw knows some hundred ways in which a file is wrong.
        raise bad_frame(f"cannot be read as a raw file: {str(error)[:200]}") from None
    exposure_s = shutter_s if 0.0 < shutter_s <= 3600.0 else None
    return Frame(as_counts(counts), "RAW", digest, full_scale, None, exposure_s)
