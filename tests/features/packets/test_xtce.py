"""An XTCE file from outside is read in bounds: no entity, no network, no silent misreading."""

import socket
import struct

import pytest

from service.errors import BadFile
from service.features.packets.definition import PacketDefinition
from tests.features.packets.packing import NAMESPACES, packet, xtce

DOCTYPE = '<!DOCTYPE SpaceSystem [<!ENTITY a "aaaaaaaaaa">]>\n'
BOMB = (
    '<!DOCTYPE SpaceSystem [<!ENTITY a "aaaaaaaaaa">'
    + "".join(
        f'<!ENTITY {b} "&{a};&{a};&{a};&{a};&{a};&{a};">'
        for a, b in zip("abcdef", "bcdefg", strict=True)
    )
    + "]>\n"
)
OUTSIDE = '<!DOCTYPE SpaceSystem SYSTEM "http://127.0.0.1:9/space.dtd">\n'


def refused(text, root="CCSDSPacket"):
    with pytest.raises(BadFile) as refusal:
        PacketDefinition(text, "site/test.xml", root)
    (fault,) = refusal.value.faults
    assert fault.field.startswith("site/test.xml")
    return fault


@pytest.mark.parametrize("doctype", [DOCTYPE, BOMB, OUTSIDE])
def test_a_document_type_is_refused_by_its_line(doctype):
    fault = refused(xtce(doctype=doctype))
    assert fault.field == "site/test.xml, line 2"
    assert "entities" in fault.message


def test_a_document_type_in_another_encoding_is_refused_too():
    text = xtce(doctype=DOCTYPE).decode().replace("UTF-8", "UTF-16", 1)
    assert "entities" in refused(text.encode("utf-16")).message


