"""Reader of frames from TIFF and BigTIFF: grey or colour, any samples, strips and tiles.

tifffile reads the tags and puts strips and tiles in their places. libtiff, in Pillow, decompresses
them: it writes no more bytes than asked for, whatever a file holds.
"""

import io
import logging
import math
import struct
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from service.features.pictures.frames.bounded_file import BoundedFile, decoding
from service.features.pictures.frames.exif import (
    MAX_EXIF_BYTES,
    TAG,
    Entry,
    as_shown,
    bytes_beyond,
    directory,
    exif_exposure,
    timing_remarks,
)
from service.features.pictures.frames.files import as_counts, full_scale_of
from service.features.pictures.frames.frame import CountArray, Frame, FrameLimits, bad_frame
from service.features.pictures.frames.jpeg import require_whole
from service.features.pictures.frames.several import (
    MAX_IMAGES,
    Subfile,
    chosen_image,
    planes_described,
    require_few,
)

MAX_TAGS = 256
MAX_TAG_BYTES = 1 << 20
MAX_TILE_PIXELS = 1 << 22
MAX_SAMPLES = 8
_SUBFILE, _TILE_WIDTH, _TILE_LENGTH = 254, 322, 323
_DESCRIPTION, _SAMPLES, _META_MORPH = 270, 277, 33629
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _FILTER_PATTERN, _LINEAR_RAW = 0, 1, 2, 32803, 34892
_GREYS = (_WHITE_IS_ZERO, _BLACK_IS_ZERO, _FILTER_PATTERN)
_BY_PILLOW = {3: "palette", 5: "CMYK", 6: "YCbCr"}
"""Photometric interpretations of TIFF by number, which Pillow converts to red, green and blue."""
_PLAIN, _JPEG, _PACK_BITS = 1, 7, 32773
_UNPACKED = {5, 8, _PACK_BITS, 32946, 34925, 50000}
"""TIFF compression codes that are read: LZW, deflate, PackBits, deflate, LZMA, Zstandard."""
_NO_PREDICTOR, _DIFFERENCES, _FLOAT_PREDICTOR = 1, 2, 3

logging.getLogger("tifffile").setLevel(logging.CRITICAL)
"""Silence tifffile's logger: this module reports the faults of files as errors."""


_OPACITY = {1, 2}
"""Kinds of extra samples that are opacity (TIFF 6.0, ExtraSamples)."""


def read_tiff(file: BoundedFile, limits: FrameLimits, digest: str) -> Frame:
    """The frame in a TIFF file; raises `BadFile` with the reason if it cannot be read.

    The colour samples of a pixel are summed.
    """
    from tifffile import TiffFile

    subfiles, planes = _subfiles(file)
    number, remarks = chosen_image(subfiles, limits.image)
    file.seek(0)
    with (
        decoding("TIFF"),
        TiffFile(file.stream, name="frame", _multifile=False, is_ndpi=False) as opened,
    ):
        page: Any = opened.pages[0 if planes > 1 else number]
        _require_readable(page, limits)
        if planes > 1:
            _move_to_plane(page, number)
        tag = page.tags.valueof(TAG)
        time, exposure_s = _page_exposure(page)
        if page.photometric in _BY_PILLOW or page.compression == _JPEG:
            if page.compression == _JPEG:
                _require_whole_segments(page, file, limits)
            # Pillow applies the orientation while decoding.
            counts, full_scale = _by_pillow(file, 0 if planes > 1 else number)
            _, orientation = as_shown(np.zeros((1, 1)), tag)
        else:
            stored, full_scale = _light(page, file)
            counts, orientation = as_shown(as_counts(stored), tag)
    limits.require(counts.shape[1], counts.shape[0])
    if page.samplesperpixel == 2 and not set(page.extrasamples) & _OPACITY:
        unnamed = "image: the first of two samples a pixel was taken; the other has no name"
        remarks = (*remarks, unnamed)
    return Frame(
        *(counts, "TIFF", digest, full_scale, time, exposure_s),
        orientation=orientation,
        remarks=(*remarks, *timing_remarks(time, exposure_s)),
    )


