"""Reads ACM messages as Orekit does; its own are read again, others refused by line."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.ephemerides.acm import TRUE_BASES
from service.ephemerides.files import read_attitudes
from service.errors import BadFile
from tests.features.products.series import GOLDEN, random_quaternions, rows, slew, whole, written

EXAMPLES = Path(__file__).parent / "adm-examples"
HEAD = """CCSDS_ACM_VERS = 2.0
CREATION_DATE = 2026-01-01T00:00:00
ORIGINATOR = TEST
META_START
OBJECT_NAME = XTE
TIME_SYSTEM = {system}
EPOCH_TZERO = 2025-12-31T23:59:00
{more}META_STOP
"""
BLOCK = """ATT_START
REF_FRAME_A = {a}
REF_FRAME_B = {b}
NUMBER_STATES = {size}
ATT_TYPE = {type}
{rate}{states}ATT_STOP
"""
KINDS = {
    "QUATERNION": (4, "", ""),
    "QUATERNION ANGVEL": (7, "RATE_TYPE = ANGVEL\n", ""),
    "QUATERNION Q_DOT": (8, "RATE_TYPE = Q_DOT\n", ""),
    "QUATERNION GYRO_BIAS": (7, "RATE_TYPE = GYRO_BIAS\n", ""),
    "EULER_ANGLES": (3, "EULER_ROT_SEQ = ZXY\n", ""),
    "EULER_ANGLES EULER_RATE": (6, "EULER_ROT_SEQ = ZXZ\nRATE_TYPE = EULER_RATE\n", ""),
    "DCM": (9, "", ""),
}


def block(kind, rng, frames=("EME2000", "SC_BODY_1"), states=20):
    """A block of random states of a kind, in seconds after the message's zero."""
    size, rate, _ = KINDS[kind]
    type = kind.split()[0]
    q = random_quaternions(rng, states)
    if type == "QUATERNION":
        numbers = q
    elif type == "DCM":
        numbers = Rotation.from_quat(q).as_matrix().transpose(0, 2, 1).reshape(-1, 9)
    else:
        numbers = rng.uniform(5.0, 85.0, (states, 3))
    numbers = np.hstack([numbers, rng.normal(0.0, 0.1, (states, size - numbers.shape[1]))])
    lines = (f"{k * 0.25} {' '.join(map(repr, each.tolist()))}\n" for k, each in enumerate(numbers))
    a, b = frames
    return BLOCK.format(a=a, b=b, size=size, type=type, rate=rate, states="".join(lines))


def read(text, tmp_path):
    (tmp_path / "x.acm").write_text(text)
    return read_attitudes(tmp_path / "x.acm", "FILE")


def apart(one, other):
    sign = np.sign(np.sum(one * other, axis=1))[:, None]
    return np.abs(one - sign * other).max()


@pytest.mark.parametrize("kind", [kind for kind in KINDS if "BIAS" not in kind])
@pytest.mark.parametrize("frames", [("EME2000", "SC_BODY_1"), ("SC_BODY_1", "EME2000")])
def test_orekit_and_the_service_read_the_same(kind, frames, orekit, rng, tmp_path):
    text = HEAD.format(system="UTC", more="") + block(kind, rng, frames)
    (segment,) = read(text, tmp_path).segments
    (theirs,) = orekit.read("acm", tmp_path / "x.acm")["stretches"]
    q = np.array([each["quaternion"] for each in theirs])
    if frames[0] != "EME2000":
        q[:, :3] *= -1.0
    # Orekit takes a matrix to the nearest rotation, step by step.
    most = 1e-9 if kind == "DCM" else 1e-12
    assert apart(segment.quaternion, q / np.linalg.norm(q, axis=1)[:, None]) < most
    seconds = [each["tai_s"] for each in theirs]
    assert segment.time_ns * 1e-9 == pytest.approx(seconds, abs=1e-6)
    if "ANGVEL" in kind or "Q_DOT" in kind or "EULER_RATE" in kind:
        rates = np.array([each["rate_rad_per_s"] for each in theirs])
        if frames[0] != "EME2000":
            # Orekit gives the rate of the last frame in its own axes, here the inertial frame's.
            unit = Rotation.from_quat(q / np.linalg.norm(q, axis=1)[:, None])
            rates = -unit.inv().apply(rates)
        np.testing.assert_allclose(segment.rate_rad_s, rates, rtol=0, atol=1e-12)
    else:
        assert segment.rate_rad_s is None


