"""Packets give the batches that were packed; a fault names file, packet, byte and parameter."""

import gzip
import io
import json
import math
import shutil
import struct
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from space_packet_parser import ccsds_generator, load_xtce

from service.errors import BadFile, BadInput
from service.features.packets.definition import PacketDefinition, read_definition
from service.features.packets.reader import PacketReader
from service.features.packets.stream import packets_in
from service.observations.schema import checked_from_json
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from tests.features.packets.packing import (
    ANGLES,
    APID,
    ATTITUDE_APID,
    JPSS1_PACKETS,
    JPSS1_TABLE,
    JPSS1_XTCE,
    NAMESPACES,
    SLOTS,
    TABLE,
    VECTORS,
    cds,
    fields,
    mission_of_pass,
    mission_with,
    packed,
    packet,
    xtce,
)


def drawn(missions, sky, count=20, angles=True, **options):
    wanted = Pass(count, 3, angles_share=1.0 if angles else 0.0, **options)
    return [each.batch for each in draw_pass(missions["XTE"], sky, wanted)]


@pytest.fixture(scope="module")
def batches(missions, sky):
    return drawn(missions, sky)


def reader_of(mission=None, text=None):
    mission = mission or mission_of_pass()
    return PacketReader(mission, PacketDefinition(text or xtce(), "test.xml", "CCSDSPacket"))


def read(data, reader=None):
    return list((reader or reader_of()).lines(io.BytesIO(data), "pass.dat"))


def canonical(batches):
    return [checked_from_json(json.dumps(each)).text.encode() for each in batches]


@pytest.mark.parametrize("style", NAMESPACES)
@pytest.mark.parametrize(("directions", "angles"), [(ANGLES, True), (VECTORS, False)])
def test_a_pass_in_packets_gives_the_batches_of_the_pass_byte_for_byte(
    style, directions, angles, missions, sky
):
    batches = drawn(missions, sky, angles=angles)
    reader = reader_of(mission_of_pass(directions), xtce(style))
    lines = read(packed(batches), reader)
    assert [each.fault for each in lines] == [None] * 20
    assert [each.body for each in lines] == canonical(batches)
    assert [each.number for each in lines] == list(range(1, 21))


def test_every_quaternion_of_jpss_1_is_the_one_at_its_bytes():
    mission = mission_with(JPSS1_TABLE, "JPSS1")
    reader = PacketReader(mission, read_definition(JPSS1_XTCE, "CCSDSPacket"))
    content = JPSS1_PACKETS.read_bytes()
    found = list(reader.attitudes(io.BytesIO(content)))
    rows = np.frombuffer(content, np.uint8).reshape(-1, 71)
    expected = np.ascontiguousarray(rows[:, 55:71]).view(">f4").astype(np.float64)
    assert len(found) == len(expected) == 7200
    assert np.array_equal([each.quaternion for each in found], expected)
    assert np.abs(np.linalg.norm(expected, axis=1) - 1.0).max() < 4.4e-8


def test_the_day_of_jpss_1_changes_at_midnight_with_its_milliseconds():
    reader = PacketReader(
        mission_with(JPSS1_TABLE, "JPSS1"), read_definition(JPSS1_XTCE, "CCSDSPacket")
    )
    with JPSS1_PACKETS.open("rb") as file:
        found = list(reader.attitudes(file))
    assert found[0].moment.text == "2021-04-08T23:59:59.930941Z"
    assert found[1].moment.text == "2021-04-09T00:00:00.930945Z"
    steps_s = np.diff([each.moment.tai_ns for each in found]) * 1e-9
    assert np.abs(steps_s - 1.0).max() < 1e-3
    # The spacecraft turns once in an orbit of 101 minutes.
    rotations = np.array([each.quaternion for each in found])
    cosines = np.abs(np.sum(rotations[1:] * rotations[:-1], axis=1)).clip(max=1.0)
    assert np.degrees(2.0 * np.arccos(cosines)).mean() == pytest.approx(360 / 6090, abs=2e-3)


def test_packets_are_split_as_space_packet_parser_splits_them():
    content = JPSS1_PACKETS.read_bytes()
    own = [
        (each.content, each.apid, each.sequence_count) for each in packets_in(io.BytesIO(content))
    ]
    theirs = [(bytes(each), each.apid, each.sequence_count) for each in ccsds_generator(content)]
    assert own == theirs


