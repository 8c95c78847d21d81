"""AEM files of other programs: what is read is read right, all else is refused by file and line."""

import io
import re
from pathlib import Path

import numpy as np
import pytest

from service.ephemerides.aem import read_aem
from service.ephemerides.files import read_attitudes
from service.errors import BadFile
from service.times import parse_utc
from service.vectors import attitude_matrices
from tests import scale
from tests.features.products.series import (
    GOLDEN,
    START,
    random_quaternions,
    rows,
    slew,
    whole,
    written,
)

EXAMPLES = Path(__file__).parent / "adm-examples"
V1 = """\
CCSDS_AEM_VERS = 1.0
CREATION_DATE = 2002-11-04T17:22:31
ORIGINATOR = NASA/JPL

META_START
OBJECT_NAME = XTE
OBJECT_ID = 1995-074A
CENTER_NAME = EARTH
REF_FRAME_A = EME2000
REF_FRAME_B = SC_BODY_1
ATTITUDE_DIR = A2B
TIME_SYSTEM = UTC
START_TIME = 1996-01-10T12:00:00
STOP_TIME = 1996-01-10T12:00:01
ATTITUDE_TYPE = QUATERNION
QUATERNION_TYPE = LAST
META_STOP

DATA_START
COMMENT a state a line
1996-01-10T12:00:00.000 0.0 0.0 0.25881904510252074 0.9659258262890683
1996-010T12:00:01.000Z 0.0 0.0 0.25881904510252074 0.9659258262890683
DATA_STOP
"""
V2 = V1.replace("VERS = 1.0", "VERS = 2.0").replace("ATTITUDE_DIR = A2B\n", "")
V2 = V2.replace("QUATERNION_TYPE = LAST\n", "")
NOON = parse_utc(START).tai_ns


def read(text, name="x.aem"):
    return read_aem(name, io.BytesIO(text if isinstance(text, bytes) else text.encode()))


def at(known, *moments):
    return known.at(np.array([parse_utc(each).tai_ns for each in moments]))


def apart(one, other):
    sign = np.sign(np.sum(one * other, axis=-1, keepdims=True))
    return np.abs(one - sign * other).max()


@pytest.mark.parametrize("text", [V1, V2])
def test_thirty_degrees_about_z_is_unchanged(text):
    known = read(text)
    assert known.object_name == "XTE"
    assert at(known, START)[0] == pytest.approx(GOLDEN, abs=1e-15)


def test_scalar_first_and_the_other_direction_are_turned_into_ours():
    q1, q2, q3, qc = GOLDEN
    last, first = f"{q1} {q2} {q3} {qc}", f"{qc} {q1} {q2} {q3}"
    first_too = V1.replace(last, first).replace("TYPE = LAST", "TYPE = FIRST")
    assert at(read(first_too), START)[0] == pytest.approx(GOLDEN, abs=1e-15)
    conjugate = V1.replace(last, f"{-q1} {-q2} {-q3} {qc}")
    assert at(read(conjugate.replace("A2B", "B2A")), START)[0] == pytest.approx(GOLDEN, abs=1e-15)
    frames = {"_A = EME2000": "_A = SC_BODY_1", "_B = SC_BODY_1": "_B = EME2000"}
    for text in (conjugate, conjugate.replace("VERS = 1.0", "VERS = 2.0")):
        for one, other in frames.items():
            text = text.replace(one, other)
        if "VERS = 2.0" in text:
            text = text.replace("ATTITUDE_DIR = A2B\n", "").replace("QUATERNION_TYPE = LAST\n", "")
        assert at(read(text), START)[0] == pytest.approx(GOLDEN, abs=1e-15)


def test_between_two_states_of_opposite_sign_lies_the_shorter_turn():
    half = np.radians(10.0) / 2
    turned = f"{-0.0} {-0.0} {-np.sin(half)} {-np.cos(half)}"
    first, last = V2.splitlines()[-3:-1]
    text = V2.replace(first, f"{first[:23]} 0 0 0 1").replace(last, f"{last[:22]} {turned}")
    middle = at(read(text), "1996-01-10T12:00:00.5Z")[0]
    assert apart(middle, np.array([0, 0, np.sin(half / 2), np.cos(half / 2)])) < 1e-12


