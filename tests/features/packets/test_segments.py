"""Segmented space packets: joined where all segments are there, counted where some are missing."""

import io

import pytest
from space_packet_parser.generators.ccsds import create_ccsds_packet

from service.features.packets.stream import MOST_BYTES, SegmentJoiner, packets_in
from tests.features.packets.packing import (
    APID,
    TABLE,
    fields,
    mission_with,
    packed,
    packet,
)
from tests.features.packets.test_reader import ANGLES, canonical, drawn, read, reader_of

CONTINUATION, FIRST, LAST, WHOLE = range(4)


@pytest.fixture(scope="module")
def batches(missions, sky):
    return drawn(missions, sky)[:3]


def segment(data, flags, count, apid=APID, secondary=0):
    return bytes(
        create_ccsds_packet(
            data,
            apid=apid,
            sequence_flags=flags,
            sequence_count=count % 16384,
            secondary_header_flag=secondary,
        )
    )


def segmented(data, sizes, count, repeated=b"", apid=APID):
    """A packet's data as segments, each after the first one with a header that is repeated."""
    parts, begin = [], 0
    for size in sizes:
        parts.append(data[begin : begin + size])
        begin += size
    parts.append(data[begin:])
    flags = [FIRST, *[CONTINUATION] * (len(parts) - 2), LAST]
    return [
        segment(
            (repeated if k else b"") + part, flags[k], count + k, apid, secondary=bool(repeated)
        )
        for k, part in enumerate(parts)
    ]


def bodies(lines):
    return [line.body for line in lines if line.body is not None]


def faults(lines):
    return [(line.number, str(line.fault)) for line in lines if line.fault is not None]


@pytest.mark.parametrize("sizes", [(30,), (1,), (40, 40, 40), (6, 1, 200)])
@pytest.mark.parametrize("first", [0, 16382])
def test_segments_are_joined_also_across_the_end_of_the_count(batches, sizes, first):
    reader = reader_of()
    one, *others = batches
    pieces = segmented(fields(one), sizes, first)
    data = b"".join(pieces) + packed(others, first + len(pieces))
    assert bodies(read(data, reader)) == canonical(batches)
    totals = reader.totals()
    assert (totals.joined, totals.incomplete, totals.refused, totals.gaps) == (1, 0, 0, 0)
    assert (totals.packets, totals.batches) == (len(pieces) + 2, 3)


def test_segments_of_several_apids_may_lie_between_each_other(batches):
    reader = reader_of()
    mine = segmented(fields(batches[0]), (20, 20), 0)
    other = segmented(bytes(30), (10, 10), 7, apid=77)
    data = b"".join(each for pair in zip(mine, other, strict=True) for each in pair)
    assert bodies(read(data, reader)) == canonical(batches[:1])
    assert (reader.totals().joined, reader.totals().unknown) == (2, 3)


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_a_packet_that_lacks_a_segment_is_refused_and_counted_by_its_apid(batches, lost):
    reader = reader_of()
    pieces = segmented(fields(batches[0]), (20, 20), 0)
    del pieces[lost]
    lines = read(b"".join(pieces) + packed(batches[1:], 3), reader)
    assert bodies(lines) == canonical(batches[1:])
    found = faults(lines)
    assert [number for number, _ in found] == [1, 2]
    for _, told in found:
        assert f"is a segment of a packet of APID {APID} whose other segments are missing" in told
    totals = reader.totals()
    assert (totals.incomplete, totals.refused, totals.batches) == (2, 2, 2)
    assert [(each.apid, each.incomplete) for each in totals.apids] == [(APID, 2)]


@pytest.mark.parametrize(
    "flags", [(FIRST,), (FIRST, FIRST, LAST), (CONTINUATION,), (LAST,), (FIRST, WHOLE)]
)
def test_flags_out_of_order_are_incomplete_and_never_a_batch_of_a_part(batches, flags):
    reader = reader_of()
    data = b"".join(segment(fields(batches[0])[:40], each, k) for k, each in enumerate(flags))
    read(data, reader)
    totals = reader.totals()
    assert totals.batches == 0
    assert totals.incomplete + totals.refused > totals.incomplete - (WHOLE in flags)