def test_every_value_is_the_one_that_space_packet_parser_gives():
    definition = read_definition(JPSS1_XTCE, "CCSDSPacket")
    theirs = load_xtce(JPSS1_XTCE)
    for content in list(ccsds_generator(JPSS1_PACKETS.read_bytes()))[::100]:
        assert dict(definition.read(bytes(content))) == dict(theirs.parse_bytes(content))


def test_gaps_repeats_unknown_apids_and_idle_packets_are_counted(batches):
    data = packed(batches[:5])
    data += packed(batches[5:7], first=8)  # three are missing
    data += packed(batches[7:8], first=4)  # back by five
    data += packet(b"\0" * 9, 3, apid=77) * 2 + packet(b"\0", 0, apid=2047)
    reader = reader_of()
    assert len(read(data, reader)) == 8
    totals = reader.totals()
    assert (totals.packets, totals.batches, totals.unknown, totals.idle) == (11, 8, 2, 1)
    assert (totals.gaps, totals.missing, totals.backward) == (1, 3, 2)
    assert [(each.apid, each.described) for each in totals.apids] == [
        (77, False),
        (APID, True),
        (2047, True),
    ]


def test_a_sequence_count_starts_again_after_14_bits(batches):
    reader = reader_of()
    read(packed(batches, first=16380), reader)
    assert (reader.totals().gaps, reader.totals().backward) == (0, 0)


def test_packets_of_apids_that_the_table_leaves_out_are_counted_and_not_read(batches):
    mission = mission_with(
        TABLE.format(directions=ANGLES).replace("\n[packets.time]", "\napids = [5]\n[packets.time]")
    )
    reader = reader_of(mission)
    assert read(packed(batches), reader) == []
    assert reader.totals().not_asked == 20


def test_bytes_before_each_packet_are_skipped(batches):
    table = TABLE.format(directions=ANGLES).replace(
        "\n[packets.time]", "\nprefix_bytes = 4\n[packets.time]"
    )
    data = b"".join(b"\xff\xff\xff\xff" + packet(fields(each), k) for k, each in enumerate(batches))
    assert [each.body for each in read(data, reader_of(mission_with(table)))] == canonical(batches)


def test_a_slot_without_a_direction_is_empty_and_a_packet_without_stars_gives_no_batch(batches):
    none = batches[0] | {"observations": [{"tracker": "STARTRACKER_1", "stars": []}]}
    table = TABLE.format(directions=ANGLES).replace('count = "ST1_STARS"\n', "")
    reader = reader_of(mission_with(table))
    lines = read(packet(fields(batches[0])) + packet(fields(none), 1), reader)
    assert [each.body for each in lines] == canonical(batches[:1])
    assert reader.totals().without_stars == 1


def attitude_packet(time, quaternion, count=0):
    data = struct.pack(">HIH", *cds(time)) + struct.pack(">4d", *quaternion)
    return packet(data, count, ATTITUDE_APID)


def test_the_attitude_of_another_packet_serves_stars_near_it_in_time(batches):
    batch = batches[0]
    mission = mission_with(
        TABLE.format(directions=ANGLES)
        .replace('"Q1", "Q2"', '"P1", "P2"')
        .replace('"Q3", "Q4"', '"P3", "P4"')
    )
    text = xtce()
    for name in ("P1", "P2", "P3", "P4"):
        text = text.replace(
            b"</xtce:ParameterSet>",
            b'<xtce:Parameter name="%b" parameterTypeRef="DOUBLE_T"/></xtce:ParameterSet>'
            % name.encode(),
        )
    at = text.index(b'name="ATTITUDE"')
    text = text[:at] + text[at:].replace(b'parameterRef="Q', b'parameterRef="P')
    quaternion = [0.5, -0.5, 0.5, 0.5]
    for time, expected in (("1996-01-10T12:00:09Z", quaternion), ("1996-01-10T12:00:11Z", None)):
        here = batch | {"time": "1996-01-10T12:00:00.000Z"}
        data = attitude_packet(time, quaternion) + packet(fields(here))
        (line,) = read(data, reader_of(mission, text))
        prior = json.loads(line.body)["a_priori"]
        assert (prior and prior["quaternion"]) == expected