def test_what_the_service_wrote_is_read_again(rng, tmp_path):
    pages = [rows(random_quaternions(rng, 500)), rows(slew(30), "2018-01-10T12:00:00Z")]
    pages.append(rows([GOLDEN], "2019-01-10T12:00:00Z"))
    (tmp_path / "x").write_bytes(written("acm", *pages))
    known, wanted = read_attitudes(tmp_path / "x", "FILE"), whole(*pages)
    assert len(known) == len(wanted)
    assert apart(known.at(wanted.time_ns), wanted.quaternion) < 1e-12


def test_text_and_xml_are_read_alike(rng, tmp_path):
    body = block("QUATERNION ANGVEL", rng)
    text = HEAD.format(system="GPS", more="CENTER_NAME = EARTH\n") + body
    keys = dict(line.split(" = ") for line in text.splitlines() if " = " in line)

    def tags(*names):
        return "".join(f"<{name}>{keys[name]}</{name}>" for name in names)

    states = [line for line in body.splitlines() if line[0].isdigit()]
    lines = "".join(f"<attLine>{each}</attLine>\n" for each in states)
    about = tags("REF_FRAME_A", "REF_FRAME_B", "NUMBER_STATES", "ATT_TYPE", "RATE_TYPE")
    xml = (
        '<?xml version="1.0"?>\n<acm id="CCSDS_ACM_VERS" version="2.0"><header>'
        f"{tags('CREATION_DATE', 'ORIGINATOR')}</header><body><segment><metadata>"
        f"{tags('OBJECT_NAME', 'CENTER_NAME', 'TIME_SYSTEM', 'EPOCH_TZERO')}</metadata><data>"
        "<phys><WET_MASS>1916</WET_MASS></phys>"
        f"<att>{about}{lines}</att></data></segment></body></acm>"
    )
    (one,), (other,) = (read(each, tmp_path).segments for each in (text, xml))
    assert np.array_equal(one.time_ns, other.time_ns)
    assert one.quaternion.tobytes() == other.quaternion.tobytes()
    assert one.rate_rad_s.tobytes() == other.rate_rad_s.tobytes()


@pytest.mark.parametrize("order", [1, -1])
def test_a_time_of_a_predicted_block_is_that_of_one_that_is_not(rng, tmp_path, order):
    """Predicted for 5 s, determined up to 2 s of them."""
    predicted = block("QUATERNION", rng, states=21)
    determined = block("QUATERNION", rng, states=9)
    named = [
        each.replace("ATT_START\n", f"ATT_START\nATT_BASIS = {basis}\n")
        for each, basis in ((predicted, "PREDICTED"), (determined, "DETERMINED_GND"))
    ]
    known = read(HEAD.format(system="UTC", more="") + "".join(named[::order]), tmp_path)
    parts = [read(HEAD.format(system="UTC", more="") + each, tmp_path) for each in named]
    times = parts[0].segments[0].time_ns
    found, last = known.at(times), 8
    assert np.array_equal(found[: last + 1], parts[1].at(times[: last + 1]))
    assert np.array_equal(found[last + 1 :], parts[0].at(times[last + 1 :]))
    assert [each.basis for each in known.of_basis(TRUE_BASES).segments] == ["DETERMINED_GND"]
    twice = HEAD.format(system="UTC", more="") + named[1] * 2 + named[0]
    with pytest.raises(BadFile, match="overlaps the segment"):
        read(twice, tmp_path)


