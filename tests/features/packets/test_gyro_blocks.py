"""Gyro samples in packets give the gyro blocks that were packed, as rates, counts and arrays."""

import io
import json
import struct

import numpy as np
import pytest

from service.app.factory import open_app
from service.cli import main
from service.errors import BadConfiguration, BadInput
from service.features.packets.batches import GyroRates
from service.features.packets.clock import Moment
from service.features.packets.definition import PacketDefinition
from service.features.packets.reader import PacketReader
from service.gyro.blocks import block_from_line
from service.missions.mission import SHIPPED_FOLDER
from service.missions.packets import PacketGyro
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import GyroWanted, draw_pass, with_gyro
from service.times import parse_utc, shifted
from tests.features.packets.packing import (
    APID,
    NAMESPACES,
    TABLE,
    cds,
    fields,
    mission_with,
    packet,
    xtce,
)

GYRO_APID = 303
SAMPLES = 10
AXES = ("GYRO_X", "GYRO_Y", "GYRO_Z")
BLOCKS = """
[packets.gyro_blocks]
samples = 10
values = ["GYRO_X", "GYRO_Y", "GYRO_Z"]
step_s = 0.5
block_s = 60
"""
START = parse_utc("1999-03-01T00:00:00Z")


def described(kind="DOUBLE_T", style="default"):
    """The XTCE file of the pass with a container of gyro samples in arrays."""
    _, p = NAMESPACES[style]
    types = (
        f'<{p}IntegerParameterType name="COUNT_T" signed="false"><{p}IntegerDataEncoding '
        f'sizeInBits="16" encoding="unsigned"/></{p}IntegerParameterType>\n'
        f'<{p}ArrayParameterType name="GYRO_T" arrayTypeRef="{kind}"><{p}DimensionList>'
        f"<{p}Dimension><{p}StartingIndex><{p}FixedValue>0</{p}FixedValue></{p}StartingIndex>"
        f"<{p}EndingIndex><{p}FixedValue>{SAMPLES - 1}</{p}FixedValue></{p}EndingIndex>"
        f"</{p}Dimension></{p}DimensionList></{p}ArrayParameterType>\n"
    )
    parameters = "".join(
        f'<{p}Parameter name="{name}" parameterTypeRef="GYRO_T"/>\n' for name in AXES
    )
    time = "".join(
        f'<{p}ParameterRefEntry parameterRef="{name}"/>' for name in ("ST_DAY", "ST_MS", "ST_US")
    )
    arrays = "".join(f'<{p}ArrayParameterRefEntry parameterRef="{name}"/>' for name in AXES)
    container = (
        f'<{p}SequenceContainer name="GYRO"><{p}EntryList>{time}{arrays}</{p}EntryList>'
        f'<{p}BaseContainer containerRef="CCSDSPacket"><{p}RestrictionCriteria>'
        f'<{p}Comparison parameterRef="PKT_APID" value="{GYRO_APID}" useCalibratedValue="false"/>'
        f"</{p}RestrictionCriteria></{p}BaseContainer></{p}SequenceContainer>\n"
    )
    whole = xtce(style, types, parameters).decode()
    return whole.replace(f"</{p}ContainerSet>", f"{container}</{p}ContainerSet>").encode()


def mission(blocks=BLOCKS):
    directions = 'h = "ST1_A"\nv = "ST1_B"'
    return mission_with(TABLE.format(directions=directions) + blocks)


def reader_of(blocks=BLOCKS, kind="DOUBLE_T"):
    return PacketReader(
        mission(blocks), PacketDefinition(described(kind), "gyro.xml", "CCSDSPacket")
    )


def gyro_packet(at, values, form="d", count=0):
    """A packet of ten samples, (10, 3), from a moment on."""
    columns = np.asarray(values).T.tolist()
    data = struct.pack(">HIH", *cds(at.text))
    data += b"".join(struct.pack(f">{SAMPLES}{form}", *column) for column in columns)
    return packet(data, count, GYRO_APID)