def _require_readable(page: Any, limits: FrameLimits) -> None:
    """Raise `BadFile` for a TIFF page with an unsupported layout or too many pixels."""
    limits.require_either_way(page.imagewidth, page.imagelength)
    bits, samples = page.bitspersample, page.samplesperpixel
    if page.tags.valueof(262) is None:
        raise bad_frame("has no photometric interpretation")
    if bits == 1:
        raise bad_frame("must be grey or in colour, not of a bit a pixel", "1 bit")
    if bits not in (8, 16, 32, 64) or page.dtype is None or page.dtype.kind not in "uif":
        kind = _word(page.sampleformat)
        raise bad_frame("holds numbers of a kind that is not read", f"{kind} of {bits} bits"[:80])
    if page.imagedepth != 1 or page.fillorder != 1 or page.planarconfig not in (1, 2):
        raise bad_frame("has a depth, an order of bits or a planar configuration that is not read")
    if not 1 <= samples <= MAX_SAMPLES:
        raise bad_frame(f"may have 1 to {MAX_SAMPLES} samples a pixel", str(samples)[:40])
    compression, photometric = _word(page.compression), _word(page.photometric)
    simple = bits == 8 and (samples == 1 or page.planarconfig == 1)
    if page.compression == _JPEG:
        if not simple or page.photometric not in (_BLACK_IS_ZERO, _RGB, 6):
            raise bad_frame("has a layout of JPEG data that is not read", photometric)
    elif page.compression not in (_PLAIN, *_UNPACKED):
        message = "is compressed in a way that is not read; save it uncompressed or deflated"
        raise bad_frame(message, compression)
    elif page.photometric in _BY_PILLOW:
        if not simple:
            raise bad_frame(f"has a layout of {photometric} that is not read", f"{bits} bits")
    elif page.photometric not in (*_GREYS, _RGB, _LINEAR_RAW):
        raise bad_frame("has colours that are not read; save it grey or in RGB", photometric)
    elif page.photometric == _WHITE_IS_ZERO and page.dtype.kind != "u":
        raise bad_frame("shows white as zero, in numbers without a largest one", str(page.dtype))
    if page.predictor not in (_NO_PREDICTOR, _DIFFERENCES, _FLOAT_PREDICTOR):
        raise bad_frame("has a predictor that is not read", _word(page.predictor))
    if page.predictor != _NO_PREDICTOR and page.compression in (_PLAIN, _PACK_BITS):
        # Readers disagree on whether the predictor applies there.
        raise bad_frame("has a predictor with a compression that takes none", compression)


def _move_to_plane(page: Any, number: int) -> None:
    """Redirect a TIFF page to one of several planes stored contiguously behind a single directory.

    Raises `BadFile` where planes are compressed, or their strips not contiguous.
    """
    ends = [at + size for at, size in zip(page.dataoffsets, page.databytecounts, strict=True)]
    if page.compression != _PLAIN or list(page.dataoffsets[1:]) != ends[:-1]:
        raise bad_frame("holds several images in a layout that is not read; save them as pages")
    # Some writers state the bytes of all planes as those of the first.
    pixel_bytes = page.samplesperpixel * page.dtype.itemsize
    plane_bytes = page.imagewidth * page.imagelength * pixel_bytes
    if len(page.databytecounts) == 1:
        page.databytecounts = (plane_bytes,)
    page.dataoffsets = tuple(at + number * plane_bytes for at in page.dataoffsets)


def _word(value: Any) -> str:
    return str(getattr(value, "name", value))[:60]


