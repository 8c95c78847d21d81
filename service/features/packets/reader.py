"""Reader of packet files: yields a line of telemetry per batch or gyro block, with counts.

An upload has packets and their XTCE file in one tar archive.  The archive is read by its plain
headers (POSIX ustar): nothing is unpacked, and no header determines how much memory is used.
Extended headers are skipped.
"""

import io
import os
import tarfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

from msgspec import Struct, convert, structs, to_builtins

from service.contract.runs import ReplayPackets
from service.errors import BadFile, BadInput, Fault, shown_value
from service.features.packets.batches import (
    BatchMaker,
    MeasuredBatch,
    MeasurementMaker,
    PacketAttitude,
    StarBatch,
)
from service.features.packets.definition import (
    MAX_BYTES,
    PacketDefinition,
    PacketFault,
    UnknownPacket,
)
from service.features.packets.gyro_blocks import GyroBlockMaker, PacketBlock
from service.features.packets.mapping import packet_map, packet_mission
from service.features.packets.stream import (
    IDLE_APID,
    ApidCounts,
    EndOfPackets,
    SegmentJoiner,
    SequenceCounter,
    SpacePacket,
    packets_in,
)
from service.missions.mission import Mission
from service.observations.decompress import Line

_OF_SEGMENTS = (
    "; it is joined of {} segments: if each has a secondary header, set "
    "packets.segment_header_bytes; if the sequence flags group whole packets, set "
    'packets.sequence_flags = "groups"'
)

READ_BYTES = 1 << 16
MOST_APIDS = 100
"""Greatest number of application ids in a report, those with the most packets."""


class PacketTotals(Struct, kw_only=True):
    """Counts of packets read, and of batches and gyro blocks made from them."""

    packets: int = 0
    bytes: int = 0
    batches: int = 0
    without_stars: int = 0
    """Number of packets of a tracker without a star or an attitude."""
    gyro_blocks: int = 0
    gyro_samples: int = 0
    unknown: int = 0
    """Number of packets that the XTCE file does not describe."""
    not_asked: int = 0
    """Number of packets of APIDs that the mission's table leaves out."""
    idle: int = 0
    gaps: int = 0
    missing: int = 0
    backward: int = 0
    joined: int = 0
    """Number of packets that were joined of segments."""
    incomplete: int = 0
    """Number of segments of packets whose other segments are missing."""
    refused: int = 0
    unread_bytes: int = 0
    """Number of bytes after a damaged packet, from which files could not be read any further."""
    empty_files: int = 0
    """Number of files without a packet."""
    without_attitude: int = 0
    """Number of packets whose a priori quaternion was zero or not finite."""
    apids: list[ApidCounts] = []


