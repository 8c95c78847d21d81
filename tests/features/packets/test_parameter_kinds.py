"""Enumerated, boolean and text parameters: taken where they fit, else refused before any packet."""

from pathlib import Path

import pytest

from service.errors import BadInput
from service.features.packets.definition import PacketDefinition
from service.features.packets.reader import PacketReader, archive_of
from service.observations.schema import submission_from_json
from tests.features.packets.packing import TABLE, VECTORS, mission_with, xtce
from tests.fresh_databases import sqlite_at
from tests.web.serving import ended, serving_in_process

FOLDER = Path(__file__).parent / "enumerated"
XTCE = (FOLDER / "enum.xml").read_text()
TABLE_OF_FLAG = """
[packets]
[packets.time]
kind = "cds"
day = "DAY"
millisecond = "MS"
[[packets.measurements]]
quaternion = ["Q1", "Q2", "Q3", "Q4"]
sigma_arcsec = [5, 5, 30]
valid = "VALID"
"""
LABELS = XTCE[XTCE.index("<EnumerationList>") : XTCE.index("</EnumerationList>")]


def labelled(**numbers):
    entries = "".join(
        f'<Enumeration value="{value}" label="{label}"/>' for label, value in numbers.items()
    )
    return XTCE.replace(LABELS, f"<EnumerationList>{entries}")


def read(table=TABLE_OF_FLAG, described=XTCE):
    definition = PacketDefinition(described.encode(), "enum.xml", "CCSDSPacket")
    reader = PacketReader(mission_with(table), definition)
    with (FOLDER / "a.dat").open("rb") as file:
        lines = list(reader.lines(file, "a.dat"))
    assert [line.fault for line in lines if line.fault is not None] == []
    return [submission_from_json(line.body).batch for line in lines], reader.totals()


def test_an_enumerated_flag_counts_by_its_number():
    """The input of a public report: six packets, of which three are VALID."""
    batches, totals = read()
    assert len(batches) == 3
    assert totals.without_stars == 3
    assert totals.refused == 0


def test_the_same_packets_over_http_give_the_same_attitudes(tmp_path):
    content = b"".join(archive_of([FOLDER / "enum.xml", FOLDER / "a.dat"]))
    headers = {"Content-Type": "application/x-tar"}
    database = sqlite_at(tmp_path / "packets.db")
    with serving_in_process(database, mission_with(TABLE_OF_FLAG)) as served:
        begun = served.client.post("/api/v1/replays?run=flags", content=content, headers=headers)
        state = ended(served.client, begun)
    assert (state["state"], state["counts"]["new"]) == ("done", 3)
    assert (state["packets"]["packets"], state["packets"]["refused"]) == (6, 0)


def test_valid_labels_say_which_labels_hold_an_attitude():
    wanted = [each.time for each in read()[0]]
    table = TABLE_OF_FLAG + 'valid_labels = ["TRACKING"]\n'
    assert [each.time for each in read(table, labelled(ACQUIRING=0, TRACKING=1))[0]] == wanted
    others = [each.time for each in read(table, labelled(TRACKING=0, ACQUIRING=1))[0]]
    assert len(others) == 3
    assert not set(others) & set(wanted)


def test_a_range_of_numbers_has_one_label():
    described = XTCE.replace('value="1" label="VALID"', 'value="1" maxValue="200" label="VALID"')
    assert len(read(described=described)[0]) == 3


def test_a_unit_of_several_is_no_reason_to_refuse_the_file():
    of_speed = '<UnitSet><Unit>m</Unit><Unit power="-1">s</Unit></UnitSet><IntegerDataEncoding '
    head, kind, rest = XTCE.partition('name="U3" signed="false"><IntegerDataEncoding ')
    described = head + kind.replace("<IntegerDataEncoding ", of_speed) + rest
    assert len(read(described=described)[0]) == 3


BOOLEAN = XTCE.replace("Enumerated", "Boolean").replace(LABELS + "</EnumerationList>", "")


def test_a_boolean_flag_counts_where_it_is_true():
    assert [each.time for each in read(described=BOOLEAN)[0]] == [each.time for each in read()[0]]


def named(zero, one):
    """A boolean whose two values have names."""
    names = f'name="VT" zeroStringValue="{zero}" oneStringValue="{one}"'
    return BOOLEAN.replace('name="VT"', names)