@pytest.mark.parametrize("form", ["aem", "aem-xml"])
def test_every_record_that_the_service_wrote_is_read_again(form, rng, tmp_path):
    pages = [
        rows(random_quaternions(rng, scale.size(10_000, 200)), "2016-12-31T23:59:50.123456789Z"),
        rows(slew(30), "2018-01-10T12:00:00Z"),
        rows([GOLDEN], "2019-01-10T12:00:00Z"),
    ]
    (tmp_path / "x").write_bytes(written(form, *pages))
    known, wanted = read_attitudes(tmp_path / "x", "FILE"), whole(*pages)
    assert len(known.segments) == 3
    assert len(known) == len(wanted)
    np.testing.assert_allclose(known.at(wanted.time_ns), wanted.quaternion, rtol=0, atol=3e-16)


def test_both_forms_are_read_alike(rng):
    page = rows(random_quaternions(rng, 300), step_s=0.25)
    kvn, xml = (read(written(form, page)) for form in ("aem", "aem-xml"))
    times = whole(page).time_ns
    assert kvn.at(times).tobytes() == xml.at(times).tobytes()


def test_a_message_among_others_or_with_a_prefix_is_read_alike(rng):
    """As catalogs wrap even one message, and as the schema with qualified names has it."""
    page = rows(random_quaternions(rng, 20))
    xml = written("aem-xml", page).decode()
    _, _, message = xml.partition("?>")
    wrapped = f'<?xml version="1.0"?>\n<ndm><MESSAGE_ID>7</MESSAGE_ID>{message}</ndm>'
    prefixed = re.sub(r"<(/?)aem\b", r"<\1ndm:aem", xml)
    assert "<ndm:aem" in prefixed
    times = whole(page).time_ns
    found = {read(each).at(times).tobytes() for each in (xml, wrapped, prefixed)}
    assert len(found) == 1
    with pytest.raises(BadFile, match="XML: must be the element aem"):
        read("<ndm><oem/></ndm>")


def segments_of(text):
    """The messages of each segment of one by itself: those of some examples overlap."""
    head, *segments = text.split("META_START")
    return [f"{head}META_START{segment}" for segment in segments] or [text]


ALSO_OREKIT_S = ["01.txt", "02.txt", "03.xml", "04.txt", "06a.txt", "06b.txt", "09.txt", "11.xml"]
ALSO_OREKIT_S += ["12.txt", "14.txt", "15.txt", "17.txt"]


@pytest.mark.parametrize("name", ALSO_OREKIT_S)
def test_orekit_and_the_service_read_the_same_of_its_examples(name, orekit, tmp_path):
    """Attitudes and rates: quaternions, Euler angles, spin with nutation, as text and XML."""
    text = (EXAMPLES / f"aem-AEMExample{name}").read_text()
    # With the centre named, Orekit asks for an ephemeris of the planets; frames of the Earth
    # are none of ours.
    text = re.sub("(?m)^.*CENTER_NAME.*$", "", text).replace("ITRF-93", "EME2000")
    for number, each in enumerate(segments_of(text)):
        file = tmp_path / f"{number}-{name}"
        file.write_text(each)
        (segment,) = read_attitudes(file, "FILE").segments
        states = orekit.read("aem", file)[0]["states"]
        theirs = np.array([each["quaternion"] for each in states])
        assert apart(segment.quaternion, theirs / np.linalg.norm(theirs, axis=1)[:, None]) < 1e-12
        seconds = [each["tai_s"] for each in states]
        assert segment.time_ns * 1e-9 == pytest.approx(seconds, abs=1e-6)
        rates = np.array([each["rate_rad_per_s"] for each in states])
        ours = np.zeros_like(rates) if segment.rate_rad_s is None else segment.rate_rad_s
        np.testing.assert_allclose(ours, rates, rtol=0, atol=1e-12)


READ = {
    *(f"AEMExample{name}" for name in ("01.txt", "02.txt", "03.xml", "04.txt", "06a.txt")),
    *(f"AEMExample{name}" for name in ("06b.txt", "11.xml", "15.txt")),
    "aemLowerCaseValue.aem",
    *("ACMExample01.txt", "ACMExample06.txt"),
}
REFUSED = {
    "AEM-inconsistent-direction.txt": "line 14: ATTITUDE_DIR: is of version 1",
    "AEM-inconsistent-quaternion-type.txt": "line 20: QUATERNION_TYPE: is of version 1",
    "AEM-keyword-within-ephemeris.txt": "line 29: USER_DEFINED_TEST_KEY: is out of place",
    "AEM-missing-attitude-type.txt": "line 23: ATTITUDE_TYPE: is missing",
    "AEMExample08.txt": "line 9: REF_FRAME_A: must be one of EME2000",
    "AEMExample09.txt": "line 9: REF_FRAME_A: must be one of EME2000",
    "AEMExample12.txt": "line 9: REF_FRAME_A: must be one of EME2000",
    "AEMExample14.txt": "line 44: overlaps the segment at line 18",
    "AEMExample17.txt": "line 44: overlaps the segment at line 18",
}


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("a*-*")), ids=lambda file: file.name)
def test_orekit_s_examples_are_read_and_others_refused_by_line(file):
    kind, _, name = file.name.partition("-")
    if kind in ("aem", "acm") and name in READ:
        assert len(read_attitudes(file, "FILE")) >= 2
        return
    with pytest.raises(BadFile) as refusal:
        read_attitudes(file, "FILE")
    assert f"{file.name}, line " in str(refusal.value)
    if kind == "aem":
        assert REFUSED[name] in str(refusal.value)


