"""EXIF of pictures, read only if small: time, exposure, and orientation for display.

Pillow turns every number of an EXIF directory into an object, twenty times as large as the number
in the file.
"""

import io
import re
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from service.features.pictures.frames.bounded_file import BoundedFile
from service.features.pictures.frames.frame import AS_STORED, CountArray, Frame, bad_frame

MAX_EXIF_BYTES = 1 << 20
_TYPE_BYTES = (8, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4, 8, 8, 8, 8, 8)
"""Sizes in bytes of the TIFF data types, indexed by type number; type 0 does not exist."""
_EXIF, _EXPOSURE, _TAKEN, _OFFSET, _FRACTION = 0x8769, 33434, 36867, 36881, 37521
_LONGEST_EXPOSURE_S = 3600.0
_TIME = re.compile(r"(\d{4}):(\d\d):(\d\d) (\d\d):(\d\d):(\d\d)")
_POINTERS = (_EXIF, 0x8825, 0xA005)
"""EXIF tags that point to a further directory: EXIF, GPS, interoperability."""
_MARK = b"Exif\0\0"
_MAX_SEGMENTS = MAX_EXIF_BYTES // 65536
_BLOCK_BYTES = 1 << 20


class Entry(NamedTuple):
    """One tag of a TIFF directory, with the bytes (4 or 8) of its value or value's offset."""

    tag: int
    kind: int
    number: int
    value: bytes

    @property
    def size_bytes(self) -> int:
        """The size in bytes of all numbers of a TIFF tag, also of an unknown kind."""
        known = self.kind < len(_TYPE_BYTES)
        return self.number * (_TYPE_BYTES[self.kind] if known else 8)

    def whole(self, order: str) -> int:
        """The value of a TIFF tag that holds one whole number."""
        is_long = len(self.value) == 8 and self.kind not in (3, 4)
        form = "H" if self.kind == 3 else "Q" if is_long else "L"
        return int(struct.unpack_from(order + form, self.value)[0])


def directory(file: BoundedFile, order: str, at: int, big: bool = False) -> list[Entry]:
    """The entries of a TIFF directory at an offset; raises `struct.error` if cut off or huge."""
    file.seek(at)
    (count,) = struct.unpack(order + ("Q" if big else "H"), file.read(8 if big else 2))
    form, size = (order + "HHQ8s", 20) if big else (order + "HHL4s", 12)
    if count > 65535:
        raise struct.error("no directory has so many entries")
    return [Entry(*struct.unpack(form, file.read(size))) for _ in range(count)]


def bytes_beyond(
    file: BoundedFile, order: str, entries: list[Entry], depth: int = 2, big: bool = False
) -> int:
    """The total size of the tags in all directories that a TIFF's entries point to, recursively."""
    total = 0
    # Of several entries with one tag the first counts.
    for tag, entry in {entry.tag: entry for entry in reversed(entries)}.items():
        if tag in _POINTERS and entry.number == 1:
            with suppress(struct.error):
                inside = directory(file, order, entry.whole(order), big)
                total += sum(each.size_bytes for each in inside)
                total += bytes_beyond(file, order, inside, depth - 1, big) if depth > 1 else 0
    return total


def require_small_exif(file: BoundedFile) -> None:
    """Raise `BadFile` for a JPEG with too much EXIF, part of which Pillow reads on opening.

    One segment has up to 64 KiB; Pillow joins all segments.
    """
    file.seek(0)
    found, before = 0, b""
    while block := file.read(_BLOCK_BYTES):
        found += (before + block).count(_MARK)
        before = block[1 - len(_MARK) :]
    if found > _MAX_SEGMENTS:
        raise bad_frame(f"has more than {MAX_EXIF_BYTES} bytes of EXIF", f"{found} pieces")
    file.seek(0)


def exif_of(image: Any) -> Mapping[int, Any]:
    """EXIF tags of an image; empty if there are none, if they are too large, or cannot be read."""
    if not _is_small(image):
        return {}
    try:
        exif: Mapping[int, Any] = image.getexif()
    except Exception:
        # Pillow raises many kinds of errors for broken EXIF. The picture is solved without EXIF.
        return {}
    return exif


def timing_remarks(time: str | None, exposure_s: float | None) -> list[str]:
    """Remarks that name the EXIF tags from which the time and the exposure of a picture come."""
    remarks = []
    if time is not None:
        source = "EXIF DateTimeOriginal (start of the exposure)"
        remarks.append(f"time_of_file: {time}, mid exposure, from {source}")
    if exposure_s is not None:
        remarks.append(f"exposure_of_file: {exposure_s:.6g} s, from EXIF ExposureTime")
    return remarks


