"""A pass packed as space packets, and the XTCE file that describes them.

The headers are made by space-packet-parser, the fields by struct: nothing of the reader is used.
"""

import math
import struct
from datetime import date
from pathlib import Path

from space_packet_parser.generators.ccsds import create_ccsds_packet

from service.missions.mission import SHIPPED_FOLDER, parse_mission

JPSS1 = Path(__file__).parent / "jpss1"
JPSS1_PACKETS = JPSS1 / "J01_G011_LZ_2021-04-09T00-00-00Z_V01.DAT1"
JPSS1_XTCE = JPSS1 / "jpss1_geolocation_xtce_v1.xml"
JPSS1_TABLE = """
[packets.time]
kind = "cds"
day = "ADAET2DAY"
millisecond = "ADAET2MS"
microsecond = "ADAET2US"
[packets.prior]
quaternion = ["ADCFAQ1", "ADCFAQ2", "ADCFAQ3", "ADCFAQ4"]
"""

APID = 301
ATTITUDE_APID = 302
SLOTS = 8
BATCH_BYTES = 24
NAMESPACES = {
    "prefixed": ('xmlns:xtce="http://www.omg.org/spec/XTCE/20180204"', "xtce:"),
    "default": ('xmlns="http://www.omg.org/spec/XTCE/20180204"', ""),
    "version 1.1": ('xmlns:x="http://www.omg.org/space/xtce"', "x:"),
    "none": ("", ""),
}
"""The four ways in which files name their elements."""
HEADER = (
    ("VERSION", 3),
    ("TYPE", 1),
    ("SEC_HDR_FLG", 1),
    ("PKT_APID", 11),
    ("SEQ_FLGS", 2),
    ("SRC_SEQ_CTR", 14),
    ("PKT_LEN", 16),
)
FLOATS = [
    *(f"Q{i}" for i in (1, 2, 3, 4)),
    *(f"RATE_{axis}" for axis in "XYZ"),
    *(f"VEL_{axis}" for axis in "XYZ"),
    *(f"POS_{axis}" for axis in "XYZ"),
]
STAR_ARRAYS = ("ST1_A", "ST1_B", "ST1_C", "ST1_MAG", "ST1_DT")
"""Each of SLOTS numbers: h and v, or a vector, magnitude, seconds after the batch's time."""

TABLE = """
[packets]
batch = "ST_BATCH"
[packets.time]
kind = "cds"
day = "ST_DAY"
millisecond = "ST_MS"
microsecond = "ST_US"
[[packets.trackers]]
tracker = "STARTRACKER_1"
slots = 8
count = "ST1_STARS"
{directions}
magnitude = "ST1_MAG"
time_offset_s = "ST1_DT"
[packets.prior]
quaternion = ["Q1", "Q2", "Q3", "Q4"]
[packets.rates]
components = ["RATE_X", "RATE_Y", "RATE_Z"]
[packets.velocity]
components = ["VEL_X", "VEL_Y", "VEL_Z"]
[packets.position]
components = ["POS_X", "POS_Y", "POS_Z"]
"""
ANGLES = 'h = "ST1_A"\nv = "ST1_B"'
VECTORS = 'vector = ["ST1_A", "ST1_B", "ST1_C"]'


def mission_with(table, name="XTE"):
    """The mission XTE with a table `[packets]`."""
    text = (SHIPPED_FOLDER / "xte.toml").read_text(encoding="utf-8")
    return parse_mission(text.replace('name = "XTE"', f'name = "{name}"') + table, "test.toml")


def mission_of_pass(directions=ANGLES, extra=""):
    return mission_with(TABLE.format(directions=directions) + extra)


