"""Reader of consecutive space packets in a file, and counter of their sequence gaps.

Source of the primary header: CCSDS 133.0-B-2, section 4.1.3.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO

from msgspec import Struct

from service.features.packets.definition import PacketFault

HEADER_BYTES = 6
IDLE_APID = 2047
CONTINUATION, FIRST, LAST, WHOLE = range(4)
"""Sequence flags of a packet header: segment or whole packet."""
MOST_BYTES = 1 << 20
"""Greatest size in bytes of a packet joined from segments."""
SYNC_MARKERS = {
    bytes.fromhex(marker): f"{kind} {marker.upper()}"
    for marker, kind in (
        ("1acffc1d", "the attached sync marker"),
        ("1dfccf1a", "the attached sync marker, bytes reversed,"),
        ("e53003e2", "the attached sync marker, bits inverted,"),
        ("352ef853", "the attached sync marker of a code block"),
        ("034776c7", "the attached sync marker of a turbo code"),
        ("eb90", "the start sequence"),
    )
}
"""Sync markers at the start of transfer frames (CCSDS 131.0-B, section 9, and 231.0-B)."""
CONTAINERS = {
    b"CCSD": "an SFDU label (CCSDS 620.0-B)",
    b"NJPL": "an SFDU label of JPL",
    b"cFE1": "a file header of cFS: 64 bytes, and 76 more of its Data Storage application",
    b"\xd4\xc3\xb2\xa1": "the header of a pcap capture",
    b"\xa1\xb2\xc3\xd4": "the header of a pcap capture",
    b"\x4d\x3c\xb2\xa1": "the header of a pcap capture",
    b"\x0a\x0d\x0d\x0a": "the header of a pcapng capture",
    b"\x1f\x8b\x08": "the header of gzip",
    b"\x28\xb5\x2f\xfd": "the header of zstd",
    b"PK\x03\x04": "the header of a zip archive",
}
"""First bytes of container files that hold packets in another format."""
SEQUENCE_COUNTS = 1 << 14


@dataclass(frozen=True, slots=True)
class SpacePacket:
    """A space packet with its header; `number` counts the packets of a file from 1."""

    number: int
    offset: int
    """The offset of the packet's first byte in the file."""
    content: bytes

    @property
    def apid(self) -> int:
        """Application process identifier (APID) of the packet."""
        return ((self.content[0] & 0x07) << 8) | self.content[1]

    @property
    def sequence_flags(self) -> int:
        """Sequence flags of the packet: segment or whole packet."""
        return self.content[2] >> 6

    @property
    def sequence_count(self) -> int:
        """14-bit sequence count of the packet within its APID."""
        return ((self.content[2] & 0x3F) << 8) | self.content[3]

    segments: int = 1
    """Number of packets in the file from which a segmented packet was joined."""


class EndOfPackets(PacketFault):
    """Raised if the rest of a packet file is unreadable; `number` and `offset` locate it."""

    def __init__(
        self, number: int, offset: int, read: int, message: str, value: object = None
    ) -> None:
        super().__init__("", message, value)
        self.number = number
        self.offset = offset
        self.read = read
        """Number of bytes that were read from the offset on."""


def packets_in(stream: IO[bytes], prefix_bytes: int = 0) -> Iterator[SpacePacket]:
    """Read the packets of a stream, skipping `prefix_bytes` bytes before each.

    Holds one packet at a time, at most 64 KiB.  Raises `EndOfPackets` if the stream ends within a
    packet, or if a header is not that of a space packet: after a wrong length the next packet is
    not found.
    """
    offset, number = 0, 0
    while True:
        start = stream.read(prefix_bytes + HEADER_BYTES)
        if not start:
            return
        number += 1
        header = start[prefix_bytes:]
        offset += prefix_bytes
        if len(header) < HEADER_BYTES:
            message = f"the file ends after {len(start)} bytes, within the header of a packet"
            raise EndOfPackets(number, offset, len(header), message)
        if marker := SYNC_MARKERS.get(header[:4]) or SYNC_MARKERS.get(header[:2]):
            message = (
                f"{marker} is where a packet should begin: these are transfer frames; extract the "
                "space packets first, or set packets.prefix_bytes if each packet has such a prefix"
            )
            raise EndOfPackets(number, offset, len(header), message)
        # Only the first packet is checked: later ones may begin like a container by chance.
        marks = [mark for mark in CONTAINERS if number == 1 and header.startswith(mark)]
        if marks:
            message = (
                f"{CONTAINERS[marks[0]]} is where a packet should begin: take the space packets "
                "out of the file, or set packets.prefix_bytes if each packet has such a prefix"
            )
            raise EndOfPackets(number, offset, len(header), message)
        if header[0] >> 5:
            message = (
                "the version number of a space packet must be 0; this is no packet, or the "
                "length of the packet before is wrong"
            )
            raise EndOfPackets(number, offset, len(header), message, header[0] >> 5)
        length = (header[4] << 8 | header[5]) + 1
        data = stream.read(length)
        if len(data) < length:
            message = (
                f"the file ends after {HEADER_BYTES + len(data)} of the "
                f"{HEADER_BYTES + length} bytes of the packet"
            )
            raise EndOfPackets(number, offset, len(header + data), message)
        yield SpacePacket(number, offset, header + data)
        offset += HEADER_BYTES + length