@pytest.mark.parametrize(
    ("keys", "given"),
    [
        ('scalar = "first"', [0.9659258262890683, 0.0, 0.0, 0.25881904510252074]),
        ('direction = "body_to_inertial"', [0.0, 0.0, -0.25881904510252074, 0.9659258262890683]),
        ("", [0.0, 0.0, 0.25881904510252074, 0.9659258262890683]),
    ],
)
def test_30_degrees_about_z_is_one_attitude_in_every_form(keys, given, batches):
    table = TABLE.format(directions=ANGLES).replace(
        "[packets.prior]\n", f"[packets.prior]\n{keys}\n"
    )
    batch = batches[0] | {"a_priori": {"quaternion": given}}
    (line,) = read(packet(fields(batch)), reader_of(mission_with(table)))
    expected = [0.0, 0.0, 0.25881904510252074, 0.9659258262890683]
    assert json.loads(line.body)["a_priori"]["quaternion"] == pytest.approx(expected, abs=0)


def test_stars_of_two_packets_at_about_one_time_join_into_one_batch(batches):
    two = TABLE.format(directions=ANGLES).replace(
        "\n[packets.time]", "\njoin_within_s = 0.5\n[packets.time]"
    )
    batch = batches[0] | {"time": "1996-01-10T12:00:00.000Z"}
    later = batches[1] | {"time": "1996-01-10T12:00:00.250Z"}
    # One tracker: the second packet begins a batch of its own.
    lines = read(packed([batch, later]), reader_of(mission_with(two)))
    assert [each.body for each in lines] == canonical([batch, later])


BAD = [
    (lambda data: data[:-7], "pass.dat, packet 20 at byte", "the file ends after"),
    (lambda data: data + b"\x08", "pass.dat, packet 21 at byte", "within the header"),
    (lambda data: data + b"\xff" * 40, "packet 21 at byte", "version number"),
    (lambda data: data + packet(b"\0" * 20, 20), "packet 21 at byte", "the packet has 26 bytes"),
    (lambda data: data + packet(b"\0" * 2000, 20), ": STARS", "the XTCE file describes"),
]


@pytest.mark.parametrize(("spoilt", "place", "why"), BAD)
def test_a_damaged_packet_is_named_by_file_packet_byte_and_parameter(spoilt, place, why, batches):
    lines = read(spoilt(packed(batches)))
    faults = [each.fault for each in lines if each.fault is not None]
    assert len(faults) == 1
    assert place in faults[0].field
    assert why in faults[0].message
    assert sum(each.body is not None for each in lines) >= 19


CONTAINERS = [
    (b"CCSD3ZF0000100000001" + b"NJPL3IS0L015\0\0\0\0\0\0\0\0", "an SFDU label"),
    (b"cFE1" + bytes(136), "a file header of cFS"),
    (b"\xd4\xc3\xb2\xa1\2\0\4\0" + bytes(16), "a pcap capture"),
    (b"\x0a\x0d\x0d\x0a" + bytes(24), "a pcapng capture"),
]


@pytest.mark.parametrize(("before", "what"), CONTAINERS)
def test_packets_within_a_file_of_another_kind_are_refused_by_its_name(before, what, batches):
    """Dumps of networks and of flight software: their headers are no packets."""
    lines = read(before + packed(batches))
    (line,) = lines
    assert line.body is None
    assert what in line.fault.message
    assert "packets.prefix_bytes" in line.fault.message


def test_compressed_packets_are_not_read_as_packets(batches):
    (line,) = read(gzip.compress(packed(batches)))
    assert "the header of gzip" in line.fault.message


VALUES = [
    ({"time": "1957-12-31T00:00:00.000Z"}, "ST_DAY", "day"),
    ({"a_priori": {"quaternion": [0.0, 0.0, 0.0, 0.9]}}, "Q1, Q2, Q3, Q4", "norm 1"),
    ({"body_rates_deg_per_s": [0.0, float("nan"), 0.0]}, "RATE_Y", "finite"),
    ({"body_rates_deg_per_s": [0.0, 0.0, 400.0]}, "RATE", "at most 360"),
    ({"batch": ""}, "ST_BATCH", "must not be empty"),
]