def _light(page: Any, file: BoundedFile) -> tuple[npt.NDArray[Any], float]:
    """Colour sums (rows, columns) of a TIFF page in stored order, and the largest possible sum."""
    colours = _colours(page)
    unpredict = page.predictor == _FLOAT_PREDICTOR
    packed = page.compression if page.compression != _PLAIN else None
    # tifffile receives data that are decompressed already.
    page.compression = _PLAIN
    page.predictor = _NO_PREDICTOR if unpredict else page.predictor
    dtype = page.dtype
    whole = dtype.newbyteorder("=")
    if colours > 1:
        # Sums of three 16-bit numbers are exact in single precision's 24 bits too.
        whole = np.dtype("i4" if dtype.kind in "ui" and dtype.itemsize < 4 else "f8")
    light = np.zeros((page.imagelength, page.imagewidth), whole)
    uses = Counter(page.dataoffsets)
    for index, data in _segments(page, file, packed):
        plain = _undone(data, page) if unpredict else data
        part, (plane, _, row, column, _), (_, rows, columns, _) = page.decode(plain, index)
        rows = min(rows, light.shape[0] - row)
        columns = min(columns, light.shape[1] - column)
        if uses[page.dataoffsets[index]] > 1 and part.min() != part.max():
            raise bad_frame("has strips or tiles that share their bytes and are not blank")
        if plane < colours:
            part = part[0, :rows, :columns, :colours]
            light[row : row + rows, column : column + columns] += part.sum(axis=2, dtype=whole)
    full_scale = math.inf if dtype.itemsize > 2 else full_scale_of(dtype)
    if page.photometric == _WHITE_IS_ZERO:
        light = np.subtract(np.iinfo(dtype).max * colours, light, dtype=whole)
    return light, colours * full_scale


def _colours(page: Any) -> int:
    """The number of leading samples of a pixel that are light; opacity is not counted."""
    samples = int(page.samplesperpixel)
    if page.photometric in (_RGB, _LINEAR_RAW):
        if samples < 3:
            raise bad_frame("has fewer samples a pixel than colours", str(samples))
        return 3
    if samples in (1, 2):
        return 1
    if samples == 3:
        return 3
    raise bad_frame("has samples that are not named as colours", f"{samples} samples a pixel")