def test_the_first_example_of_the_standard_begins_at_its_zero():
    known = read_attitudes(EXAMPLES / "acm-ACMExample01.txt", "FILE")
    (segment,) = known.segments
    assert (known.object_name, len(known)) == ("EUROBIRD-4A", 3)
    assert np.diff(segment.time_ns).tolist() == [250_000_000] * 2


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("VERS = 2.0", "VERS = 1.0", "line 1: CCSDS_ACM_VERS: must be 2.0"),
        ("CCSDS_ACM_VERS", "CCSDS_APM_VERS", "line 1: CCSDS_APM_VERS: is of an APM, not of an AEM"),
        ("EPOCH_TZERO = 2025-12-31T23:59:00\n", "", "EPOCH_TZERO: is missing in the metadata"),
        ("NUMBER_STATES = 4", "NUMBER_STATES = 7", "NUMBER_STATES: must be 4, the numbers"),
        ("ATT_TYPE = QUATERNION", "ATT_TYPE = MRP", "ATT_TYPE: must be one of QUATERNION"),
        ("ATT_TYPE = QUATERNION", "ATT_TYPE = QUATERNION\nRATE_TYPE = MRP", "RATE_TYPE: must be"),
        ("REF_FRAME_A = EME2000", "REF_FRAME_A = ITRF-93", "REF_FRAME_A: must be one of EME2000"),
        ("0.25 ", "0.0 ", "EPOCH: must be later than that of the state before"),
        ("0.25 ", "0.25 0.1 ", "state: must have a time and 4 numbers"),
        ("0.25 ", "0.25x ", "state: must be a number"),
        ("0.25 ", "1e10 ", "state: must have a time of the years from 1972 to 2099"),
        ("0.25 ", "-1e300 ", "state: must have a time of the years from 1972 to 2099"),
        ("NUMBER_STATES = 4", "ATT_TYPE = DCM", "ATT_TYPE: is there already, in line 12"),
        ("ATT_STOP\n", "", "ATT_STOP: is missing: the file was cut short"),
        ("0.0 0.", "0.0 9.", "quaternion: must have norm 1"),
    ],
)
def test_a_bad_file_is_refused_with_file_line_and_field(old, new, words, tmp_path, rng):
    text = HEAD.format(system="TAI", more="") + block("QUATERNION", rng).replace(
        "0.0 -0.", "0.0 0."
    )
    assert old in text
    with pytest.raises(BadFile, match=rf"x.acm, (line \d+: )?{words}"):
        read(text.replace(old, new, 1), tmp_path)


def test_a_block_beside_those_of_attitudes_may_hold_anything(rng, tmp_path):
    body = block("QUATERNION", rng)
    more = (
        "COV_START\nCOV_TYPE = ANGLE\n0.0 1e-9 1e-9 1e-9\nCOV_STOP\nUSER_START\nX = y\nUSER_STOP\n"
    )
    text = HEAD.format(system="UTC", more="")
    one, other = (read(text + each, tmp_path) for each in (body, more + body))
    assert one.segments[0].quaternion.tobytes() == other.segments[0].quaternion.tobytes()


def of_matrix(matrix, tmp_path):
    numbers = " ".join(map(repr, np.ravel(matrix).tolist()))
    told = {"a": "EME2000", "b": "SC_BODY_1", "size": 9, "type": "DCM", "rate": ""}
    body = BLOCK.format(**told, states=f"0.0 {numbers}\n")
    return read(HEAD.format(system="UTC", more="") + body, tmp_path)


@pytest.mark.parametrize(
    "matrix",
    [
        [[0, 1, 0.5], [0, 0, 1], [0, 0, 1]],
        np.zeros((3, 3)),
        np.diag([1, 1, -1]),
        np.diag([1.01, 1, 1]),
        np.full((3, 3), 1e308),
    ],
)
def test_a_matrix_that_is_no_rotation_is_refused_by_line(matrix, tmp_path):
    with pytest.raises(BadFile, match=r"x.acm, line 14: matrix: must be a rotation"):
        of_matrix(np.asarray(matrix, float), tmp_path)


def test_a_matrix_of_few_digits_is_read(rng, tmp_path):
    from scipy.spatial.transform import Rotation

    for q in random_quaternions(rng, 20):
        matrix = np.round(Rotation.from_quat(q).as_matrix().T, 4)
        (segment,) = of_matrix(matrix, tmp_path).segments
        assert apart(segment.quaternion, q[None]) < 1e-4