def packets_of(rates, start=START, step_s=0.5, form="d"):
    """Packets of rates (n, 3), n a multiple of ten."""
    return [
        gyro_packet(shifted(start, step_s * k), rates[k : k + SAMPLES], form, k // SAMPLES)
        for k in range(0, len(rates), SAMPLES)
    ]


def read(data, reader):
    return list(reader.lines(io.BytesIO(b"".join(data)), "gyro.dat"))


def samples_of(lines):
    """Times (n,) and rates (n, 3) of all blocks."""
    blocks = [block_from_line(each.body, "live") for each in lines if each.body]
    return (
        np.concatenate([each.tai_ns for each in blocks]),
        np.concatenate([each.rates_rad_per_s for each in blocks]),
    )


@pytest.fixture(scope="module")
def rates():
    return np.random.default_rng(3).normal(0.0, 1e-3, (300, 3))


def test_a_pass_in_packets_gives_its_batches_and_its_gyro_samples(missions, sky):
    """The simulator's pass: batches and gyro blocks, packed by struct, are what is read."""
    own = mission()
    wanted = Pass(20, 3, angles_share=1.0)
    drawn = list(with_gyro(draw_pass(missions["XTE"], sky, wanted), own, GyroWanted(0.5), 600.0, 3))
    blocks = [block_from_line(json.dumps(block), "live") for each in drawn for block in each.gyro]
    times = np.concatenate([each.tai_ns for each in blocks])
    packed = np.concatenate([each.rates_rad_per_s for each in blocks])
    whole = len(packed) // SAMPLES * SAMPLES
    data = [packet(fields(each.batch), k) for k, each in enumerate(drawn)]
    data += packets_of(packed[:whole], blocks[0].start)
    reader = reader_of()
    lines = read(data, reader)
    assert [each.fault for each in lines if each.fault] == []
    totals = reader.totals()
    assert (totals.batches, totals.gyro_samples) == (20, whole)
    found_ns, found = samples_of([each for each in lines if b"rates_rad" in each.body])
    # Times in packets have microseconds.
    assert np.abs(found_ns - times[:whole]).max() <= 1000
    assert np.array_equal(found, packed[:whole])


def test_blocks_do_not_depend_on_the_packets_that_a_file_begins_with(rates):
    whole = read(packets_of(rates), reader_of())
    blocks = [json.loads(each.body) for each in whole]
    assert [len(each["times_s"]) for each in blocks] == [56, 120, 120, 4]
    # Minutes of TAI, which was 32 s ahead of UTC.
    assert blocks[1]["block"] == f"{GYRO_APID}-1999-03-01T00:00:28.000Z"
    # From the sixth packet on, which is in the first block: the same blocks from the second on.
    later = read(packets_of(rates)[5:], reader_of())
    assert [each.body for each in later[1:]] == [each.body for each in whole[1:]]


def test_packets_that_were_sent_twice_give_their_samples_once(rates):
    """One after the other, as two receivers of a ground station store them."""
    once = packets_of(rates)
    twice = [packet for each in once for packet in (each, each)]
    found = [each.body for each in read(twice, reader_of())]
    assert found == [each.body for each in read(once, reader_of())]


def test_accumulated_counts_give_the_rates_of_their_steps_through_the_end_of_the_counter(rates):
    unit = 1e-6
    counts = np.cumsum(np.rint(rates * 0.5 / unit), axis=0).astype(int)
    table = BLOCKS + 'kind = "angle"\nscale_rad = [1e-6, 1e-6, 1e-6]\n'
    reader = reader_of(table, "COUNT_T")
    lines = read(packets_of(counts % 65536, form="H"), reader)
    _, found = samples_of(lines)
    # The first count has none before it.
    assert len(found) == 299
    np.testing.assert_allclose(found, np.diff(counts, axis=0) * unit / 0.5, rtol=1e-12)
    assert counts.max() > 65536 or counts.min() < 0


def test_no_rate_is_made_across_a_gap_of_counts(rates):
    counts = np.zeros((60, 3), int)
    table = BLOCKS + 'kind = "angle"\nmax_gap_s = 2.0\n'
    data = packets_of(counts[:30], form="H")
    data += packets_of(counts[30:], shifted(START, 100.0), form="H")
    times, _ = samples_of(read(data, reader_of(table, "COUNT_T")))
    assert len(times) == 58
    assert np.diff(times).max() == 86 * 10**9


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (np.nan, "GYRO_Y[3]"),
        (np.inf, "GYRO_Y[3]"),
        (57.0, "beyond the largest of XTE, 0.174533 rad/s"),
    ],
)
def test_a_bad_sample_costs_its_packet_alone_and_is_named(rates, value, told):
    bad = rates[:60].copy()
    bad[23, 1] = value
    reader = reader_of()
    lines = read(packets_of(bad), reader)
    (fault,) = [each.fault for each in lines if each.fault]
    assert told in f"{fault.field}: {fault.message}"
    assert "packet 3" in fault.field
    totals = reader.totals()
    assert (totals.gyro_samples, totals.refused) == (50, 1)