@pytest.mark.parametrize(
    ("described", "label"),
    [(named("NO", "YES"), None), (named("BAD", "SET"), "SET"), (named("OK", "BAD"), "BAD")],
)
def test_a_boolean_with_names_is_judged_by_them(described, label):
    more = "" if label is None else f'valid_labels = ["{label}"]'
    batches, _ = read(TABLE_OF_FLAG + more, described)
    assert [each.time for each in batches] == [each.time for each in read()[0]]


def test_the_name_of_zero_may_mean_valid():
    found = [
        each.time for each in read(TABLE_OF_FLAG + 'valid_labels = ["OK"]', named("OK", "BAD"))[0]
    ]
    assert len(found) == 3
    assert not set(found) & {each.time for each in read()[0]}


def test_without_labels_a_flag_by_number_is_as_before():
    number = XTCE.replace(
        'name="VALID" parameterTypeRef="VT"', 'name="VALID" parameterTypeRef="U8"'
    )
    kind = '<IntegerParameterType name="U8" signed="false"><IntegerDataEncoding sizeInBits="8"/>'
    number = number.replace("<EnumeratedP", f"{kind}</IntegerParameterType><EnumeratedP", 1)
    assert len(read(described=number)[0]) == 3


@pytest.mark.parametrize(
    ("described", "more", "words"),
    [
        (labelled(VALID=0, INVALID=1), "", "VALID = 0, INVALID = 1: give valid_labels"),
        (labelled(OFF=0, ACQUIRING=1, TRACKING=2), "", "give valid_labels"),
        (XTCE, 'valid_labels = ["GOOD"]', "has no label 'GOOD' of valid_labels; it has INVALID"),
        (named("VALID", "INVALID"), "", "is a boolean, VALID = 0, INVALID = 1: give valid_labels"),
        (named("NO", "YES"), 'valid_labels = ["GOOD"]', "has no label 'GOOD' of valid_labels"),
        (XTCE.replace('"INVALID"', '"VALID"'), "", "is enumerated, VALID: give valid_labels"),
        (BOOLEAN, 'valid_labels = ["VALID"]', "is a boolean parameter and has no labels"),
    ],
)
def test_labels_that_do_not_tell_are_refused_before_any_packet(described, more, words):
    with pytest.raises(BadInput) as refusal:
        read(TABLE_OF_FLAG + more, described)
    assert "packets.measurements.0.valid" in str(refusal.value)
    assert words in str(refusal.value)


@pytest.mark.parametrize("described", [XTCE, BOOLEAN])
def test_a_flag_names_no_batch(described):
    with pytest.raises(BadInput, match=r"packets.batch: .*; a number or a text is needed"):
        read(TABLE_OF_FLAG.replace("[packets]\n", '[packets]\nbatch = "VALID"\n'), described)


PARAMETERS = {
    "time": ("ST_DAY", "ST_MS", "ST_US"),
    "trackers.0.count": ("ST1_STARS",),
    "trackers.0.vector.0": ("ST1_A",),
    "trackers.0.magnitude": ("ST1_MAG",),
    "trackers.0.time_offset_s": ("ST1_DT",),
    "prior.quaternion": ("Q1",),
    "rates.components": ("RATE_X",),
    "velocity.components": ("VEL_Y",),
    "position.components": ("POS_Z",),
}
KINDS = {
    "ENUM_T": "is an enumerated parameter; a number is needed",
    "BOOL_T": "is a boolean parameter; a number is needed",
    "TEXT_T": "is a text parameter; a number is needed",
}
TYPES = (
    '<xtce:EnumeratedParameterType name="ENUM_T"><xtce:IntegerDataEncoding sizeInBits="64"/>'
    '<xtce:EnumerationList><xtce:Enumeration value="1" label="ON"/></xtce:EnumerationList>'
    '</xtce:EnumeratedParameterType><xtce:BooleanParameterType name="BOOL_T">'
    '<xtce:IntegerDataEncoding sizeInBits="64"/></xtce:BooleanParameterType>'
)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("key", PARAMETERS)
def test_a_number_is_needed_in_every_other_place(key, kind):
    described = xtce("prefixed", TYPES).decode()
    for name in PARAMETERS[key]:
        for own in (
            f'"{name}" parameterTypeRef="{name}_T"',
            f'"{name}" parameterTypeRef="DOUBLE_T"',
        ):
            described = described.replace(own, f'"{name}" parameterTypeRef="{kind}"')
        described = described.replace(
            f'name="{name}_T" arrayTypeRef="DOUBLE_T"', f'name="{name}_T" arrayTypeRef="{kind}"'
        )
        if name in ("ST1_A", "ST1_MAG", "ST1_DT"):
            described = described.replace(
                f'"{name}" parameterTypeRef="{kind}"', f'"{name}" parameterTypeRef="{name}_T"'
            )
    definition = PacketDefinition(described.encode(), "pass.xml", "CCSDSPacket")
    with pytest.raises(BadInput) as refusal:
        PacketReader(mission_with(TABLE.format(directions=VECTORS)), definition)
    assert f"packets.{key}: {KINDS[kind]}" in str(refusal.value)