def xtce(style="prefixed", types="", parameters="", entries="", doctype=""):
    """The XTCE file of `packed`; the arguments add to it."""
    declared, p = NAMESPACES[style]
    bits = dict(HEADER)
    bits |= {"ST_DAY": 16, "ST_MS": 32, "ST_US": 16, "ST1_STARS": 8}
    integers = "".join(
        f'<{p}IntegerParameterType name="{name}_T" signed="false"><{p}IntegerDataEncoding '
        f'sizeInBits="{size}" encoding="unsigned"/></{p}IntegerParameterType>\n'
        for name, size in bits.items()
    )
    last = SLOTS - 1
    arrays = "".join(
        f'<{p}ArrayParameterType name="{name}_T" arrayTypeRef="DOUBLE_T"><{p}DimensionList>'
        f"<{p}Dimension><{p}StartingIndex><{p}FixedValue>0</{p}FixedValue></{p}StartingIndex>"
        f"<{p}EndingIndex><{p}FixedValue>{last}</{p}FixedValue></{p}EndingIndex></{p}Dimension>"
        f"</{p}DimensionList></{p}ArrayParameterType>\n"
        for name in STAR_ARRAYS
    )
    kinds = {name: f"{name}_T" for name in (*bits, *STAR_ARRAYS)}
    kinds |= dict.fromkeys(FLOATS, "DOUBLE_T") | {"ST_BATCH": "TEXT_T"}
    listed = "".join(
        f'<{p}Parameter name="{name}" parameterTypeRef="{kind}"/>\n' for name, kind in kinds.items()
    )

    def refs(names):
        return "".join(
            f"<{p}{'Array' if name in STAR_ARRAYS else ''}ParameterRefEntry "
            f'parameterRef="{name}"/>\n'
            for name in names
        )

    def child(name, apid, names):
        return (
            f'<{p}SequenceContainer name="{name}"><{p}EntryList>{refs(names)}'
            f"{entries if apid == APID else ''}</{p}EntryList>"
            f'<{p}BaseContainer containerRef="CCSDSPacket"><{p}RestrictionCriteria>'
            f'<{p}Comparison parameterRef="PKT_APID" value="{apid}" useCalibratedValue="false"/>'
            f"</{p}RestrictionCriteria></{p}BaseContainer></{p}SequenceContainer>\n"
        )

    time = ("ST_DAY", "ST_MS", "ST_US")
    stars = ("ST_BATCH", *time, *FLOATS, "ST1_STARS", *STAR_ARRAYS)
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n{doctype}'
        f'<{p}SpaceSystem name="TEST" {declared}>\n<{p}TelemetryMetaData>\n'
        f"<{p}ParameterTypeSet>\n{integers}{arrays}"
        f'<{p}FloatParameterType name="DOUBLE_T"><{p}FloatDataEncoding sizeInBits="64"/>'
        f"</{p}FloatParameterType>\n"
        f'<{p}StringParameterType name="TEXT_T"><{p}StringDataEncoding encoding="UTF-8">'
        f"<{p}SizeInBits><{p}Fixed><{p}FixedValue>{8 * BATCH_BYTES}</{p}FixedValue></{p}Fixed>"
        f"</{p}SizeInBits></{p}StringDataEncoding></{p}StringParameterType>\n{types}"
        f"</{p}ParameterTypeSet>\n<{p}ParameterSet>\n{listed}{parameters}</{p}ParameterSet>\n"
        f'<{p}ContainerSet>\n<{p}SequenceContainer name="CCSDSPacket" abstract="true">'
        f"<{p}EntryList>{refs(name for name, _ in HEADER)}</{p}EntryList></{p}SequenceContainer>\n"
        f"{child('STARS', APID, stars)}{child('ATTITUDE', ATTITUDE_APID, (*time, *FLOATS[:4]))}"
        f"</{p}ContainerSet>\n</{p}TelemetryMetaData>\n</{p}SpaceSystem>\n"
    ).encode()


def cds(time):
    """Day of 1958, milliseconds and microseconds of a UTC text that ends in Z."""
    day, clock = time.rstrip("Z").split("T")
    number = (date.fromisoformat(day) - date(1958, 1, 1)).days
    hours, minutes, seconds = clock.split(":")
    whole, _, decimals = seconds.partition(".")
    microseconds = int((decimals or "0").ljust(6, "0")[:6])
    milliseconds = (int(hours) * 3600 + int(minutes) * 60 + int(whole)) * 1000
    return number, milliseconds + microseconds // 1000, microseconds % 1000


def fields(batch):
    """The data field of a batch."""
    stars = batch["observations"][0]["stars"]
    columns = [
        [star["vector"][i] if "vector" in star else star[("h_deg", "v_deg")[i]] for star in stars]
        if i < 2 or any("vector" in star for star in stars)
        else [0.0] * len(stars)
        for i in range(3)
    ]
    columns.append([star.get("magnitude", math.nan) for star in stars])
    columns.append([star.get("time_offset_s", 0.0) for star in stars])
    spare = [math.nan] * (SLOTS - len(stars))
    return (
        batch["batch"].encode().ljust(BATCH_BYTES, b"\0")
        + struct.pack(">HIH", *cds(batch["time"]))
        + struct.pack(">4d", *batch["a_priori"]["quaternion"])
        + struct.pack(">3d", *batch["body_rates_deg_per_s"])
        + struct.pack(">3d", *batch["velocity_km_per_s"])
        + struct.pack(">3d", *batch["position_km"])
        + struct.pack(">B", len(stars))
        + b"".join(struct.pack(f">{SLOTS}d", *column, *spare) for column in columns)
    )


def packet(data, count=0, apid=APID):
    return bytes(create_ccsds_packet(data, apid=apid, sequence_count=count % 16384))


def packed(batches, first=0):
    """The batches as packets, counted from `first`."""
    return b"".join(packet(fields(each), first + k) for k, each in enumerate(batches))