class PacketReader:
    """Reads packets of one spacecraft, and keeps values that later packets need between files."""

    def __init__(self, mission: Mission, definition: PacketDefinition) -> None:
        """Prepare the mapping; raises `BadInput` naming each parameter missing in XTCE."""
        if mission.packets is None:
            raise BadInput(Fault("packets", f"the mission file of {mission.name} has no [packets]"))
        self._table = mission.packets
        self._definition = definition
        mapped = packet_map(mission.packets, definition)
        self._maker = BatchMaker(mission.name, mapped)
        self._measured = MeasurementMaker(mission.name, mapped, self._maker.rates_near)
        self._gyro = GyroBlockMaker(mission, mapped) if mission.packets.gyro_blocks else None
        self._asked = frozenset(mission.packets.apids)
        self._sequence = SequenceCounter()
        self._segments = SegmentJoiner(mission.packets.segment_header_bytes)
        self._totals = PacketTotals()

    def totals(self) -> PacketTotals:
        """Counts of packets so far, also by APID in order."""
        totals, apids = self._totals, sorted(self._sequence.apids.items())
        totals.apids = [counts for _, counts in apids]
        totals.gaps = sum(each.gaps for each in totals.apids)
        totals.missing = sum(each.missing for each in totals.apids)
        totals.backward = sum(each.backward for each in totals.apids)
        totals.without_attitude = self._maker.without_attitude
        return totals

    def lines(self, stream: IO[bytes], name: str) -> Iterator[Line]:
        """Batches and gyro blocks of a file, and a fault for each packet that cannot be read.

        A line has the number of its packet in the file.  A fault names the file, the packet, its
        first byte and the parameter.  A damaged packet is the last line of its file.
        """
        before = self._totals.packets
        try:
            for packet in packets_in(stream, self._table.prefix_bytes):
                yield from self._read(packet, name)
            if self._totals.packets == before:
                self._totals.empty_files += 1
                yield Line(1, None, Fault(name, "is empty: it holds no packet"))
        except EndOfPackets as fault:
            self._totals.refused += 1
            self._totals.unread_bytes += fault.read
            while rest := stream.read(READ_BYTES):
                self._totals.unread_bytes += len(rest)
            yield Line(fault.number, None, _fault_at(fault.number, fault.offset, fault, name))
        yield from self._incomplete(self._segments.end(), name)
        yield from self._lines_of(self._maker.end(), name)
        if self._gyro is not None:
            yield from self._lines_of_blocks(self._gyro, self._gyro.end())

    def attitudes(self, stream: IO[bytes]) -> Iterator[PacketAttitude]:
        """The a priori attitudes in a file; raises `BadFile` at the first damaged packet."""
        number, offset = 1, 0
        try:
            for packet in packets_in(stream, self._table.prefix_bytes):
                number, offset = packet.number, packet.offset
                with suppress(UnknownPacket):
                    whole = self._whole(packet)[0]
                    values = None if whole is None else self._definition.read(whole.content)
                    found = None if values is None else self._maker.attitude(values)
                    if found is not None:
                        yield found
        except EndOfPackets as fault:
            raise BadFile(_fault_at(fault.number, fault.offset, fault, "packets")) from None
        except PacketFault as fault:
            raise BadFile(_fault_at(number, offset, fault, "packets")) from None

    def _read(self, packet: SpacePacket, name: str) -> Iterator[Line]:
        """Lines of telemetry that a packet or segment completes."""
        totals = self._totals
        totals.packets += 1
        totals.bytes += len(packet.content)
        counts = self._sequence.add(packet)
        if packet.apid == IDLE_APID:
            totals.idle += 1
            return
        if self._asked and packet.apid not in self._asked:
            totals.not_asked += 1
            return
        whole, incomplete = self._whole(packet)
        yield from self._incomplete(incomplete, name)
        if whole is None:
            return
        totals.joined += whole.segments > 1
        try:
            yield from self._lines_of_packet(whole, name)
        except UnknownPacket:
            counts.described = False
            totals.unknown += whole.segments
        except PacketFault as fault:
            yield self._refused(whole, fault, name)

    def _lines_of_packet(self, packet: SpacePacket, name: str) -> Iterator[Line]:
        """Lines of telemetry that a whole packet completes.

        Raises `UnknownPacket`, and `PacketFault` for a packet that cannot be read.
        """
        try:
            values = self._definition.read(packet.content)
        except PacketFault as fault:
            if packet.segments > 1:
                fault.message += _OF_SEGMENTS.format(packet.segments)
            raise
        yield from self._lines_of(self._maker.add(packet, values), name)
        yield from self._lines_of_measured(self._measured.add(packet, values), name)
        if self._gyro is not None:
            yield from self._lines_of_blocks(self._gyro, self._gyro.add(packet, values))

    def _whole(self, packet: SpacePacket) -> tuple[SpacePacket | None, list[SpacePacket]]:
        """The packet that a segment completes, or None, and segments that cannot be joined."""
        if self._table.sequence_flags == "groups":
            return packet, []
        return self._segments.add(packet)

    def _incomplete(self, segments: Iterable[SpacePacket], name: str) -> Iterator[Line]:
        for segment in segments:
            counts = self._sequence.apids[segment.apid]
            with suppress(PacketFault):
                try:
                    self._definition.read(segment.content)
                except UnknownPacket:
                    counts.described = False
                    self._totals.unknown += 1
                    continue
            counts.incomplete += 1
            self._totals.incomplete += 1
            message = (
                f"is a segment of a packet of APID {segment.apid} whose other segments are "
                "missing; if the sequence flags do not tell segments, set packets.sequence_flags "
                '= "groups"'
            )
            flags = PacketFault("", message, f"sequence flags {segment.sequence_flags}")
            yield self._refused(segment, flags, name)

    def _lines_of(self, batches: Iterable[StarBatch], name: str) -> Iterator[Line]:
        for batch in batches:
            if batch.has_stars():
                yield self._line(batch.packet, partial(self._maker.json_of, batch), name)
            else:
                self._totals.without_stars += 1

    def _lines_of_measured(self, batches: Iterable[MeasuredBatch], name: str) -> Iterator[Line]:
        for batch in batches:
            if batch.body is not None:
                yield self._line(batch.packet, partial(self._measured.json_of, batch), name)
            else:
                self._totals.without_stars += 1

    def _lines_of_blocks(
        self, maker: GyroBlockMaker, blocks: Iterable[PacketBlock]
    ) -> Iterator[Line]:
        for block in blocks:
            self._totals.gyro_blocks += 1
            self._totals.gyro_samples += len(block.tai_ns)
            yield Line(block.packet.number, maker.json_of(block, block.packet.apid))

    def _line(self, packet: SpacePacket, json_of: Callable[[], bytes], name: str) -> Line:
        try:
            body = json_of()
        except PacketFault as fault:
            return self._refused(packet, fault, name)
        self._totals.batches += 1
        return Line(packet.number, body)

    def _refused(self, packet: SpacePacket, fault: PacketFault, name: str) -> Line:
        self._totals.refused += 1
        self._sequence.apids[packet.apid].refused += 1
        return Line(packet.number, None, _fault_at(packet.number, packet.offset, fault, name))