def test_a_remote_schema_is_not_fetched(monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("a socket was opened")

    monkeypatch.setattr(socket, "socket", refuse)
    monkeypatch.setattr(socket, "create_connection", refuse)
    text = xtce().replace(
        b'<xtce:SpaceSystem name="TEST"',
        b'<xtce:SpaceSystem name="TEST" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
        b'xsi:schemaLocation="http://www.omg.org/spec/XTCE/20180204 http://127.0.0.1:9/x.xsd"',
    )
    assert PacketDefinition(text, "test.xml", "CCSDSPacket").parameters


def test_an_include_is_refused_by_its_line():
    include = '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="file:///etc/passwd"/>'
    fault = refused(xtce(parameters=include))
    assert "another namespace" in fault.message
    assert "XInclude" in fault.value


@pytest.mark.parametrize("style", NAMESPACES)
def test_every_style_of_namespaces_gives_the_same_parameters(style):
    found = PacketDefinition(xtce(style), "test.xml", "CCSDSPacket").parameters
    assert found == PacketDefinition(xtce(), "test.xml", "CCSDSPacket").parameters
    assert {"ST1_A[0]", "ST1_A[7]", "ST_DAY", "PKT_APID"} <= found.keys()


def in_attitude(text, name):
    """The file with one more parameter at the end of the packets of APID 302."""
    end = text.index(b"</xtce:EntryList>", text.index(b'name="ATTITUDE"'))
    entry = f'<xtce:ParameterRefEntry parameterRef="{name}"/>'.encode()
    return text[:end] + entry + text[end:]


def test_the_members_of_an_array_of_aggregates_are_read_in_order():
    types = (
        '<xtce:AggregateParameterType name="STAR_T"><xtce:MemberList>'
        '<xtce:Member name="H" typeRef="DOUBLE_T"/><xtce:Member name="V" typeRef="DOUBLE_T"/>'
        "</xtce:MemberList></xtce:AggregateParameterType>"
        '<xtce:ArrayParameterType name="STARS_T" arrayTypeRef="STAR_T"><xtce:DimensionList>'
        "<xtce:Dimension><xtce:StartingIndex><xtce:FixedValue>0</xtce:FixedValue>"
        "</xtce:StartingIndex><xtce:EndingIndex><xtce:FixedValue>1</xtce:FixedValue>"
        "</xtce:EndingIndex></xtce:Dimension></xtce:DimensionList></xtce:ArrayParameterType>"
    )
    text = xtce(types=types, parameters='<xtce:Parameter name="S" parameterTypeRef="STARS_T"/>')
    definition = PacketDefinition(in_attitude(text, "S"), "test.xml", "CCSDSPacket")
    data = bytes(8) + struct.pack(">8d", 0, 0, 0, 1, 1.5, 2.5, 3.5, 4.5)
    values = definition.read(packet(data, apid=302))
    names = ("S[0].H", "S[0].V", "S[1].H", "S[1].V")
    assert [values[name] for name in names] == [1.5, 2.5, 3.5, 4.5]


def entry(inside):
    return f'<xtce:ParameterRefEntry parameterRef="Q1">{inside}</xtce:ParameterRefEntry>'


POLYNOMIAL = (
    '<xtce:FloatParameterType name="P_T"><xtce:FloatDataEncoding sizeInBits="64">'
    '<xtce:DefaultCalibrator><xtce:PolynomialCalibrator><xtce:Term coefficient="1" '
    'exponent="{}"/></xtce:PolynomialCalibrator></xtce:DefaultCalibrator>'
    "</xtce:FloatDataEncoding></xtce:FloatParameterType>"
)
INTEGER = (
    '<xtce:IntegerParameterType name="I_T"><xtce:IntegerDataEncoding sizeInBits="{}"/>'
    "</xtce:IntegerParameterType>"
)


def ordered(encoding, significances):
    """A type of 64 bits with a list of its bytes, as XTCE 1.1 has it."""
    listed = "".join(f'<xtce:Byte byteSignificance="{each}"/>' for each in significances)
    kind = encoding.replace("DataEncoding", "ParameterType")
    return (
        f'<xtce:{kind} name="O_T" sizeInBits="64"><xtce:{encoding} sizeInBits="64">'
        f"<xtce:ByteOrderList>{listed}</xtce:ByteOrderList></xtce:{encoding}></xtce:{kind}>"
    )


UNSUPPORTED = [
    (xtce(entries='<xtce:FixedValueEntry binaryValue="00" sizeInBits="8"/>'), "FixedValueEntry"),
    (xtce(entries=entry("<xtce:RepeatEntry/>")), "RepeatEntry"),
    (xtce(entries=entry("<xtce:IncludeCondition/>")), "IncludeCondition"),
    (
        xtce(
            entries=entry(
                '<xtce:LocationInContainerInBits referenceLocation="containerStart">'
                "<xtce:FixedValue>8</xtce:FixedValue></xtce:LocationInContainerInBits>"
            )
        ),
        "LocationInContainerInBits",
    ),
    (xtce(entries='<xtce:ParameterRefEntry parameterRef="NOT_THERE"/>'), "names no parameter"),
    (
        xtce(parameters="<xtce:Parameter name='X'/>", entries=entry("").replace("Q1", "X")),
        "parameterTypeRef",
    ),
    (xtce(types=POLYNOMIAL.format(1_000_000_000)), "exponent"),
    (xtce(types=POLYNOMIAL.format("00000000000000000000099999999")), "12 digits"),
    (xtce(types=INTEGER.format(10_000_000)), "sizeInBits"),
    (xtce(types=INTEGER.format(0)), "sizeInBits"),
    (xtce(types=INTEGER.format('16" bitOrder="leastSignificantBitFirst')), "bitOrder"),
    (xtce(types=ordered("IntegerDataEncoding", [1, 0, 2])), "ascend or descend"),
    (xtce(entries='<xtce:ContainerRefEntry containerRef="STARS"/>'), "refers to itself"),
    (xtce(entries='<xtce:ContainerRefEntry containerRef="NONE"/>'), "NONE"),
    (xtce()[:-60], "is not XML"),
    (b"", "is not XML"),
    (b"<SpaceSystem/>", "TelemetryMetaData/ParameterTypeSet"),
    (b"<html/>", "SpaceSystem"),
    (b'<SpaceSystem xmlns="http://www.w3.org/1999/xhtml"/>', "namespace"),
]


@pytest.mark.parametrize("order", "<>")
def test_a_list_of_bytes_gives_the_order_of_a_parameter(order):
    significances = range(8) if order == "<" else range(7, -1, -1)
    text = in_attitude(
        xtce(
            types=ordered("FloatDataEncoding", significances),
            parameters='<xtce:Parameter name="O" parameterTypeRef="O_T"/>',
        ),
        "O",
    )
    data = bytes(8) + struct.pack(">4d", 0, 0, 0, 1) + struct.pack(order + "d", 1.5)
    definition = PacketDefinition(text, "test.xml", "CCSDSPacket")
    assert definition.read(packet(data, apid=302))["O"] == 1.5


@pytest.mark.parametrize(("text", "why"), UNSUPPORTED)
def test_what_would_be_misread_or_take_long_is_refused_in_words(text, why):
    fault = refused(text)
    assert why in fault.message
    assert "Traceback" not in fault.message


def test_containers_that_hold_each_other_a_million_times_are_refused():
    p = "xtce:"
    nested = "".join(
        f'<{p}SequenceContainer name="N{k}"><{p}EntryList>'
        + f'<{p}ContainerRefEntry containerRef="N{k + 1}"/>' * 10
        + f"</{p}EntryList></{p}SequenceContainer>"
        for k in range(6)
    )
    last = f'<{p}SequenceContainer name="N6"><{p}EntryList/></{p}SequenceContainer>'
    text = xtce().replace(
        b"</xtce:ContainerSet>", (nested + last).encode() + b"</xtce:ContainerSet>"
    )
    assert PacketDefinition(text, "test.xml", "CCSDSPacket").parameters
    full = text.replace(
        b'name="N6"><xtce:EntryList/>',
        b'name="N6"><xtce:EntryList><xtce:ParameterRefEntry parameterRef="Q1"/></xtce:EntryList>',
    )
    assert "entries" in refused(full).message


def test_a_root_container_that_is_not_there_is_named_with_those_that_are():
    message = refused(xtce(), "Packet").message
    assert "Packet" in message
    assert "CCSDSPacket" in message


def test_a_file_that_is_too_large_is_refused_before_it_is_parsed():
    assert "MiB" in refused(xtce() + b" " * (17 << 20)).message