def test_segments_of_an_apid_that_xtce_does_not_describe_are_unknown_and_not_refused():
    reader = reader_of()
    assert read(segment(bytes(20), LAST, 5, apid=77), reader) == []
    assert (reader.totals().unknown, reader.totals().refused) == (1, 0)


def test_a_secondary_header_in_each_segment_is_skipped(batches):
    text = TABLE.format(directions=ANGLES)
    mission = mission_with(
        text.replace("\n[packets.time]", "\nsegment_header_bytes = 6\n[packets.time]")
    )
    pieces = segmented(fields(batches[0]), (50, 50), 0, repeated=b"\x01" * 6)
    assert bodies(read(b"".join(pieces), reader_of(mission))) == canonical(batches[:1])
    (line,) = read(b"".join(pieces))
    assert "it is joined of 3 segments" in str(line.fault)
    assert "packets.segment_header_bytes" in str(line.fault)
    # Of one that came whole nothing of segments is said.
    (line,) = read(segment(fields(batches[0])[:40], WHOLE, 0))
    assert "it is joined of" not in str(line.fault)


def test_later_segments_without_a_secondary_header_lose_nothing(batches):
    text = TABLE.format(directions=ANGLES)
    mission = mission_with(
        text.replace("\n[packets.time]", "\nsegment_header_bytes = 6\n[packets.time]")
    )
    data = fields(batches[0])
    pieces = [segment(data[:50], FIRST, 0, secondary=1), segment(data[50:], LAST, 1)]
    assert bodies(read(b"".join(pieces), reader_of(mission))) == canonical(batches[:1])


def test_flags_that_group_whole_packets_are_taken_so_where_the_mission_says_it(batches):
    data = b"".join(
        segment(fields(each), flags, k)
        for k, (each, flags) in enumerate(zip(batches, (FIRST, CONTINUATION, LAST), strict=True))
    )
    text = TABLE.format(directions=ANGLES)
    mission = mission_with(
        text.replace("\n[packets.time]", '\nsequence_flags = "groups"\n[packets.time]')
    )
    reader = reader_of(mission)
    assert bodies(read(data, reader)) == canonical(batches)
    assert (reader.totals().joined, reader.totals().incomplete) == (0, 0)
    (line,) = read(data)
    assert 'set packets.sequence_flags = "groups"' in str(line.fault)


def test_a_packet_without_end_is_not_held():
    joiner = SegmentJoiner(0)
    pieces = [segment(bytes(60_000), FIRST, 0)]
    pieces += [segment(bytes(60_000), CONTINUATION, k) for k in range(1, 40)]
    incomplete = []
    for each in packets_in(io.BytesIO(b"".join(pieces))):
        whole, left = joiner.add(each)
        assert whole is None
        incomplete += left
        assert sum(len(p.content) for p in joiner._open.get(APID, [])) <= MOST_BYTES
    assert len(incomplete) + len(joiner.end()) == 40


@pytest.mark.parametrize(
    ("marker", "kind"),
    [
        ("1acffc1d", "the attached sync marker 1ACFFC1D"),
        ("1dfccf1a", "bytes reversed, 1DFCCF1A"),
        ("e53003e2", "bits inverted, E53003E2"),
        ("034776c7272895b0", "of a turbo code 034776C7"),
        ("eb90", "the start sequence EB90"),
    ],
)
def test_transfer_frames_are_told_by_their_sync_marker(batches, marker, kind):
    (line,) = read(bytes.fromhex(marker) + packet(fields(batches[0])))
    assert "packet 1 at byte 0: " in str(line.fault)
    assert f"{kind} is where a packet should begin: these are transfer frames" in str(line.fault)


def test_a_sync_marker_before_each_packet_is_skipped_as_the_mission_says(batches):
    text = TABLE.format(directions=ANGLES)
    mission = mission_with(text.replace("\n[packets.time]", "\nprefix_bytes = 4\n[packets.time]"))
    data = b"".join(
        bytes.fromhex("1acffc1d") + packet(fields(each), k) for k, each in enumerate(batches)
    )
    assert bodies(read(data, reader_of(mission))) == canonical(batches)