def file_lines(reader: PacketReader, files: Iterable[Path]) -> Iterator[tuple[Path, Line]]:
    """Lines of telemetry from packet files on disk; raises `BadFile` if one cannot be opened."""
    for file in files:
        try:
            stream = file.open("rb")
        except OSError as error:
            raise BadFile(Fault(str(file), f"cannot be opened: {error.strerror}")) from None
        with stream:
            for line in reader.lines(stream, file.name):
                yield file, line


def _fault_at(number: int, offset: int, fault: PacketFault, name: str) -> Fault:
    place = f"{name}, packet {number} at byte {offset}"
    parameter = f": {fault.parameter}" if fault.parameter else ""
    return Fault(place + parameter, fault.message, fault.value)


BLOCK_BYTES = 512
MAX_MEMBERS = 1_000
PIECE_BYTES = 1 << 18
XTCE_SUFFIXES = (".xml", ".xtce")

_REGULAR, _FOLDER, _EXTENDED = b"\x000", b"5", b"xgLK"
_FIELD = "body"


@dataclass(frozen=True)
class Member:
    """A file in a tar archive: name, offset and size."""

    name: str
    offset: int
    size: int


def members_of(file: IO[bytes]) -> list[Member]:
    """Files of a tar archive, in order; raises `BadFile` naming the byte of a bad header."""
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
    """Size and kind of a tar member from its header; raises `BadFile` for an invalid one."""
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
    """Lines of telemetry from an uploaded packet archive; iterated once, and closed at the end."""

    def __init__(
        self, file: IO[bytes], missions: Mapping[str, Mission], spacecraft: str | None
    ) -> None:
        """Open an archive; raises `BadInput` for an archive, XTCE file or mapping with faults.

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

    def counts(self) -> ReplayPackets:
        """Counts of packets so far; only the APIDs with the most packets are listed."""
        totals = self._reader.totals()
        most = sorted(totals.apids, key=lambda each: -each.packets)[:MOST_APIDS]
        kept = structs.replace(totals, apids=sorted(most, key=lambda each: each.apid))
        return convert(to_builtins(kept), ReplayPackets)

    def close(self) -> None:
        """Close the archive."""
        self._file.close()


class _Part(io.RawIOBase):
    """A file in a tar archive as a stream."""

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
    """Tar archive of files on disk, in pieces; raises `BadFile` if one cannot be read."""
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
