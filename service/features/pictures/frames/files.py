"""Reader of frames from files: FITS, pictures, raw files, numpy arrays, by their first bytes.

Files are untrusted. Every reader works on a `BoundedFile`; the size in pixels is read from the
header and compared with the limits before any decoding. Any fault raises `BadFile` with the reason.
This module reads numpy arrays and raw files; other formats have their own modules.
"""

import gzip
import hashlib
import importlib.util
import math
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pkgutil import resolve_name
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from service.errors import BadFile
from service.features.pictures.frames.bounded_file import BoundedFile, decoding
from service.features.pictures.frames.exif import timing_remarks
from service.features.pictures.frames.frame import CountArray, Frame, FrameLimits, bad_frame
from service.features.pictures.frames.several import MAX_IMAGES, Subfile, chosen_image

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
COLOURS = 3


def read_npy(file: BoundedFile, limits: FrameLimits, digest: str) -> Frame:
    """A frame from a .npy file of (rows, columns), of several planes, or of three colours.

    Colours are summed; one of several planes has to be chosen. Raises `BadFile`.
    """
    try:
        version = np.lib.format.read_magic(file)
        if version not in _HEADERS:
            raise bad_frame("is of a .npy version that frames do not need", str(version))
        shape, by_column, dtype = _HEADERS[version](file, max_header_size=4096)
    except BadFile:
        raise
    except Exception as error:
        # numpy evaluates its header as a Python expression, which fails in many ways.
        raise bad_frame(f"has no readable .npy header: {str(error)[:200]}") from None
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise bad_frame("must hold numbers of up to 64 bits", str(dtype)[:80])
    if any(type(side) is not int for side in shape):
        # In Python a bool is an int, too.
        raise bad_frame("must have a shape of whole numbers", str(shape)[:80])
    if len(shape) == 3 and shape[2] == 1:
        shape = shape[:2]
    axis, plane, remarks = _chosen_plane(shape, limits.image)
    height_px, width_px = (side for k, side in enumerate(shape) if k != axis)
    limits.require(width_px, height_px)
    count = width_px * height_px
    if axis is not None and plane is not None and not by_column:
        file.seek(file.tell() + plane * count * dtype.itemsize)
        shape, axis = (height_px, width_px), None
    else:
        count = math.prod(shape)
    data = file.exactly(count * dtype.itemsize)
    order = "F" if by_column else "C"
    values = np.frombuffer(data, dtype).reshape(shape, order=order)  # type: ignore[call-overload]
    full_scale = full_scale_of(values.dtype)
    if axis is not None and plane is not None:
        values = values[plane]
    elif axis is not None:
        wide = np.int64 if dtype.kind in "iu" and dtype.itemsize < 8 else np.float64
        values, full_scale = values.sum(axis=axis, dtype=wide), COLOURS * full_scale
    return Frame(as_counts(values), "NPY", digest, full_scale, remarks=remarks)


def _chosen_plane(
    shape: tuple[int, ...], choice: str | None
) -> tuple[int | None, int | None, tuple[str, ...]]:
    """The axis of an array's planes, the chosen plane (from 0), each or None, and remarks.

    Without an explicit choice, three planes are colours to sum. Raises `BadFile` for another number
    of axes, and for several planes without a choice.
    """
    number = None if choice is None else choice.removeprefix(":")
    if len(shape) == 2:
        chosen_image([Subfile(shape[1], shape[0])], number)
        return None, None, ()
    is_stack = len(shape) == 3 and 1 <= shape[0] <= MAX_IMAGES
    if not is_stack and not (len(shape) == 3 and shape[2] == COLOURS):
        message = "must have two dimensions, rows and columns, or a third of three colours"
        raise bad_frame(message, str(shape)[:80])
    if number is None and COLOURS in (shape[0], shape[2]):
        axis = 2 if shape[2] == COLOURS else 0
        return axis, None, ("image: its three planes were summed as colours",)
    if not is_stack:
        raise bad_frame("holds one image in colour; there is none to choose", choice)
    plane, remarks = chosen_image([Subfile(shape[2], shape[1])] * shape[0], number)
    return 0, plane, remarks


def as_counts(values: npt.NDArray[Any]) -> CountArray:
    """Pixel values as counts: float32 where that is exact, else float64, in native byte order."""
    exact = values.dtype.itemsize <= 2 or values.dtype.str[1:] == "f4"
    return np.ascontiguousarray(values, dtype=np.float32 if exact else np.float64)


LEAST_FILL, FILL_GAP = 64, 4.0
"""Least number of pixels with a fill value, and its least distance from all other counts, in
spans of these.
"""