LINE = "1996-01-10T12:00:00.000 0.0 0.0 0.25881904510252074 0.9659258262890683\n"
BAD = [
    ("", "line 1: CCSDS_AEM_VERS: must come first"),
    (V2.replace("VERS = 2.0", "VERS = 3.0"), "line 1: CCSDS_AEM_VERS: must be 1.0 or 2.0"),
    (V2[: V2.index("DATA_STOP")], "DATA_STOP: is missing: the file was cut short"),
    (V2[: V2.index("META_STOP")], "META_STOP: is missing: the file was cut short"),
    (V2[: V2.index("META_START")], "line 3: META_START: is missing"),
    (V2[:-70], "state: must have an epoch and 4 numbers"),
    (V2.replace("= UTC", "= UT1"), "line 11: TIME_SYSTEM: must be one of UTC, TAI, GPS, TT"),
    (V2.replace("= UTC", "= MET"), "(got 'MET')"),
    (V2.replace("= QUATERNION", "= EULER_ANGLE"), "line 15: EULER_ROT_SEQ: is missing"),
    (
        V2.replace("= QUATERNION", "= EULER_ANGLE\nEULER_ROT_SEQ = XXZ"),
        "line 15: EULER_ROT_SEQ: must name three axes as ZXZ or 313",
    ),
    (
        V2.replace("= QUATERNION", "= QUATERNION/ANGVEL\nANGVEL_FRAME = WHEEL_1"),
        "line 15: ANGVEL_FRAME: must be one of EME2000, SC_BODY_1",
    ),
    (V1.replace("A2B", "A2C"), "line 11: ATTITUDE_DIR: must be one of A2B, B2A"),
    (V1.replace("= LAST", "= MIDDLE"), "line 16: QUATERNION_TYPE: must be one of FIRST, LAST"),
    (V1.replace("QUATERNION_TYPE = LAST\n", ""), "QUATERNION_TYPE: is missing"),
    (V1.replace("VERS = 1.0", "VERS = 2.0"), "line 11: ATTITUDE_DIR: is of version 1"),
    (
        V2.replace("META_STOP", "QUATERNION_TYPE = LAST\nMETA_STOP"),
        "line 15: QUATERNION_TYPE: is of version 1",
    ),
    (V2.replace("0.9659258262890683", "0.85"), "line 19: quaternion: must have norm 1"),
    (V2.replace("0.9659258262890683", "nan"), "line 19: state: must be a number (got 'nan')"),
    (V2.replace("0.9659258262890683", "1_0"), "line 19: state: must be a number (got '1_0')"),
    (V2.replace(LINE, LINE * 2), "line 20: EPOCH: must be later than that of the state before"),
    (V2.replace("12:00:00.000 ", "12:00:61.000 "), "line 19: EPOCH: there is no such time"),
    (V2.replace("T12:00:00.000 ", "noon "), "line 19: EPOCH: must be a time as 1996-01-10T12"),
    (V2.replace("SC_BODY_1", "STARTRACKER_1"), "line 10: REF_FRAME_B: must be one of"),
    (V2.replace("SC_BODY_1", "J2000"), "REF_FRAME_B: one of REF_FRAME_A and REF_FRAME_B must be"),
    (V2.replace("OBJECT_ID", "OBJECT_AGE"), "line 7: OBJECT_AGE: is no keyword of an AEM's"),
    (V2.replace("META_STOP", "OBJECT_ID = 2\nMETA_STOP"), "OBJECT_ID: is there already, in line 7"),
    (V2 + V2[V2.index("META_START") :], "line 32: overlaps the segment at line 15"),
    (V2.replace(V2[V2.index("COMMENT") : V2.index("DATA_STOP")], ""), "a segment of no state"),
    (
        V2.replace("STOP_TIME = 1996-01-10T12:00:01", "STOP_TIME = 1996-01-09T12:00:01"),
        "line 13: STOP_TIME: must not be before START_TIME",
    ),
    (V2.replace("META_STOP", "USEABLE_START_TIME = 1997-001T00:00:00\nMETA_STOP"), "no useable"),
    (
        V2 + V2[V2.index("META_START") :].replace("074A", "075A"),
        "OBJECT_ID: must be the same in every segment",
    ),
    (
        V2 + V2[V2.index("META_START") :].replace("OBJECT_NAME = ", "OBJECT_NAME = OTHER "),
        "OBJECT_NAME: must be the same in every segment",
    ),
    (V2.replace("COMMENT a", "a"), "line 18: state: must have an epoch and 4 numbers"),
    (V2.replace("CREATION", "x" * 5000), "line 2: line: must have at most 4096 bytes"),
    (b"\xff\xfe" + V2.encode("utf-16-le"), "line 1: line: must be text"),
]


