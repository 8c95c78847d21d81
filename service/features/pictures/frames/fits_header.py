"""Headers of FITS files (FITS Standard 4.0): their cards, and the images that they describe."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import IO

from service.features.pictures.frames.bounded_file import BoundedFile
from service.features.pictures.frames.frame import bad_frame

BLOCK, CARD = 2880, 80
MAX_HEADER_BLOCKS = 128
MAX_UNITS = 256

TYPES = {8: ">u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}

Value = bool | int | float | str | None


@dataclass(frozen=True)
class Header:
    """A FITS header: the values of its cards by keyword, and the comments that are not empty.

    `notes` are the texts of its COMMENT and HISTORY cards.
    """

    cards: dict[str, Value]
    comments: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def whole(self, key: str, default: int | None = None, least: int = 0) -> int:
        """The whole number of a header keyword; raises `BadFile` for any other value."""
        value = self._value(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value < 1 << 40:
            raise bad_frame(f"has a FITS header with an impossible {key}", str(value)[:40])
        return value

    def number(self, key: str, default: float) -> float:
        """The finite number of a header keyword; raises `BadFile` for any other value."""
        value = self._value(key, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise bad_frame(f"has a FITS header with an impossible {key}", str(value)[:40])
        if not abs(value) < 1e30:
            raise bad_frame(f"has a FITS header with an impossible {key}", str(value)[:40])
        return float(value)

    def _value(self, key: str, default: Value) -> Value:
        # A card without a value counts as absent (FITS 4.0, 4.1.2.3).
        value = self.cards.get(key)
        return default if value is None else value

    def behind(self, primary: "Header") -> "Header":
        """A header with the cards that it lacks taken from the primary header."""
        notes = self.notes if primary is self else [*self.notes, *primary.notes]
        return Header(primary.cards | self.cards, primary.comments | self.comments, notes)

    @property
    def is_compressed(self) -> bool:
        """True for the header of a table that holds an image in compressed tiles."""
        return self.cards.get("ZIMAGE") is True

    @property
    def axes(self) -> list[int]:
        """The lengths of the data's axes in a FITS header, the fastest axis first."""
        return self._axes("NAXIS")

    @property
    def image_axes(self) -> list[int]:
        """The lengths of the image's axes in a FITS header, without trailing axes of length one."""
        axes = self._axes("ZNAXIS" if self.is_compressed else "NAXIS")
        while len(axes) > 2 and axes[-1] == 1:
            axes.pop()
        return axes

    def _axes(self, key: str) -> list[int]:
        count = self.whole(key)
        if count > 999:
            raise bad_frame(f"has a FITS header with an impossible {key}", str(count))
        return [self.whole(f"{key}{k + 1}") for k in range(count)]

    @property
    def bitpix(self) -> int:
        """The bits per number of a FITS image, negative for floating-point numbers."""
        value = self.whole("ZBITPIX" if self.is_compressed else "BITPIX", least=-64)
        if value not in TYPES:
            known = ", ".join(str(each) for each in TYPES)
            raise bad_frame(f"has a FITS header whose BITPIX is none of {known}", str(value))
        return value

    @property
    def is_image(self) -> bool:
        """True for the header of an image of two or more dimensions, compressed or not."""
        kind = self.cards.get("XTENSION", "IMAGE")
        if not self.is_compressed and (kind != "IMAGE" or self.cards.get("GROUPS") is True):
            return False
        return len(self.image_axes) >= 2 and 0 not in self.image_axes

    @property
    def name(self) -> str:
        """The name (EXTNAME) of a FITS unit, in capitals; empty without one."""
        return str(self.cards.get("EXTNAME") or "").strip().upper()

    @property
    def data_bytes(self) -> int:
        """The length in bytes of a FITS unit's data (4.4.1.1)."""
        axes = self.axes
        if not axes:
            return 0
        numbers = 1
        for length in axes:
            # For absurd lengths the product need not be exact to exceed the file's size.
            numbers = min(numbers * length, 1 << 60)
        numbers = self.whole("GCOUNT", 1) * (self.whole("PCOUNT", 0) + numbers)
        bits = self.whole("BITPIX", least=-64)
        return min(abs(bits) // 8 * numbers, 1 << 62)


@dataclass(frozen=True)
class Unit:
    """One header and data unit of a FITS file: number from 0, header, and offset of the data."""

    number: int
    header: Header
    start: int


def units_of(file: BoundedFile) -> Iterator[Unit]:
    """Header and data units of a FITS file in sequence; raises `BadFile` for a broken header."""
    at = 0
    for number in range(MAX_UNITS):
        file.seek(at)
        # Other bytes after the last extension are no unit (3.5).
        if not file.left or (number and file.read(8) != b"XTENSION"):
            return
        file.seek(at)
        header = read_header(file)
        unit = Unit(number, header, file.tell())
        yield unit
        at = unit.start + -(-header.data_bytes // BLOCK) * BLOCK


def read_header(file: BoundedFile) -> Header:
    """The FITS header at the present offset of a file; the first of equal keywords counts."""
    header = Header({})
    for _ in range(MAX_HEADER_BLOCKS):
        block = file.read(BLOCK)
        if len(block) < BLOCK:
            raise bad_frame("is cut off in its FITS header")
        for at in range(0, BLOCK, CARD):
            card = block[at : at + CARD].decode("latin-1")
            key = card[:8].rstrip()
            if key == "END":
                return header
            if key in ("COMMENT", "HISTORY"):
                header.notes.append(card[8:].strip())
            elif card[8:10] == "= " and key not in header.cards:
                header.cards[key], comment = _value(card[10:])
                if comment:
                    header.comments[key] = comment
    raise bad_frame(f"has a FITS header without END in its first {MAX_HEADER_BLOCKS} blocks")


def _value(text: str) -> tuple[Value, str]:
    """The value and the comment of a FITS header card; the value is None if it cannot be parsed."""
    text = text.strip()
    if text.startswith("'"):
        inner, at = "", 1
        while at < len(text):
            if text[at] == "'":
                if text[at + 1 : at + 2] != "'":
                    break
                at += 1
            inner, at = inner + text[at], at + 1
        return inner.rstrip(), text[at + 1 :].partition("/")[2].strip()
    word, _, comment = (part.strip() for part in text.partition("/"))
    if word in ("T", "F"):
        return word == "T", comment
    try:
        return int(word), comment
    except ValueError:
        pass
    try:
        return float(word.upper().replace("D", "E")), comment
    except ValueError:
        return None, comment


def write_header(file: IO[bytes], cards: Mapping[str, bool | int | float | str]) -> None:
    """Write a FITS header with the given cards, padded to whole blocks."""
    text = "".join(_card(key, value) for key, value in cards.items()) + "END".ljust(CARD)
    file.write(text.encode("latin-1").ljust(-(-len(text) // BLOCK) * BLOCK))


def _card(key: str, value: bool | int | float | str) -> str:
    if isinstance(value, bool):
        shown = f"{'T' if value else 'F':>20}"
    elif isinstance(value, str):
        shown = "'" + value.replace("'", "''").ljust(8) + "'"
    else:
        shown = f"{value!r:>20}".upper()
    return f"{key:<8}= {shown}".ljust(CARD)[:CARD]