def exposure_of(image: Any) -> tuple[str | None, float | None]:
    """UTC of mid exposure, and exposure in seconds, from EXIF; each None if missing.

    A camera's clock without its offset from UTC gives no time.
    """
    try:
        exif = exif_of(image).get_ifd(_EXIF)  # type: ignore[attr-defined]
    except Exception:
        return None, None
    return exif_exposure(*(exif.get(tag) for tag in (_TAKEN, _OFFSET, _FRACTION, _EXPOSURE)))


def exif_exposure(
    taken: object, offset: object, fraction: object, exposure: Any
) -> tuple[str | None, float | None]:
    """The UTC of mid exposure, and the exposure in seconds, from four EXIF values; None if bad."""
    exposure_s = None
    with suppress(TypeError, ValueError, ZeroDivisionError, OverflowError):
        pair = exposure if isinstance(exposure, tuple) else (exposure, 1)
        value = float(pair[0]) / float(pair[1])
        exposure_s = value if 0.0 < value <= _LONGEST_EXPOSURE_S else None
    return _utc(taken, offset, fraction, exposure_s), exposure_s


def _utc(taken: object, offset: object, fraction: object, exposure_s: float | None) -> str | None:
    from datetime import UTC, datetime, timedelta, timezone

    found = _TIME.match(taken) if isinstance(taken, str) else None
    zone = re.match(r"([+-])(\d\d):(\d\d)", offset) if isinstance(offset, str) else None
    if found is None or zone is None:
        return None
    digits = re.match(r"\d{1,9}", fraction) if isinstance(fraction, str) else None
    seconds = float(f"0.{digits[0]}") if digits else 0.0
    try:
        minutes = (60 * int(zone[2]) + int(zone[3])) * (-1 if zone[1] == "-" else 1)
        year, month, day, hour, minute, second = map(int, found.groups())
        offset_utc = timezone(timedelta(minutes=minutes))
        local = datetime(year, month, day, hour, minute, second, tzinfo=offset_utc)
        middle = local.astimezone(UTC) + timedelta(seconds=seconds + 0.5 * (exposure_s or 0.0))
    except (ValueError, OverflowError):
        return None
    return middle.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"


def _is_small(image: Any) -> bool:
    """True unless an image's EXIF block is too large to be parsed."""
    exif = image.info.get("exif", b"")
    if len(exif) > MAX_EXIF_BYTES:
        return False
    block = exif.removeprefix(_MARK)
    order = "<" if block[:2] == b"II" else ">"
    file = BoundedFile(io.BytesIO(block))
    try:
        entries = directory(file, order, *struct.unpack(order + "4xL", file.read(8)))
    except struct.error:
        return True
    total = sum(entry.size_bytes for entry in entries)
    return total + bytes_beyond(file, order, entries) <= MAX_EXIF_BYTES


TAG = 274
_TURNS: Mapping[int, str] = {
    2: "left and right exchanged",
    3: "turned by 180 deg",
    4: "top and bottom exchanged",
    5: "rows and columns exchanged",
    6: "turned by 90 deg clockwise",
    7: "rows and columns exchanged, then turned by 180 deg",
    8: "turned by 90 deg counterclockwise",
}
"""EXIF orientations in words: from the stored to the shown picture (EXIF 2.32, 4.6.4)."""


def as_shown(counts: CountArray, tag: object) -> tuple[CountArray, str]:
    """Counts (rows, columns) turned for display by an EXIF orientation, and the turn in words.

    An unknown orientation counts as 1, as in viewers.
    """
    if not isinstance(tag, int) or tag not in _TURNS:
        return counts, AS_STORED
    shown = counts.T if tag in (5, 7) else counts
    if tag in (3, 7):
        shown = shown[::-1, ::-1]
    elif tag in (2, 4):
        shown = shown[:, ::-1] if tag == 2 else shown[::-1]
    elif tag in (6, 8):
        shown = np.rot90(shown, -1 if tag == 6 else 1)
    return np.ascontiguousarray(shown), f"as shown: {_TURNS[tag]} (orientation tag {tag})"


def is_by_rows(frame: Frame) -> bool:
    """True for a frame whose mirror image reverses the rows, false if it reverses the columns.

    FITS files store the lowest row first; readers that begin at the top mirror the picture.
    """
    return frame.file_format == "FITS"


def mirrored(frame: Frame) -> Frame:
    """The mirror image of a frame, noted in its orientation."""
    by_rows = is_by_rows(frame)
    counts = frame.counts[::-1] if by_rows else frame.counts[:, ::-1]
    how = "top and bottom" if by_rows else "left and right"
    before = f"{frame.orientation}; " if frame.is_turned else ""
    return replace(
        frame,
        counts=np.ascontiguousarray(counts),
        orientation=f"{before}mirrored: {how} exchanged, because the sky fits only so",
        is_mirrored=True,
    )