def test_time_that_goes_back_begins_another_block(rates):
    data = packets_of(rates[:20]) + packets_of(rates[20:30])
    lines = read(data, reader_of())
    assert [len(json.loads(each.body)["times_s"]) for each in lines] == [20, 10]


@pytest.mark.parametrize(
    ("blocks", "told"),
    [
        (BLOCKS.replace("step_s = 0.5\n", ""), "needs either step_s or time_offset_s"),
        (BLOCKS + "scale_rad = [1.0, 0.0, 1.0]\n", "scale_rad must hold three numbers"),
        (BLOCKS.replace('"GYRO_Z"]', '["A", "B"]]'), "names 2 parameters for 10 samples"),
    ],
)
def test_a_table_that_cannot_be_meant_is_refused(blocks, told):
    with pytest.raises(BadConfiguration, match=told):
        mission(blocks)


def test_a_parameter_that_xtce_lacks_is_named():
    with pytest.raises(BadInput, match=r"packets.gyro_blocks.values.1.*GYRO_W"):
        reader_of(BLOCKS.replace("GYRO_Y", "GYRO_W"))


def test_a_mission_without_the_table_keeps_its_digest():
    without = mission("")
    assert "gyro_blocks" not in without.model_dump_json()
    assert without.digest != mission().digest


def test_the_command_records_the_blocks_once_and_counts_them(tmp_path, rates, capsys, monkeypatch):
    (tmp_path / "missions").mkdir()
    directions = 'h = "ST1_A"\nv = "ST1_B"'
    text = (SHIPPED_FOLDER / "xte.toml").read_text(encoding="utf-8")
    text += TABLE.format(directions=directions) + BLOCKS
    (tmp_path / "missions" / "xte.toml").write_text(text, encoding="utf-8")
    (tmp_path / "gyro.xml").write_bytes(described())
    (tmp_path / "gyro.dat").write_bytes(b"".join(packets_of(rates)))
    database = f"sqlite:///{tmp_path}/acquire.db"
    words = [
        *("replay", "--packets", f"{tmp_path}/gyro.dat", "--xtce", f"{tmp_path}/gyro.xml"),
        *("--in-process", "--run", "pass", "--database", database),
        "--json",
    ]
    monkeypatch.setenv("ACQUIRE_MISSIONS", f"{tmp_path}/missions")
    for new, again in ((4, 0), (0, 4)):
        assert main(words) == 0
        told = json.loads(capsys.readouterr().out)
        assert (told["packets"]["gyro_blocks"], told["packets"]["gyro_samples"]) == (4, 300)
        assert told["gyro_blocks"] == {"new": new, "already_recorded": again}
    app = open_app(Settings(database=database, missions=tmp_path / "missions"))
    try:
        rows = app.gyro.page("XTE", run="pass").items
        kept = app.gyro.get("XTE", rows[1].id)
        assert np.array_equal(kept.rates_rad_per_s, rates[56:176])
        assert kept.start == "1999-03-01T00:00:28.000Z"
    finally:
        app.close()


def test_stars_of_a_packet_are_kept_though_its_gyro_is_not(missions, sky):
    (drawn,) = [each.batch for each in draw_pass(missions["XTE"], sky, Pass(1, 3, angles_share=1))]
    table = BLOCKS.replace("samples = 10", "samples = 1").replace("step_s = 0.5\n", "")
    table = table.replace('["GYRO_X", "GYRO_Y", "GYRO_Z"]', '[["RATE_X"], ["RATE_Y"], ["RATE_Z"]]')
    reader = reader_of(table)
    drawn = drawn | {"body_rates_deg_per_s": [0.0, 0.5, 0.0]}
    lines = read([packet(fields(drawn), 0, APID)], reader)
    assert [each.fault is None for each in lines] == [True, False]
    assert reader.totals().batches == 1


def test_counts_that_were_sent_twice_keep_the_rates_of_their_step():
    gyro = PacketGyro(counts=("G0", "G1", "G2"), scale_deg=(0.1, 0.1, 0.1))
    steps = [(0, (0, 0, 0)), (1, (1, 2, 3)), (2, (3, 6, 9)), (40, (3, 6, 9))]

    def rates(moments):
        turning = GyroRates(gyro, ("G0", "G1", "G2"))
        return [
            turning.add(dict(zip(("G0", "G1", "G2"), counts, strict=True)), Moment("", s * 10**9))
            for s, counts in moments
        ]

    once = rates(steps)
    assert [each is None for each in once] == [True, False, False, True]
    assert rates([each for step in steps for each in (step, step)]) == [
        each for rate in once for each in (rate, rate)
    ]
