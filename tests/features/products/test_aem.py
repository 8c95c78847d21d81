"""AEM files, read by Orekit and brahe."""

import re
import xml.etree.ElementTree as ET

import brahe.ccsds
import numpy as np
import pytest

from service.errors import NotFound
from service.features.products.ccsds import kvn
from service.times import parse_utc
from tests import scale
from tests.features.products.series import GOLDEN, START, random_quaternions, rows, slew, written

FORMS = ("aem", "aem-xml")


@pytest.fixture(params=FORMS)
def save(request, tmp_path):
    """Write pages as an AEM in one of its forms; the file."""

    def save(*pages):
        file = tmp_path / f"attitudes.{request.param}"
        file.write_bytes(written(request.param, *pages))
        return file

    return save


def test_thirty_degrees_about_z_has_no_conjugate(save, orekit):
    file = save(rows([GOLDEN]))
    ((state,),) = [each["states"] for each in orekit.read("aem", file)]
    assert state["quaternion"] == pytest.approx(GOLDEN, abs=1e-15)
    # As A(q) of the service carries the inertial X axis.
    assert state["x_axis_in_body"] == pytest.approx([np.sqrt(0.75), -0.5, 0.0], abs=1e-15)
    assert brahe_quaternions(file)[0] == pytest.approx(GOLDEN, abs=1e-15)


def brahe_states(file):
    read = brahe.ccsds.AEM.from_file(str(file))
    return [state for segment in read.segments for state in segment.states]


def brahe_quaternions(file):
    """Scalar last."""
    return np.array([each.quaternion.to_vector(False) for each in brahe_states(file)])


def apart(one, other):
    """The greatest difference of quaternions, whatever their signs."""
    sign = np.sign(np.sum(one * other, axis=1))[:, None]
    return np.abs(one - sign * other).max()


@pytest.mark.torture
def test_random_attitudes_are_read_by_orekit_and_brahe(save, orekit, rng):
    n = scale.size(100_000, 200)
    q = random_quaternions(rng, n)
    half = n // 2
    file = save(rows(q[:half]), rows(q[half:], "1997-01-11T00:00:00Z"))
    found = orekit.read("aem", file)
    assert [len(each["states"]) for each in found] == [half, n - half]
    by_orekit = np.array([state["quaternion"] for each in found for state in each["states"]])
    assert apart(by_orekit, q) < 1e-12
    assert apart(brahe_quaternions(file), q) < 1e-12


def test_a_slew_between_the_records_is_that_of_the_body(save, orekit):
    """Orekit turns each state by its rate over half a second."""
    rate = np.array([0.4, -0.5, 0.76])
    file = save(rows(slew(500, rate_deg_per_s=rate)))
    (found,) = orekit.read("aem", file, shift_s=0.5)
    middles = slew(1_000, step_s=0.5, rate_deg_per_s=rate)[1::2]
    by_orekit = np.array([state["quaternion"] for state in found["states"]])
    assert apart(by_orekit, middles) < 1e-12
    rates = np.array([state["rate_rad_per_s"] for state in found["states"]])
    np.testing.assert_allclose(np.degrees(rates), np.tile(rate, (500, 1)), atol=1e-12)
    (segment,) = brahe.ccsds.AEM.from_file(str(file)).segments
    by_brahe = np.degrees(np.array(segment.states[7].angular_velocity))
    assert by_brahe == pytest.approx(rate, abs=1e-12)


def test_a_segment_is_an_unbroken_stretch(save, orekit):
    pages = [
        rows(slew(10)),
        rows(slew(3), "1996-01-10T12:30:00Z"),
        rows([GOLDEN], "1996-01-10T13:00:00Z"),
    ]
    found = orekit.read("aem", save(*pages))
    spans = [(each["start"], each["stop"], each["type"]) for each in found]
    assert spans == [
        ("1996-01-10T12:00:00.000Z", "1996-01-10T12:00:09.000Z", "QUATERNION/ANGVEL"),
        ("1996-01-10T12:30:00.000Z", "1996-01-10T12:30:02.000Z", "QUATERNION/ANGVEL"),
        ("1996-01-10T13:00:00.000Z", "1996-01-10T13:00:00.000Z", "QUATERNION"),
    ]


def test_a_leap_second_is_a_second_like_any_other(save, orekit):
    q = slew(10)
    file = save(rows(q, "2016-12-31T23:59:55.250Z"))
    assert b"2016-12-31T23:59:60.250" in file.read_bytes()
    (found,) = orekit.read("aem", file)
    begin = parse_utc("2016-12-31T23:59:55.250Z").tai_ns * 1e-9
    seconds = [state["tai_s"] for state in found["states"]]
    assert seconds == pytest.approx([begin + k for k in range(10)], abs=1e-6)
    by_orekit = np.array([state["quaternion"] for state in found["states"]])
    assert apart(by_orekit, q) < 1e-12


def test_both_forms_say_the_same_word_for_word(rng):
    pages = [
        rows(random_quaternions(rng, 200), step_s=0.1),
        rows([GOLDEN], "1996-01-11T00:00:00Z"),
    ]
    assert kvn_of_xml(written("aem-xml", *pages)) == written("aem", *pages).decode()


def kvn_of_xml(text):
    """The same message as KVN, by the rules of the standard alone."""
    root = ET.fromstring(text)
    lines = [kvn([("CCSDS_AEM_VERS", root.get("version"))]), kvn(pairs(root.find("header")))]
    for segment in root.iter("segment"):
        metadata = kvn(pairs(segment.find("metadata")))
        lines.append(f"\nMETA_START\n{metadata}META_STOP\n\nDATA_START\n")
        lines.extend(
            " ".join(each.text for each in state.iter() if len(each) == 0) + "\n"
            for state in segment.iter("attitudeState")
        )
        lines.append("DATA_STOP\n")
    return "".join(lines)


def pairs(element):
    return [(each.tag, each.text) for each in element]


def test_every_number_is_read_as_the_float_that_was_recorded(rng):
    q = random_quaternions(rng, 1_000)
    text = written("aem", rows(q)).decode()
    numbers = [line.split()[1:5] for line in text.splitlines() if re.match(r"\d{4}-", line)]
    assert np.abs(np.array(numbers, dtype=float)).tobytes() == np.abs(q).tobytes()


def test_names_that_are_no_plain_text_break_no_line(save, orekit):
    import dataclasses

    from tests.features.products.series import ABOUT

    about = dataclasses.replace(ABOUT, spacecraft="é<&>\u2028", object_id="1995-074A")
    (found,) = orekit.read("aem", save(rows([GOLDEN])))
    assert found["name"] == "XTE"
    for form in FORMS:
        assert b"?" in written(form, rows([GOLDEN]), about=about)
    ET.fromstring(written("aem-xml", rows([GOLDEN]), about=about))


@pytest.mark.parametrize("form", FORMS)
def test_without_an_attitude_there_is_no_message(form):
    with pytest.raises(NotFound, match="good attitudes of XTE in run live: none"):
        written(form, rows([GOLDEN], START, status=None))