@pytest.mark.parametrize(("change", "parameter", "why"), VALUES)
def test_an_impossible_value_is_named_by_its_parameter(change, parameter, why, batches):
    if change.get("time", "").startswith("1957"):
        data = bytearray(packet(fields(batches[0])))
        data[30:32] = b"\0\0"
        content = bytes(data)
    else:
        content = packet(fields(batches[0] | change))
    (line,) = read(content)
    assert line.fault.field.startswith("pass.dat, packet 1 at byte 0: ")
    assert parameter in line.fault.field
    assert why in line.fault.message


def test_a_star_outside_every_range_is_named_by_its_slot(batches):
    batch = json.loads(json.dumps(batches[0]))
    batch["observations"][0]["stars"][2]["h_deg"] = 95.0
    (line,) = read(packet(fields(batch)))
    assert line.fault.field == "pass.dat, packet 1 at byte 0: ST1_A[2]"
    assert "95" in line.fault.value


def test_more_stars_than_slots_are_refused(batches):
    data = bytearray(packet(fields(batches[0])))
    data[6 + 24 + 8 + 13 * 8] = SLOTS + 1
    (line,) = read(bytes(data))
    assert line.fault.field.endswith(": ST1_STARS")


def test_a_parameter_that_the_xtce_file_lacks_is_named_with_its_key():
    mission = mission_with(TABLE.format(directions=ANGLES.replace("ST1_A", "ST1_AA")))
    with pytest.raises(BadInput) as refusal:
        reader_of(mission)
    first = refusal.value.faults[0]
    assert first.field == "packets.trackers.0.h"
    assert "test.xml" in first.message
    assert "ST1_A[0]" in first.message
    assert "ST1_AA[0]" in first.value


def test_a_damaged_file_of_attitudes_is_refused():
    reader = PacketReader(
        mission_with(JPSS1_TABLE, "JPSS1"), read_definition(JPSS1_XTCE, "CCSDSPacket")
    )
    with pytest.raises(BadFile, match="packet 2 at byte 71: the file ends after 29"):
        list(reader.attitudes(io.BytesIO(JPSS1_PACKETS.read_bytes()[:100])))
    with pytest.raises(BadFile, match="ADGPSPOSX: begins at byte 23"):
        list(reader.attitudes(io.BytesIO(packet(b"\0" * 20, apid=11)[:4] + b"\0\x13" + b"\0" * 20)))


def test_bytes_after_a_wrong_length_an_empty_file_and_an_unknown_attitude_are_counted(batches):
    whole = packed(batches)
    size = len(whole) // len(batches)
    wrong = bytearray(whole)
    wrong[size + 4 : size + 6] = (size + 100).to_bytes(2, "big")
    reader = reader_of()
    found = read(bytes(wrong), reader)
    assert found[-1].fault is not None
    totals = reader.totals()
    # The second packet took a part of the third with it.
    read_bytes = sum(len(packet.content) for packet in two_packets(bytes(wrong)))
    assert totals.unread_bytes == len(whole) - read_bytes
    (empty,) = read(b"", reader)
    assert "pass.dat: is empty: it holds no packet" in str(empty.fault)
    assert reader.totals().empty_files == 1
    for quaternion in ([0.0] * 4, [math.nan, 0.0, 0.0, 1.0]):
        prior = {"quaternion": quaternion}
        (line,) = read(packed([batches[0] | {"a_priori": prior}]), reader := reader_of())
        assert json.loads(line.body)["a_priori"] is None
        assert reader.totals().without_attitude == 1


def two_packets(data):
    return list(islice(packets_in(io.BytesIO(data)), 2))


def test_the_example_of_the_documents_works(acquire, tmp_path, monkeypatch):
    docs = Path(__file__).parents[3] / "docs"
    (tmp_path / "missions").mkdir()
    shutil.copy(docs / "example-packets.toml", tmp_path / "missions")
    monkeypatch.setenv("ACQUIRE_MISSIONS", str(tmp_path / "missions"))
    of_packets = ["--packets", docs / "example-packets.dat", "--xtce", docs / "example-packets.xml"]
    code, out, _ = acquire("replay", *of_packets, "--in-process", "--json")
    told = json.loads(out)
    assert (code, told["packets"]["packets"], told["batches"], told["attitudes"]) == (0, 10, 10, 10)
