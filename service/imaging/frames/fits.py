"""Frames from FITS files (FITS Standard 4.0), and to them: images, without tile compression.

The first header unit that holds an image of two dimensions is taken.
"""

import os
from dataclasses import dataclass
from typing import IO

import numpy as np

from service.errors import BadInput
from service.imaging.frames.arrays import as_counts, exactly
from service.imaging.frames.frame import CountArray, Frame, FrameLimits, bad_frame
from service.times import parse_utc, shifted

BLOCK, CARD = 2880, 80
MAX_HEADER_BLOCKS = 64
MAX_UNITS = 16

TYPES = {8: ">u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}

Value = bool | int | float | str | None


def read_fits(file: IO[bytes], limits: FrameLimits, digest: str) -> Frame:
    """The frame in a FITS file; raises `BadFile` with what is wrong with it."""
    end = file.seek(0, os.SEEK_END)
    file.seek(0)
    for _ in range(MAX_UNITS):
        if file.tell() >= end:
            break
        unit = _Unit(_read_header(file))
        if unit.is_compressed:
            raise bad_frame("is compressed by tiles; send the plain image", "ZIMAGE = T")
        if unit.is_image:
            return _image(file, unit, limits, digest)
        file.seek(file.tell() + -(-unit.data_bytes // BLOCK) * BLOCK)
    raise bad_frame("holds no image of two dimensions")


def write_fits(
    file: IO[bytes], counts: CountArray, cards: dict[str, bool | int | float | str]
) -> None:
    """Write counts, unsigned 16-bit integers, with further cards, as a FITS file."""
    height_px, width_px = counts.shape
    # FITS has signed integers only: the zero lies in the middle (4.4.2.5).
    header: dict[str, bool | int | float | str] = {
        "SIMPLE": True, "BITPIX": 16, "NAXIS": 2, "NAXIS1": width_px, "NAXIS2": height_px,
        "BZERO": 32768, "BSCALE": 1, **cards,
    }  # fmt: skip
    text = "".join(_card(key, value) for key, value in header.items()) + "END".ljust(CARD)
    file.write(text.encode("ascii").ljust(-(-len(text) // BLOCK) * BLOCK))
    data = (counts.astype(np.int32) - 32768).astype(">i2").tobytes()
    file.write(data.ljust(-(-len(data) // BLOCK) * BLOCK, b"\0"))


@dataclass(frozen=True)
class _Unit:
    """One header of a file, by keyword."""

    cards: dict[str, Value]

    def whole(self, key: str, default: int | None = None, least: int = 0) -> int:
        """A whole number of the header; raises `BadFile` for anything else."""
        value = self.cards.get(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value < 1 << 40:
            raise bad_frame(f"has a FITS header with an impossible {key}", str(value)[:40])
        return value

    def number(self, key: str, default: float) -> float:
        """A finite number of the header."""
        value = self.cards.get(key, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise bad_frame(f"has a FITS header with an impossible {key}", str(value)[:40])
        if not abs(value) < 1e30:
            raise bad_frame(f"has a FITS header with an impossible {key}", str(value)[:40])
        return float(value)

    @property
    def axes(self) -> list[int]:
        """The lengths of its axes, the fastest first."""
        count = self.whole("NAXIS")
        if count > 999:
            raise bad_frame("has a FITS header with an impossible NAXIS", str(count))
        return [self.whole(f"NAXIS{k + 1}") for k in range(count)]

    @property
    def bitpix(self) -> int:
        """Bits of a number, negative for floating ones."""
        value = self.whole("BITPIX", least=-64)
        if value not in TYPES:
            known = ", ".join(str(each) for each in TYPES)
            raise bad_frame(f"has a FITS header whose BITPIX is none of {known}", str(value))
        return value

    @property
    def is_image(self) -> bool:
        """Whether it has two dimensions, further ones of length one aside."""
        kind = self.cards.get("XTENSION", "IMAGE")
        axes = self.axes
        return kind == "IMAGE" and len(axes) >= 2 and all(length == 1 for length in axes[2:])

    @property
    def is_compressed(self) -> bool:
        """Whether it is a table that holds an image in compressed tiles."""
        return self.cards.get("ZIMAGE") is True

    @property
    def data_bytes(self) -> int:
        """The length of its data (4.4.1.1)."""
        axes = self.axes
        if not axes:
            return 0
        numbers = 1
        for length in axes:
            # A product of absurd lengths need not be exact to be beyond the file.
            numbers = min(numbers * length, 1 << 60)
        numbers = self.whole("GCOUNT", 1) * (self.whole("PCOUNT", 0) + numbers)
        return min(abs(self.bitpix) // 8 * numbers, 1 << 62)


def _image(file: IO[bytes], unit: _Unit, limits: FrameLimits, digest: str) -> Frame:
    width_px, height_px = unit.axes[:2]
    limits.require(width_px, height_px)
    kind = np.dtype(TYPES[unit.bitpix])
    zero, scale = unit.number("BZERO", 0.0), unit.number("BSCALE", 1.0)
    if scale == 0.0:
        raise bad_frame("has a FITS header with an impossible BSCALE", "0")
    data = exactly(file, width_px * height_px * kind.itemsize)
    stored = np.frombuffer(data, kind).reshape(height_px, width_px)
    counts = as_counts(stored)
    if (scale, zero) != (1.0, 0.0):
        counts = (counts * scale + zero).astype(counts.dtype, copy=False)
    full_scale = np.inf
    if kind.kind in "iu":
        full_scale = max(float(np.iinfo(kind).max) * scale, float(np.iinfo(kind).min) * scale)
        full_scale += zero
        if "BLANK" in unit.cards:
            counts[stored == unit.whole("BLANK", least=-(1 << 40))] = np.nan
    time, exposure_s = _when(unit)
    return Frame(counts, "FITS", digest, full_scale, time, exposure_s)


def _when(unit: _Unit) -> tuple[str | None, float | None]:
    """Mid exposure in UTC and the exposure in seconds, each None where the header does not tell."""
    exposure = unit.cards.get("XPOSURE", unit.cards.get("EXPTIME"))
    exposure_s = None
    if isinstance(exposure, (int, float)) and 0.0 < exposure <= 3600.0:
        exposure_s = float(exposure)
    if str(unit.cards.get("TIMESYS", "UTC")).strip().upper() != "UTC":
        return None, exposure_s
    try:
        if isinstance(average := unit.cards.get("DATE-AVG"), str):
            return parse_utc(_zulu(average)).text, exposure_s
        if isinstance(start := unit.cards.get("DATE-OBS"), str) and exposure_s is not None:
            return shifted(parse_utc(_zulu(start)), exposure_s / 2.0).text, exposure_s
    except BadInput:
        # What cannot be read is not there: the client is then asked for the time.
        pass
    return None, exposure_s


def _zulu(text: str) -> str:
    text = text.strip()
    return text if text.endswith("Z") else text + "Z"


def _read_header(file: IO[bytes]) -> dict[str, Value]:
    """The cards of one header; the first of equal keywords counts."""
    cards: dict[str, Value] = {}
    for _ in range(MAX_HEADER_BLOCKS):
        block = file.read(BLOCK)
        if len(block) < BLOCK:
            raise bad_frame("is cut off in its FITS header")
        for at in range(0, BLOCK, CARD):
            card = block[at : at + CARD].decode("latin-1")
            key = card[:8].rstrip()
            if key == "END":
                return cards
            if card[8:10] == "= ":
                cards.setdefault(key, _value(card[10:]))
    raise bad_frame(f"has a FITS header without END in its first {MAX_HEADER_BLOCKS} blocks")


def _value(text: str) -> Value:
    """The value of a card; None for what is no value."""
    text = text.strip()
    if text.startswith("'"):
        inner, at = "", 1
        while at < len(text):
            if text[at] == "'":
                if text[at + 1 : at + 2] != "'":
                    break
                at += 1
            inner, at = inner + text[at], at + 1
        return inner.rstrip()
    word = text.partition("/")[0].strip()
    if word in ("T", "F"):
        return word == "T"
    try:
        return int(word)
    except ValueError:
        pass
    try:
        return float(word.replace("D", "E"))
    except ValueError:
        return None


def _card(key: str, value: bool | int | float | str) -> str:
    if isinstance(value, bool):
        shown = f"{'T' if value else 'F':>20}"
    elif isinstance(value, str):
        shown = "'" + value.replace("'", "''").ljust(8) + "'"
    else:
        shown = f"{value!r:>20}".upper()
    return f"{key:<8}= {shown}".ljust(CARD)[:CARD]