@pytest.mark.parametrize(("text", "words"), BAD)
def test_a_bad_file_is_refused_with_file_line_and_field(text, words):
    with pytest.raises(BadFile) as refusal:
        read(text, "pass-7.aem")
    assert str(refusal.value).startswith("pass-7.aem, line ")
    assert words in str(refusal.value)


XML = written("aem-xml", rows(slew(5))).decode()
BAD_XML = [
    (XML[: len(XML) // 2], "XML: "),
    (XML.replace("<aem ", "<opm ").replace("</aem>", "</opm>"), "must be the element aem"),
    (XML.replace("<Q3>", "<Q2>").replace("</Q3>", "</Q2>"), "Q2: must be there once in a state"),
    (XML.replace("<aem", '<!DOCTYPE a [<!ENTITY b "c">]><aem', 1), "DOCTYPE: is not read"),
    (XML.replace("</Q3>", "</Q3><Q3>0</Q3>", 1), "Q3: must be there once in a state"),
    (XML.replace("<Q1>", '<Q1 units="deg">', 1), "Q1: must be in no unit (got 'deg')"),
    (XML.replace('units="deg/s"', 'units="rad/s"', 1), "ANGVEL_X: must be in deg/s"),
    (XML.replace("<Q1>", "<Q1>x", 1), "state: must be a number (got 'x"),
    (XML.replace("UTC", "SCLK", 1), "TIME_SYSTEM: must be one of UTC"),
    (XML.replace("<metadata>", "<metadata>" + "<a>" * 20 + "</a>" * 20), "lies in more than 12"),
]


@pytest.mark.parametrize(("text", "words"), BAD_XML)
def test_bad_xml_is_refused_with_its_line(text, words):
    with pytest.raises(BadFile, match=r"x\.aem, line \d+: ") as refusal:
        read(text)
    assert words in str(refusal.value)


@pytest.mark.parametrize(
    ("system", "ahead_s"), [("UTC", 0.0), ("TAI", 30.0), ("GPS", 11.0), ("TT", 62.184)]
)
def test_time_systems_are_what_their_definitions_say(system, ahead_s):
    """In January 1996 UTC was 30 s behind TAI."""
    text = V2.replace("= UTC", f"= {system}")
    (segment,) = read(text).segments
    assert (NOON - int(segment.time_ns[0])) * 1e-9 == pytest.approx(ahead_s, abs=1e-9)


def test_nothing_is_found_across_a_gap_and_beyond_what_is_useable():
    first = written("aem", rows(slew(10)), rows(slew(10), "1996-01-10T12:05:00Z")).decode()
    known = read(first)
    inside = at(known, "1996-01-10T12:00:09Z", "1996-01-10T12:05:00Z")
    assert not np.isnan(inside).any()
    outside = ("1996-01-10T11:59:59Z", "1996-01-10T12:00:10Z", "1996-01-10T12:05:09.5Z")
    assert np.isnan(at(known, *outside)).all()
    useable = "USEABLE_START_TIME = 1996-01-10T12:00:00.5\nMETA_STOP"
    cut = read(V2.replace("META_STOP", useable))
    assert np.isnan(at(cut, "1996-01-10T12:00:00.4Z")).all()
    assert not np.isnan(at(cut, "1996-01-10T12:00:00.6Z")).any()


def test_between_records_the_body_turns_at_a_constant_rate():
    known = read(written("aem", rows(slew(500))))
    middles = NOON + np.arange(499) * 10**9 + 5 * 10**8
    wanted = slew(1_000, step_s=0.5)[1:-1:2]
    assert np.abs(attitude_matrices(known.at(middles)) - attitude_matrices(wanted)).max() < 1e-12
