"""Files of space packets and their XTCE file in one tar archive, as they are uploaded.

The archive is read by its plain headers (POSIX ustar): nothing is unpacked, and no header
decides how much is held in memory.  Extended headers are passed over.
"""

import io
import os
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from service.errors import BadFile, BadInput, Fault, shown_value
from service.missions.mission import Mission
from service.observations.readers.decompress import Line
from service.packets.definition import PacketDefinition
from service.packets.mapping import packet_mission
from service.packets.reader import PacketReader, PacketTotals
from service.packets.xtce_file import MAX_BYTES

BLOCK_BYTES = 512
MAX_MEMBERS = 1_000
PIECE_BYTES = 1 << 18
XTCE_SUFFIXES = (".xml", ".xtce")
MEDIA_TYPE = "application/x-tar"

_REGULAR, _FOLDER, _EXTENDED = b"\x000", b"5", b"xgLK"
_FIELD = "body"


@dataclass(frozen=True)
class Member:
    """A file of an archive."""

    name: str
    offset: int
    size: int


def members_of(file: IO[bytes]) -> list[Member]:
    """The files of an archive, in order; raises `BadFile` naming the byte of a bad header."""
    end = file.seek(0, io.SEEK_END)
    offset = 0
    found: list[Member] = []
    while True:
        file.seek(offset)
        header = file.read(BLOCK_BYTES)
        if not header.strip(b"\0"):
            return found
        size, kind = _checked(header, offset)
        start = offset + BLOCK_BYTES
        if start + size > end:
            message = f"ends within the member at byte {offset}, which has {size} bytes"
            raise BadFile(Fault(_FIELD, message))
        name = header[:100].split(b"\0", 1)[0].decode("utf-8", "replace")
        if kind in _REGULAR:
            found.append(Member(Path(name).name, start, size))
        elif kind not in _FOLDER + _EXTENDED:
            message = f"holds {shown_value(name)} at byte {offset}, which is no plain file"
            raise BadFile(Fault(_FIELD, message))
        if len(found) > MAX_MEMBERS:
            raise BadFile(Fault(_FIELD, f"holds more than {MAX_MEMBERS} files"))
        offset = start + -(-size // BLOCK_BYTES) * BLOCK_BYTES


def _checked(header: bytes, offset: int) -> tuple[int, bytes]:
    """Size and kind of a member; raises `BadFile` for what is no header of an archive."""
    try:
        if len(header) < BLOCK_BYTES or header[257:262] != b"ustar":
            raise ValueError
        size, checksum = _octal(header[124:136]), _octal(header[148:156])
    except ValueError:
        message = f"is no tar archive (POSIX ustar): there is no header at byte {offset}"
        raise BadFile(Fault(_FIELD, message)) from None
    # The sum counts its own field as blanks.
    if checksum != sum(header[:148]) + 8 * 32 + sum(header[156:]):
        raise BadFile(Fault(_FIELD, f"has a header with a wrong checksum at byte {offset}"))
    return size, header[156:157]


def _octal(digits: bytes) -> int:
    text = digits.strip(b"\0 ")
    if not text.isdigit():
        raise ValueError(digits)
    return int(text, 8)


class PacketLines:
    """The batches of an uploaded archive as lines; iterated once, and closed at the end."""

    def __init__(
        self, file: IO[bytes], missions: Mapping[str, Mission], spacecraft: str | None
    ) -> None:
        """Raises `BadInput` for an archive, an XTCE file or a mapping that cannot be read.

        Without `spacecraft` the only mission with a table `[packets]` is taken.
        """
        self._file = file
        mission = packet_mission(missions, spacecraft)
        self.spacecraft = mission.name
        members = [each for each in members_of(file) if not each.name.startswith("._")]
        xtce = [each for each in members if each.name.lower().endswith(XTCE_SUFFIXES)]
        self._packets = [each for each in members if each not in xtce]
        if len(xtce) != 1 or not self._packets:
            names = ", ".join(each.name for each in members[:20]) or "nothing"
            message = "must hold one XTCE file (.xml or .xtce) and files of packets; it holds "
            raise BadInput(Fault(_FIELD, message + names))
        assert mission.packets is not None
        text = _Part(file, xtce[0]).read(MAX_BYTES + 1)
        definition = PacketDefinition(text, xtce[0].name, mission.packets.root_container)
        self._reader = PacketReader(mission, definition)

    def __iter__(self) -> Iterator[Line]:
        for member in self._packets:
            part = io.BufferedReader(_Part(self._file, member), 1 << 16)
            yield from self._reader.lines(part, member.name)

    def totals(self) -> PacketTotals:
        """The counts of the packets so far."""
        return self._reader.totals()

    def close(self) -> None:
        """Close the archive."""
        self._file.close()


class _Part(io.RawIOBase):
    """A member of an archive as a stream."""

    def __init__(self, file: IO[bytes], member: Member) -> None:
        self._file, self._next = file, member.offset
        self._end = member.offset + member.size

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        self._file.seek(self._next)
        piece = self._file.read(min(len(buffer), self._end - self._next))
        self._next += len(piece)
        buffer[: len(piece)] = piece
        return len(piece)


def archive_of(files: Sequence[Path]) -> Iterator[bytes]:
    """An archive of files on disk, in pieces; raises `BadFile` for one that cannot be read."""
    for file in files:
        try:
            with file.open("rb") as stream:
                size = os.fstat(stream.fileno()).st_size
                header = tarfile.TarInfo(file.name[-90:])
                header.size = size
                yield header.tobuf(tarfile.USTAR_FORMAT, "utf-8", "replace")
                left = size
                while left and (piece := stream.read(min(left, PIECE_BYTES))):
                    left -= len(piece)
                    yield piece
        except OSError as error:
            raise BadFile(Fault(str(file), f"cannot be opened: {error.strerror}")) from None
        if left:
            raise BadFile(Fault(str(file), "became shorter while it was read"))
        yield b"\0" * (-size % BLOCK_BYTES)
    yield b"\0" * (2 * BLOCK_BYTES)