def without_fill(frame: Frame) -> Frame:
    """A frame of floating-point counts with NaN for a fill value, which a remark then names.

    A fill value, such as -32768 or 1e20 beside counts of 0 to 1, is the least or largest count of
    many pixels, far from all others. Single precision would lose the others beside it.
    """
    if not math.isinf(frame.full_scale):
        return frame
    counts, remarks = frame.counts, []
    for lowest in (True, False):
        known = counts[np.isfinite(counts)]
        if not known.size:
            break
        value = known.min() if lowest else known.max()
        rest = known[known != value]
        number = known.size - rest.size
        if number < LEAST_FILL or not rest.size > number:
            continue
        least, most = float(rest.min()), float(rest.max())
        gap = least - float(value) if lowest else float(value) - most
        if gap > FILL_GAP * (most - least) > 0.0:
            counts = np.where(counts == value, np.nan, counts).astype(counts.dtype)
            remarks.append(f"fill: {number} pixels hold {value:g}, which was taken for no number")
    return replace(frame, counts=counts, remarks=(*frame.remarks, *remarks)) if remarks else frame


def full_scale_of(dtype: np.dtype[Any]) -> float:
    """The largest number of an integer type; infinite for floating-point types."""
    return float(np.iinfo(dtype).max) if dtype.kind in "iu" else math.inf


Reader = Callable[[BoundedFile, FrameLimits, str], Frame]

FORMATS = "FITS, TIFF, PNG, JPEG, GIF, BMP, PGM, a camera's raw file or a numpy array (.npy)"
_BOXES = b"ftyp"
"""The fifth to eighth byte of files of boxes (ISO 14496-12)."""
_PDS3 = "a PDS3 file; write its image as FITS, TIFF or .npy (with pdr, GDAL or ISIS)"
OTHERS: Mapping[bytes, str] = {
    b"LUCAM-RECORDER": "a SER video; export one frame of it as FITS or TIFF",
    b"XISF0100": "an XISF file; save it as FITS or TIFF of 16 bits",
    b"PDS_VERSION_ID": _PDS3,
    b"ODL_VERSION_ID": _PDS3,
    b"CCSD3ZF": _PDS3,
    b"<?xml": "an XML label, as of PDS4; write its image as FITS, TIFF or .npy (with pdr)",
    **dict.fromkeys(
        (b"BZh", b"\xfd7zXZ", b"\x28\xb5\x2f\xfd", b"\x1f\x9d", b"PK\x03\x04", b"7z\xbc\xaf"),
        "packed (bzip2, xz, Zstandard, .Z, zip or 7z); unpack it, or pack it with gzip",
    ),
    b"RIFF": "a WebP picture or a video; save it as PNG or TIFF",
    _BOXES: "a HEIC or AVIF picture, or a video; save it as PNG or TIFF",
    b"\x89HDF": "an HDF5 file; write its image as FITS, TIFF or .npy",
}
"""Advice on image formats that are recognised by their first bytes but not read."""
MORE_BYTES, BYTES_PER_PIXEL = 64 << 20, 24
"""Margin in bytes, and bytes per pixel, in the size limit of a decompressed file."""
_BLOCK_BYTES = 1 << 20
_LONGEST_MAGIC = 16
_GZIP = b"\x1f\x8b"


def read_frame(file: IO[bytes], limits: FrameLimits, digest: str | None = None) -> Frame:
    """The frame in a seekable file; `digest` is passed where it is known already.

    Raises `BadFile` for a file that is no frame, or a frame beyond the limits.
    """
    digest = digest or frame_digest(file)
    bounded = BoundedFile(file)
    start = bounded.read(_LONGEST_MAGIC)
    if not start:
        raise bad_frame("is empty; it must hold a file: " + FORMATS)
    if not start.startswith(_GZIP):
        return _read_by_magic(bounded, start, limits, digest)
    with _unzipped(bounded, limits) as unzipped:
        start = unzipped.read(_LONGEST_MAGIC)
        if start.startswith(_GZIP):
            raise bad_frame("is compressed more than once")
        return _read_by_magic(unzipped, start, limits, digest)


def _read_by_magic(file: BoundedFile, start: bytes, limits: FrameLimits, digest: str) -> Frame:
    """The frame in a file whose first bytes are `start`; raises `BadFile`."""
    if is_raw(file, start):
        file.seek(0)
        return read_raw(file, limits, digest)
    for magics, reader in _READERS.items():
        if start.startswith(magics):
            file.seek(0)
            with decoding("the picture that its first bytes name"):
                return without_fill(reader(file, limits, digest))
    for magic, words in OTHERS.items():
        if start.startswith(magic) or (magic == _BOXES and start[4:8] == magic):
            raise bad_frame(f"is {words}")
    raise bad_frame(f"is not {FORMATS}", f"its first bytes are {start[:8].hex(' ')}")