def timed(encoding, epoch, table, parameter="MS"):
    """Reader of packets whose parameter is an absolute time of XTCE."""
    kind = "U16" if parameter == "DAY" else "U32"
    bits = kind[1:]
    described = XTCE.replace(
        f'"{parameter}" parameterTypeRef="{kind}"', f'"{parameter}" parameterTypeRef="T_T"'
    ).replace(
        "</ParameterTypeSet>",
        f'<AbsoluteTimeParameterType name="T_T"><Encoding {encoding}><IntegerDataEncoding '
        f'sizeInBits="{bits}" encoding="unsigned"/></Encoding><ReferenceTime><Epoch>{epoch}</Epoch>'
        "</ReferenceTime></AbsoluteTimeParameterType></ParameterTypeSet>",
    )
    start = TABLE_OF_FLAG.index('kind = "cds"')
    end = TABLE_OF_FLAG.index("[[packets.measurements]]")
    definition = PacketDefinition(described.encode(), "enum.xml", "CCSDSPacket")
    own = TABLE_OF_FLAG[:start] + table + "\n" + TABLE_OF_FLAG[end:]
    return PacketReader(mission_with(own), definition)


CUC = 'kind = "cuc"\ncoarse = "MS"\nscale = "tai"\nepoch = 1958-01-01T00:00:00'
GPS = 'kind = "cuc"\ncoarse = "MS"\nscale = "gps"\nepoch = 1980-01-06T00:00:00'
DAYS = 'kind = "cds"\nday = "DAY"\nmillisecond = "MS"'


@pytest.mark.parametrize(
    ("encoding", "epoch", "table", "words"),
    [
        (
            'units="seconds"',
            "GPS",
            CUC,
            "counts from GPS by the XTCE file, from 1958-01-01T00:00:00",
        ),
        ("", "TAI", GPS, "counts from TAI by the XTCE file"),
        ("", "UNIX", CUC, "counts from UNIX by the XTCE file"),
        ("", "GPS", GPS.replace('"gps"', '"tai"'), "counts from GPS .* on the clock tai"),
        ("", "GPS", GPS.replace('"gps"', '"utc"'), "counts from GPS .* on the clock utc"),
        ("", "2000-01-01T12:00:00", CUC, "counts from 2000-01-01T12:00:00"),
        ('units="milliseconds"', "TAI", CUC, "is in milliseconds by the XTCE file; units of 1 s"),
        ('units="seconds" scale="0.001"', "TAI", CUC, "has the scale 0.001 in the XTCE file"),
        ('units="seconds"', "1958-01-01", DAYS, "is in seconds by the XTCE file; units of 0.001 s"),
    ],
)
def test_a_time_that_the_xtce_file_counts_otherwise_is_refused(encoding, epoch, table, words):
    with pytest.raises(BadInput, match=f"packets.time: {words}"):
        timed(encoding, epoch, table)


def test_a_day_of_another_epoch_is_refused():
    with pytest.raises(BadInput, match=r"packets.time: counts from 2000-01-01 by the XTCE file"):
        timed('units="days"', "2000-01-01", DAYS, "DAY")
    timed('units="days"', "1958-01-01", DAYS, "DAY")


@pytest.mark.parametrize(
    ("encoding", "epoch", "table"),
    [
        ('units="seconds"', "TAI", CUC),
        ("", "GPS", GPS),
        ("", "GPS", CUC.replace("1958-01-01T00:00:00", "1980-01-06T00:00:19")),
        ('scale="1"', "1980-01-06T00:00:00Z", GPS),
        ("", "J2000", GPS.replace("1980-01-06T00:00:00", "2000-01-01T12:00:00")),
        ("", "UNIX", GPS.replace("1980-01-06", "1970-01-01").replace('"gps"', '"utc"')),
        ("", "launch", CUC),
    ],
)
def test_a_time_that_the_xtce_file_counts_alike_is_read(encoding, epoch, table):
    timed(encoding, epoch, table)
