"""The choice of the frame in a file of several images: explicit, or automatic where it is clear.

Every automatic choice is reported. If several images have the same size, one has to be chosen;
smaller copies beside one image are named in a remark.
"""

import io
import json
import re
from typing import Any, NamedTuple

from service.features.pictures.frames.bounded_file import BoundedFile
from service.features.pictures.frames.frame import FrameLimits, bad_frame

MAX_IMAGES = 256
MAX_DECODED = 16
"""Limit for decoding an animation up to one image, in multiples of a frame's largest size."""


class Subfile(NamedTuple):
    """One image of a file: its size, and whether it is a smaller copy or a mask of another."""

    width_px: int
    height_px: int
    is_auxiliary: bool = False


def chosen_image(subfiles: list[Subfile], choice: str | None) -> tuple[int, tuple[str, ...]]:
    """The index (from 0) of the image in a file that is the frame, and remarks on the choice.

    Raises `BadFile` where several images qualify and none is chosen; choices count from 1.
    """
    if choice is not None:
        if choice.isdecimal() and len(choice) < 5 and 1 <= int(choice) <= len(subfiles):
            return int(choice) - 1, (f"image: {choice} of {len(subfiles)} was chosen",)
        if len(subfiles) == 1:
            raise bad_frame("holds one image; there is none to choose", choice[:40])
        raise bad_frame(f"holds the images 1 to {len(subfiles)}; choose one of them", choice[:40])
    whole = [k for k, each in enumerate(subfiles) if not each.is_auxiliary] or [0]
    if len(whole) > 1:
        sizes = ", ".join(
            f"{k + 1}: {subfiles[k].width_px} x {subfiles[k].height_px}" for k in whole
        )
        raise bad_frame(
            f"holds several images; choose one by its number ({sizes[:120]})",
            f"{len(whole)} images",
        )
    others = len(subfiles) - 1
    remark = f"image: {whole[0] + 1} was taken; {others} smaller or auxiliary ones are beside it"
    return whole[0], (remark,) if others else ()


def require_few(count: int) -> None:
    """Raise `BadFile` for a file of too many images."""
    if count > MAX_IMAGES:
        raise bad_frame(f"holds more than {MAX_IMAGES} images", str(count)[:20])


def part_of_jpeg(
    image: Any, file: BoundedFile, choice: str | None
) -> tuple[BoundedFile, tuple[str, ...]] | None:
    """The JPEG data of the chosen image in a file of several (MPO), and remarks.

    None for a file of one image. Images smaller than the first are its previews or maps.
    """
    count = int(getattr(image, "n_frames", 1))
    if count == 1:
        chosen_image([Subfile(*image.size)], choice)
        return None
    require_few(count)
    first, sizes, places = image.size, [], []
    for number in range(count):
        image.seek(number)
        places.append(int(image.offset))
        is_smaller = image.width < first[0] and image.height < first[1]
        sizes.append(Subfile(image.width, image.height, number > 0 and is_smaller))
    number, remarks = chosen_image(sizes, choice)
    file.seek(places[number])
    end = next((place for place in sorted(places) if place > places[number]), file.length)
    return BoundedFile(io.BytesIO(file.read(end - places[number]))), remarks


def sought_frame(image: Any, file: BoundedFile, limits: FrameLimits) -> tuple[int, tuple[str, ...]]:
    """Move an animation (PNG or GIF) to the image of the frame; returns its index and remarks."""
    is_gif = image.format == "GIF"
    count = gif_images(file) if is_gif else int(getattr(image, "n_frames", 1))
    require_few(count)
    number, remarks = chosen_image([Subfile(*image.size)] * count, limits.image)
    if (number + 1) * image.width * image.height > MAX_DECODED * limits.max_pixels:
        raise bad_frame("has too many pixels in front of the image that was chosen", limits.image)
    if number:
        image.seek(number)
    return number, remarks


def gif_images(file: BoundedFile) -> int:
    """The number of images in a GIF, counted without decoding (GIF89a, 17 to 27)."""
    file.seek(10)
    flags = file.exactly(3)[0]
    file.seek(_table_bytes(flags), io.SEEK_CUR)
    count = 0
    while (kind := file.read(1)) in (b"\x2c", b"\x21"):
        if kind == b"\x2c":
            count += 1
            require_few(count)
            file.seek(_table_bytes(file.exactly(9)[8]), io.SEEK_CUR)
        file.seek(1, io.SEEK_CUR)
        while size := file.read(1):
            if size == b"\0":
                break
            file.seek(size[0], io.SEEK_CUR)
    return max(count, 1)


def _table_bytes(flags: int) -> int:
    return 3 << (flags & 7) + 1 if flags & 0x80 else 0


_IMAGEJ = re.compile(rb"\AImageJ=.*?^images=(\d{1,9})\s*$", re.DOTALL | re.MULTILINE)


def planes_described(text: bytes, pixels: int) -> int:
    """The number of images stated by the description of a TIFF with one directory, at least one.

    ImageJ writes `images=`, and tifffile the shape of the whole array; each image has `pixels`
    pixels.
    """
    found = _IMAGEJ.search(text)
    if found is not None:
        return max(int(found[1]), 1)
    if not text.startswith(b"{"):
        return 1
    try:
        shape = json.loads(text.rstrip(b"\0"))["shape"]
        total = 1
        for side in shape:
            total *= int(side)
    except (ValueError, KeyError, TypeError):
        return 1
    return max(total // pixels, 1) if pixels and 0 < total < 1 << 60 else 1