@contextmanager
def _unzipped(file: BoundedFile, limits: FrameLimits) -> Iterator[BoundedFile]:
    """Content of a gzip file, in a temporary file; raises `BadFile` if too large for a frame."""
    rows, columns = limits.shape or (limits.max_pixels, 1)
    most = MORE_BYTES + BYTES_PER_PIXEL * min(rows * columns, limits.max_pixels)
    file.seek(0)
    with tempfile.TemporaryFile() as target:
        try:
            with gzip.GzipFile(fileobj=file) as source:
                while block := source.read(_BLOCK_BYTES):
                    if target.tell() + len(block) > most:
                        raise bad_frame(f"unfolds into more than {most >> 20} MB")
                    target.write(block)
        except (OSError, EOFError, zlib.error) as error:
            raise bad_frame(f"cannot be read as gzip: {str(error)[:100]}") from None
        yield BoundedFile(target)


def frame_digest(file: IO[bytes]) -> str:
    """The SHA-256 digest of a file's content, with the prefix `sha256:`."""
    file.seek(0)
    return "sha256:" + hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]


def _later(name: str, *arguments: str) -> Reader:
    """A reader function imported by name at its first call, to keep the service's start fast."""

    def read(file: BoundedFile, limits: FrameLimits, digest: str) -> Frame:
        frame: Frame = resolve_name(f"service.features.pictures.frames.{name}")(
            file, *arguments, limits, digest
        )
        return frame

    return read


_READERS: Mapping[tuple[bytes, ...], Reader] = {
    (b"SIMPLE  =",): _later("fits:read_fits"),
    (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"): _later("tiff:read_tiff"),
    (b"\x89PNG\r\n\x1a\n",): _later("pictures:read_picture", "PNG"),
    (b"\xff\xd8\xff",): _later("pictures:read_picture", "JPEG"),
    (b"GIF87a", b"GIF89a"): _later("pictures:read_picture", "GIF"),
    (b"BM",): _later("pictures:read_picture", "BMP"),
    (b"P2", b"P3", b"P5", b"P6"): _later("pictures:read_picture", "PGM"),
    (b"\x93NUMPY",): read_npy,
}


# Frames from the raw files of cameras, through LibRaw (installed by the extra `raw`). The pixels of
# a colour filter array are summed, so that one count has light of all its colours.

ABSENT = (
    "is a camera's raw file, which needs the package rawpy: install the extra `raw` "
    "(pip install '.[raw]'), or convert the file to TIFF of 16 bits"
)
MAGICS = (b"FUJIFILMCCD-RAW", b"IIRO", b"IIRS", b"MMOR", b"IIU\0")
_CR2, _CR3 = b"CR", b"ftypcrx "
_REDUCED, _SUB_DIRECTORIES, _DNG_VERSION = 254, 330, 50706
_MAX_TAGS = 256


def is_raw(file: BoundedFile, start: bytes) -> bool:
    """True for a camera's raw file, also one based on TIFF; `start` are its first bytes."""
    if start.startswith(MAGICS) or start[4:12] == _CR3:
        return True
    if not start.startswith((b"II*\0", b"MM\0*")):
        return False
    return start[8:10] == _CR2 or _has_tags_of_raw(file, "<" if start[:2] == b"II" else ">")


def _has_tags_of_raw(file: BoundedFile, order: str) -> bool:
    """True for a TIFF with a DNG version, or with a reduced picture and the full one inside."""
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


def read_raw(file: BoundedFile, limits: FrameLimits, digest: str) -> Frame:
    """The frame in a camera's raw file; raises `BadFile` with the reason if it cannot be read."""
    if limits.image not in (None, "1"):
        raise bad_frame("is a camera's raw file; there is no image to choose", limits.image)
    if not importlib.util.find_spec("rawpy"):
        raise bad_frame(ABSENT)
    import rawpy

    with decoding("a raw file"), rawpy.imread(file) as raw:
        sizes = raw.sizes
        pattern = raw.raw_pattern
        step = 1 if pattern is None else len(pattern)
        if sizes.raw_width * sizes.raw_height > step**2 * limits.max_pixels:
            limits.require(sizes.raw_width // step, sizes.raw_height // step)
        limits.require(sizes.width // step, sizes.height // step)
        values = raw.raw_image_visible
        if values is None or values.ndim != 2:
            raise bad_frame("holds colours that are already mixed; convert it to TIFF of 16 bits")
        rows, columns = (side // step for side in values.shape)
        blocks = values[: rows * step, : columns * step].reshape(rows, step, columns, step)
        counts = blocks.sum(axis=(1, 3), dtype=np.uint32)
        full_scale = float(step**2 * raw.white_level)
        shutter_s = float(getattr(raw.other, "shutter", 0.0) or 0.0)
    exposure_s = shutter_s if 0.0 < shutter_s <= 3600.0 else None
    return Frame(
        *(as_counts(counts), "RAW", digest, full_scale, None, exposure_s),
        remarks=tuple(timing_remarks(None, exposure_s)),
    )
