"""PNG pictures whose samples of 16 bits Pillow cuts to eight: colours, and grey with opacity."""

import re
import sys
from typing import IO, Any

import numpy as np
import numpy.typing as npt

_DEEP = re.compile(r"(RGB[AX]?;16)([BLN])")
_DEEP_GREY, _FOUR_BYTES = "LA;16B", "RGBA"
"""Both have four bytes a pixel; the second keeps them as they are."""
_OTHER_BYTE = {"B": "L", "L": "B", "N": "B" if sys.byteorder == "little" else "L"}
"""By the order of bytes in a file: the order in which the lower byte is taken for the upper."""


def is_deep(image: Any) -> bool:
    """True if an image, opened and not yet decoded, has 16 bits a colour."""
    return bool(image.tile) and all(_DEEP.fullmatch(_raw_mode(tile)) for tile in image.tile)


def is_deep_grey(image: Any) -> bool:
    """True if an image, opened and not yet decoded, is grey of 16 bits with opacity."""
    return bool(image.tile) and all(_raw_mode(tile) == _DEEP_GREY for tile in image.tile)


def deep_grey(file: IO[bytes], file_format: str) -> npt.NDArray[np.uint16]:
    """The greys (rows, columns) of a picture of 16 bits with opacity, which is not looked at."""
    from PIL import Image

    file.seek(0)
    with Image.open(file, formats=(file_format,)) as image:
        image.tile = [_with_raw_mode(tile, _FOUR_BYTES) for tile in image.tile]
        upper, lower = (np.asarray(image)[:, :, k].astype(np.uint16) for k in (0, 1))
    return np.asarray(upper << 8 | lower)


def deep_light(image: Any, file: IO[bytes], file_format: str) -> npt.NDArray[np.uint32]:
    """The sums of red, green and blue (rows, columns), for which the file is decoded twice."""
    from PIL import Image

    light = _sums(image) * np.uint32(256)
    file.seek(0)
    with Image.open(file, formats=(file_format,)) as again:
        again.tile = [_lower(tile) for tile in again.tile]
        return light + _sums(again)


def _sums(image: Any) -> npt.NDArray[np.uint32]:
    channels = np.asarray(image)[:, :, :3]
    return np.asarray(channels.sum(axis=2, dtype=np.uint32))


def _raw_mode(tile: Any) -> str:
    arguments = tile[3]
    return str(arguments[0] if isinstance(arguments, tuple) else arguments)


def _lower(tile: Any) -> Any:
    """The same piece of a picture, with the lower byte of each number in place of the upper."""
    mode = _DEEP.sub(lambda found: found[1] + _OTHER_BYTE[found[2]], _raw_mode(tile))
    return _with_raw_mode(tile, mode)


def _with_raw_mode(tile: Any, mode: str) -> Any:
    arguments = tile[3]
    changed = (mode, *arguments[1:]) if isinstance(arguments, tuple) else mode
    return type(tile)(*tile[:3], changed)
