"""Files of space packets as lines of telemetry, a batch or a gyro block each, with counts."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import IO

from msgspec import Struct

from service.errors import BadFile, BadInput, Fault
from service.missions.mission import Mission
from service.observations.readers.decompress import Line
from service.packets.batches import (
    BatchMaker,
    MeasuredBatch,
    MeasurementMaker,
    PacketAttitude,
    StarBatch,
)
from service.packets.definition import PacketDefinition, PacketFault, UnknownPacket
from service.packets.gyro_blocks import GyroBlockMaker, PacketBlock
from service.packets.mapping import packet_map
from service.packets.stream import (
    IDLE_APID,
    ApidCounts,
    EndOfPackets,
    SegmentJoiner,
    SequenceCounter,
    SpacePacket,
    packets_in,
)

_OF_SEGMENTS = (
    "; it is joined of {} segments: if each has a secondary header, set "
    "packets.segment_header_bytes; if the sequence flags group whole packets, set "
    'packets.sequence_flags = "groups"'
)

READ_BYTES = 1 << 16


class PacketTotals(Struct, kw_only=True):
    """The contents of the packets that were read."""

    packets: int = 0
    bytes: int = 0
    batches: int = 0
    without_stars: int = 0
    """Packets of a tracker that held neither a star nor an attitude."""
    gyro_blocks: int = 0
    gyro_samples: int = 0
    unknown: int = 0
    """Packets that the XTCE file does not describe."""
    not_asked: int = 0
    """Packets of APIDs that the mission's table leaves out."""
    idle: int = 0
    gaps: int = 0
    missing: int = 0
    backward: int = 0
    joined: int = 0
    """Packets that were joined of segments."""
    incomplete: int = 0
    """Segments of packets of which other segments are missing."""
    refused: int = 0
    unread_bytes: int = 0
    """From the packets on at which files could not be read any further."""
    empty_files: int = 0
    """Files without a packet."""
    without_attitude: int = 0
    """Packets whose a priori quaternion was zero or not finite."""
    apids: list[ApidCounts] = []


class PacketReader:
    """Reads packets of one spacecraft; what later packets need is kept between files."""

    def __init__(self, mission: Mission, definition: PacketDefinition) -> None:
        """Raises `BadInput` naming each parameter of the mission's table that XTCE lacks."""
        if mission.packets is None:
            raise BadInput(Fault("packets", f"the mission file of {mission.name} has no [packets]"))
        self._table = mission.packets
        self._definition = definition
        mapped = packet_map(mission.packets, definition)
        self._maker = BatchMaker(mission.name, mapped)
        self._measured = MeasurementMaker(mission.name, mapped)
        self._gyro = GyroBlockMaker(mission, mapped) if mission.packets.gyro_blocks else None
        self._asked = frozenset(mission.packets.apids)
        self._sequence = SequenceCounter()
        self._segments = SegmentJoiner(mission.packets.segment_header_bytes)
        self._totals = PacketTotals()

    def totals(self) -> PacketTotals:
        """The counts so far, with those of each APID in order."""
        totals, apids = self._totals, sorted(self._sequence.apids.items())
        totals.apids = [counts for _, counts in apids]
        totals.gaps = sum(each.gaps for each in totals.apids)
        totals.missing = sum(each.missing for each in totals.apids)
        totals.backward = sum(each.backward for each in totals.apids)
        totals.without_attitude = self._maker.without_attitude
        return totals

    def lines(self, stream: IO[bytes], name: str) -> Iterator[Line]:
        """The batches and gyro blocks of a file, and a fault for each packet that cannot be read.

        A line has the number of its packet in the file.  A fault names the file, the packet, its
        first byte and the parameter.  After the end of a file that is damaged nothing follows.
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
        """The lines that are complete with a packet."""
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
        """The lines that are complete with a whole packet.

        Raises `UnknownPacket`, and `PacketFault` for one that cannot be read.
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
        """The packet, or the one whose last segment it is; and segments that cannot be joined."""
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
    """The lines of files on disk; raises `BadFile` for one that cannot be opened."""
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