class ApidCounts(Struct, kw_only=True):
    """Counts of the packets of one APID."""

    apid: int
    packets: int = 0
    described: bool = True
    """True if the XTCE file describes packets of this APID."""
    gaps: int = 0
    """Number of places where the sequence count skips packets."""
    missing: int = 0
    """Number of packets missing at the gaps of the sequence count."""
    backward: int = 0
    """Number of places where the count repeats or goes back: a reset, or packets out of order."""
    incomplete: int = 0
    """Number of segments of packets whose other segments are missing."""
    refused: int = 0


class SegmentJoiner:
    """Joins segmented packets (CCSDS 133.0-B-2, section 4.1.3.4.2.2).

    The segments of an APID follow each other; packets of others may lie between.
    """

    def __init__(self, header_bytes: int) -> None:
        """Keep `header_bytes`, the size of the secondary header that later segments repeat."""
        self._header_bytes = header_bytes
        self._open: dict[int, list[SpacePacket]] = {}

    def add(self, packet: SpacePacket) -> tuple[SpacePacket | None, list[SpacePacket]]:
        """Add a packet or segment; returns the completed packet or None, and unusable segments."""
        flags, apid = packet.sequence_flags, packet.apid
        before = self._open.pop(apid, [])
        if flags == WHOLE:
            return packet, before
        if flags == FIRST:
            self._open[apid] = [packet]
            return None, before
        follows = (
            before
            and (packet.sequence_count - before[-1].sequence_count) % SEQUENCE_COUNTS == 1
            and sum(len(each.content) for each in (*before, packet)) <= MOST_BYTES
        )
        if not follows:
            return None, [*before, packet]
        if flags == CONTINUATION:
            self._open[apid] = [*before, packet]
            return None, []
        return self._joined([*before, packet]), []

    def end(self) -> list[SpacePacket]:
        """Remove and return the segments of packets whose last segment has not come."""
        left = [packet for segments in self._open.values() for packet in segments]
        self._open.clear()
        return left

    def _joined(self, segments: list[SpacePacket]) -> SpacePacket:
        first = segments[0]
        data = first.content[HEADER_BYTES:]
        for segment in segments[1:]:
            # The flag of a secondary header: later segments may come without one.
            has_header = segment.content[0] & 0x08
            data += segment.content[HEADER_BYTES + (self._header_bytes if has_header else 0) :]
        flags = bytes([first.content[2] | WHOLE << 6])
        # The length field of a packet beyond 65,536 bytes has its greatest value.
        length = min(len(data) - 1, 0xFFFF).to_bytes(2, "big")
        header = first.content[:2] + flags + first.content[3:4] + length
        return SpacePacket(first.number, first.offset, header + data, len(segments))


class SequenceCounter:
    """Counts packets by APID, and detects gaps in their sequence counts."""

    def __init__(self) -> None:
        self.apids: dict[int, ApidCounts] = {}
        self._last: dict[int, int] = {}

    def add(self, packet: SpacePacket) -> ApidCounts:
        """Count a packet; returns the counts of its APID.  Idle packets have no sequence."""
        apid = packet.apid
        counts = self.apids.get(apid)
        if counts is None:
            counts = self.apids[apid] = ApidCounts(apid=apid)
        counts.packets += 1
        if apid == IDLE_APID:
            return counts
        count, last = packet.sequence_count, self._last.get(apid)
        self._last[apid] = count
        if last is not None:
            skipped = (count - last - 1) % SEQUENCE_COUNTS
            # A step of more than half of all counts is a step backward.
            if skipped >= SEQUENCE_COUNTS // 2:
                counts.backward += 1
            elif skipped:
                counts.gaps += 1
                counts.missing += skipped
        return counts