def _segment_size(page: Any) -> tuple[int, int, int]:
    """Rows and columns of a strip or tile, and the number of them below each other.

    Raises `BadFile` where their number does not fit the size of the page, or where they overlap.
    """
    planes, _, rows, columns, _ = page.shaped
    tall, wide = (
        (page.tilelength, page.tilewidth) if page.is_tiled else (page.rowsperstrip, columns)
    )
    down, across = -(-rows // tall), -(-columns // wide)
    if not len(page.dataoffsets) == len(page.databytecounts) == planes * down * across:
        message = "has another number of strips or tiles than its size needs"
        raise bad_frame(
            message, f"{len(page.dataoffsets)} where {planes * down * across} are needed"
        )
    _require_apart(page)
    return tall, wide, down


def _segments(page: Any, file: BoundedFile, packed: Any) -> Iterator[tuple[int, bytes]]:
    """Strips or tiles of a page, numbered and decompressed; raises `BadFile` for a wrong size."""
    _, _, rows, _, contiguous = page.shaped
    item = contiguous * page.dtype.itemsize
    tiled = page.is_tiled
    tall, wide, down = _segment_size(page)
    offsets, sizes = page.dataoffsets, page.databytecounts
    for index, (at, size) in enumerate(zip(offsets, sizes, strict=True)):
        high = tall if tiled else min(tall, rows - index % down * tall)
        wanted = wide * high * item
        if size < 1 or at < 8 or at + size > file.length:
            raise bad_frame("is cut off, or has a strip or tile without data", f"number {index}")
        if (size > 2 * wanted + 65536) if packed else not wanted <= size <= wanted + 3:
            message = "has a strip or tile of another size than its pixels need"
            raise bad_frame(message, f"{size} bytes where {wanted} are needed")
        file.seek(at)
        data = file.read(size)
        yield index, data[:wanted] if packed is None else _unpacked(data, packed, wide * item, high)


def _require_apart(page: Any) -> None:
    """Raise `BadFile` where a strip or tile overlaps another one, a tag's value or the directory.

    Overlapping pixels would be out of place, and an attitude from them wrong.
    """
    form = page.parent.tiff
    directory_bytes = form.tagnosize + len(page.tags) * form.tagsize + form.offsetsize
    spans = {(page.offset, page.offset + directory_bytes, False)}
    spans |= {
        (tag.valueoffset, tag.valueoffset + tag.valuebytecount, False)
        for tag in page.tags
        if tag.valuebytecount > form.offsetsize
    }
    # Identical offsets are allowed here: blank tiles may share their bytes.
    pairs = zip(page.dataoffsets, page.databytecounts, strict=True)
    spans |= {(at, at + size, True) for at, size in pairs}
    tags_end = data_end = 0
    for at, end, is_data in sorted(spans):
        if at < data_end or (is_data and at < tags_end):
            raise bad_frame("has strips or tiles that lie over each other or over its tags")
        if is_data:
            data_end = max(data_end, end)
        else:
            tags_end = max(tags_end, end)


def _unpacked(data: bytes, compression: int, row_bytes: int, rows: int) -> bytes:
    """Decompressed rows of a strip or tile; libtiff reads them as an 8-bit grey picture."""
    from PIL import Image

    entries = [(256, row_bytes), (257, rows), (258, 8), (259, int(compression)), (262, 1)]
    entries += [(273, 8 + 2 + 9 * 12 + 4), (277, 1), (278, rows), (279, len(data))]
    head = b"II*\0" + struct.pack("<LH", 8, len(entries))
    head += b"".join(struct.pack("<HHLL", tag, 4, 1, value) for tag, value in entries) + bytes(4)
    with Image.open(io.BytesIO(head + data), formats=("TIFF",)) as picture:
        return picture.tobytes()


def _undone(data: bytes, page: Any) -> bytes:
    """Floating-point numbers of a strip or tile after undoing the horizontal byte differences."""
    item, contiguous = page.dtype.itemsize, page.shaped[4]
    columns = page.tilewidth if page.is_tiled else page.shaped[3]
    stored = np.frombuffer(data, np.uint8).reshape(-1, columns * item, contiguous)
    summed = np.cumsum(stored, axis=1, dtype=np.uint8)
    parts = summed.reshape(len(stored), item, columns * contiguous)
    numbers = np.ascontiguousarray(parts.transpose(0, 2, 1)).view(f">f{item}")
    return numbers.astype(page.parent.byteorder + f"f{item}").tobytes()


def _by_pillow(file: BoundedFile, number: int) -> tuple[CountArray, float]:
    """The sums of red, green and blue of an 8-bit page, rotated by its orientation."""
    from PIL import Image

    file.seek(0)
    with Image.open(file.stream, formats=("TIFF",)) as image:
        image.seek(number)
        if image.mode == "L":
            return as_counts(np.asarray(image)), 255.0
        channels = np.asarray(image.convert("RGB"))
    return as_counts(channels.sum(axis=2, dtype=np.uint16)), 3.0 * 255.0


def _require_whole_segments(page: Any, file: BoundedFile, limits: FrameLimits) -> None:
    """Raise `BadFile` for a page with damaged JPEG data, or with strips or tiles of wrong size."""
    tables = page.jpegtables[:-2] if page.jpegtables else b"\xff\xd8"
    tall, wide, down = _segment_size(page)
    for index, (at, size) in enumerate(zip(page.dataoffsets, page.databytecounts, strict=True)):
        file.seek(at)
        data = tables + file.read(size)[2:]
        require_whole(data, limits.max_pixels)
        # The last strip may have the full height, or only its remaining rows.
        left = page.imagelength - index % down * tall
        if _jpeg_size(data) not in (
            (wide, tall),
            (wide, tall if page.is_tiled else min(tall, left)),
        ):
            raise bad_frame(
                "has strips or tiles of JPEG data that are of another size than it says"
            )


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Columns and rows of the picture, as stated by the header of JPEG data."""
    at = 2
    while True:
        marker, length = struct.unpack_from(">HH", data, at)
        if 0xFFC0 <= marker <= 0xFFCF and marker not in (0xFFC4, 0xFFC8, 0xFFCC):
            rows, columns = struct.unpack_from(">HH", data, at + 5)
            return columns, rows
        at += 2 + length


def _page_exposure(page: Any) -> tuple[str | None, float | None]:
    """The UTC of mid exposure and the exposure from the EXIF of a TIFF page."""
    exif = page.tags.valueof(34665)
    exif = exif if isinstance(exif, dict) else {}
    names = "DateTimeOriginal", "OffsetTimeOriginal", "SubsecTimeOriginal", "ExposureTime"
    return exif_exposure(*(exif.get(name) for name in names))


def _subfiles(file: BoundedFile) -> tuple[list[Subfile], int]:
    """The images of a TIFF, and the number of planes behind its only directory (1 without planes).

    Raises `BadFile` where the tags alone would take too much memory.

    tifffile reads every tag whole; many tags may point to the same bytes of a file.
    """
    file.seek(0)
    start = file.read(16)
    order, big = "<" if start[:2] == b"II" else ">", start[2:4] in (b"+\0", b"\0+")
    subfiles: list[Subfile] = []
    try:
        (at,) = struct.unpack_from(order + ("8xQ" if big else "4xL"), start)
        while at:
            if len(subfiles) == MAX_IMAGES:
                raise bad_frame(f"holds more than {MAX_IMAGES} images, or its directories loop")
            entries = directory(file, order, at, big)
            _require_small(order, entries)
            (at,) = struct.unpack(order + ("Q" if big else "L"), file.read(8 if big else 4))
            values = {entry.tag: entry.whole(order) for entry in reversed(entries)}
            subfiles.append(
                Subfile(values.get(256, 0), values.get(257, 0), bool(values.get(_SUBFILE, 0) & 5))
            )
            if bytes_beyond(file, order, entries, big=big) > MAX_EXIF_BYTES:
                raise bad_frame(f"has more than {MAX_EXIF_BYTES} bytes of EXIF")
        planes = _planes(file, order, entries, subfiles[0]) if len(subfiles) == 1 else 1
    except struct.error:
        kind = "BigTIFF" if big else "TIFF"
        raise bad_frame(
            f"is cut off: its {kind} directory lies beyond its {file.length} bytes"
        ) from None
    return (subfiles * planes, planes)


def _planes(file: BoundedFile, order: str, entries: list[Entry], image: Subfile) -> int:
    """The number of planes behind a TIFF's only directory, by ImageJ, tifffile or MetaMorph."""
    found = {entry.tag: entry for entry in reversed(entries)}
    planes = found[_META_MORPH].number if _META_MORPH in found else 1
    if _DESCRIPTION in found:
        entry = found[_DESCRIPTION]
        text = entry.value[: entry.size_bytes]
        if entry.size_bytes > len(entry.value):
            (at,) = struct.unpack(order + ("Q" if len(entry.value) == 8 else "L"), entry.value)
            file.seek(at)
            text = file.read(entry.size_bytes)
        samples = found[_SAMPLES].whole(order) if _SAMPLES in found else 1
        pixels = image.width_px * image.height_px * samples
        planes = max(planes, planes_described(text, pixels))
    require_few(planes)
    return planes


def _require_small(order: str, entries: list[Entry]) -> None:
    """Raise `BadFile` for a TIFF directory with too many or too large tags, or too large tiles."""
    if len(entries) > MAX_TAGS:
        raise bad_frame(f"has more than {MAX_TAGS} tags", str(len(entries)))
    tile = 1
    for entry in entries:
        if entry.size_bytes > MAX_TAG_BYTES:
            message = f"has a TIFF tag of more than {MAX_TAG_BYTES} bytes"
            raise bad_frame(message, f"tag {entry.tag}")
        if entry.tag in (_TILE_WIDTH, _TILE_LENGTH):
            tile *= entry.whole(order)
    if tile > MAX_TILE_PIXELS:
        raise bad_frame(f"has tiles of more than {MAX_TILE_PIXELS} pixels", str(tile))
