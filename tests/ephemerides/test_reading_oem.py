"""OEM files: states between the records are Orekit's; what is malformed is refused by its line."""

import io

import brahe
import numpy as np
import pytest
from brahe.ccsds import OEM

from service.ephemerides.files import read_ephemeris
from service.ephemerides.oem import read_oem
from service.errors import BadFile, BadInput
from service.times import parse_utc, shifted
from tests.ephemerides.orbits import START, oem_text, orbit


def read(text):
    return read_oem("iss.oem", io.BytesIO(text if isinstance(text, bytes) else text.encode()))


def at(known, seconds):
    return np.array([known.at(shifted(START, second)) for second in seconds])


def within(one, other, relative):
    """Whether positions and velocities differ by a part of their lengths at most."""
    for part in (slice(0, 3), slice(3, 6)):
        error = np.linalg.norm(one[:, part] - other[:, part], axis=1)
        assert (error <= relative * np.linalg.norm(other[:, part], axis=1)).all()


STEPS = np.arange(0.0, 1_801.0, 60.0)
METHODS = [
    ("HERMITE", 7, 4),
    ("HERMITE", 5, 3),
    ("HERMITE", 3, 2),
    ("HERMITE", 6, 4),
    ("LAGRANGE", 7, 8),
    ("LAGRANGE", 9, 10),
    ("LAGRANGE", 4, 5),
    ("LINEAR", 1, 2),
]


@pytest.mark.parametrize(("method", "degree", "points"), METHODS)
def test_between_the_states_it_is_orekit_s_polynomial(
    orekit, tmp_path, rng, method, degree, points
):
    text = oem_text(STEPS, INTERPOLATION=method, INTERPOLATION_DEGREE=degree)
    file = tmp_path / "iss.oem"
    # With the Earth named, Orekit asks for an ephemeris of the planets.
    file.write_text(text.replace("= Earth", "= UNKNOWN").replace("LINEAR", "LAGRANGE"))
    # Through an odd number of states Orekit's polynomial has the state before in its middle, ours
    # the nearest.
    near = [7.0] if points % 2 else [7.0, 53.0]
    seconds = 60.0 * rng.integers(6, 24, 20) + rng.choice(near, 20) + rng.integers(-5, 5, 20)
    found = orekit.ask(
        kind="oem",
        file=str(file),
        method="HERMITE" if method == "HERMITE" else "LAGRANGE",
        points=points,
        times=[shifted(START, second).tai_ns * 1e-9 for second in seconds],
    )
    known = read(text)
    states = np.array([each["state"] for each in found["states"]])
    within(at(known, STEPS), states, 1e-15)
    within(at(known, seconds), np.array(found["at"]), 1e-9)


@pytest.mark.parametrize("extra", [{}, {"INTERPOLATION": "HERMITE", "INTERPOLATION_DEGREE": 7}])
def test_between_the_states_it_is_the_orbit(extra, rng):
    seconds = np.sort(rng.uniform(0.0, 1_800.0, 200)).round(6)
    within(at(read(oem_text(STEPS, **extra)), seconds), orbit(seconds), 1e-9)


@pytest.mark.parametrize("method", ["HERMITE", "LAGRANGE"])
@pytest.mark.parametrize("degree", [1, 2, 19])
def test_between_the_states_it_is_near_the_orbit_at_any_degree(method, degree, rng):
    seconds = np.sort(rng.uniform(0.0, 1_800.0, 50)).round(6)
    known = read(oem_text(STEPS, INTERPOLATION=method, INTERPOLATION_DEGREE=degree))
    # Along a chord: an eighth of the square of the angle of a step.
    within(at(known, seconds), orbit(seconds), 7e-4)


def test_states_that_name_no_interpolation_are_near_enough_for_a_kilometre(rng):
    period_s = 5_580.0
    steps = np.arange(0.0, 2 * period_s, period_s / 12.1).round(3)
    seconds = rng.uniform(0.0, steps[-1], 500).round(6)
    error = at(read(oem_text(steps)), seconds) - orbit(seconds)
    assert np.linalg.norm(error[:, :3], axis=1).max() < 1.0
    assert np.linalg.norm(error[:, 3:], axis=1).max() < 0.01
    with pytest.raises(BadFile, match=r"INTERPOLATION: is missing, and 4\d\d s lie between two"):
        read(oem_text(steps * 1.05))


def written_by_brahe(kind, seconds):
    moments = [brahe.Epoch(shifted(START, second).text) for second in seconds]
    oem = OEM(originator="TEST")
    oem.add_segment(
        object_name="ISS",
        object_id="1998-067A",
        center_name="EARTH",
        ref_frame="GCRF",
        time_system="UTC",
        start_time=moments[0],
        stop_time=moments[-1],
    )
    for moment, state in zip(moments, orbit(seconds), strict=True):
        metres = (state * 1e3).tolist()
        oem.segments[0].add_state(epoch=moment, position=metres[:3], velocity=metres[3:])
    return oem.to_string(kind)


@pytest.mark.parametrize("kind", ["KVN", "XML"])
def test_files_that_brahe_writes_are_read(kind):
    seconds = np.arange(0.0, 51.0, 10.0)
    known = read(written_by_brahe(kind, seconds))
    assert known.object_name == "ISS"
    within(at(known, seconds), orbit(seconds), 1e-8)


@pytest.mark.parametrize(
    ("system", "ahead_s"), [("UTC", 0.0), ("TAI", 37.0), ("GPS", 18.0), ("TT", 69.184)]
)
def test_time_systems_are_what_their_definitions_say(system, ahead_s):
    """In January 2022 UTC was 37 s behind TAI."""
    known = read(oem_text(STEPS, TIME_SYSTEM=system))
    within(at(known, STEPS[2:] - ahead_s), orbit(STEPS[2:]), 1e-14)


def test_a_file_across_a_leap_second_has_a_second_more():
    start = parse_utc("2016-12-31T23:59:30Z")
    text = oem_text(STEPS, start=start)
    assert "2017-01-01T00:00:29" in text
    found = read(text).at(parse_utc("2016-12-31T23:59:60Z"))
    within(found[None], orbit([30.0]), 1e-9)


def test_nothing_is_found_outside_the_useable_times_and_between_segments():
    useable = {
        "USEABLE_START_TIME": "2022-01-17T12:05:00",
        "USEABLE_STOP_TIME": "2022-017T12:20:00",
    }
    later = oem_text(STEPS, start=shifted(START, 3_600.0))
    known = read(oem_text(STEPS, **useable) + later[later.index("META_START") :])
    for second in (0.0, 299.999, 1_200.001, 1_800.0, 2_700.0, 3_599.999, 5_400.001):
        assert known.at(shifted(START, second)) is None, second
    for second in (300.0, 300.001, 1_200.0, 3_600.0, 5_400.0):
        assert known.at(shifted(START, second)) is not None, second


def test_at_a_boundary_the_later_segment_is_taken():
    """A manoeuvre: the velocity differs from one segment to the next."""
    later = oem_text(STEPS, start=shifted(START, 1_800.0))
    known = read(oem_text(STEPS) + later[later.index("META_START") :])
    within(known.at(shifted(START, 1_800.0))[None], orbit([0.0]), 1e-15)


def test_accelerations_and_covariances_are_passed_over():
    covariance = ["COVARIANCE_START", f"EPOCH = {START.text}", "COV_REF_FRAME = RTN"]
    covariance += [" ".join(["1e-4"] * count) for count in range(1, 7)] + ["COVARIANCE_STOP"]
    text = oem_text(STEPS, version="3.0", extra=covariance, MESSAGE_ID="7").replace(
        "MESSAGE_ID = 7\n", ""
    )
    lines = text.splitlines()
    place = lines.index("COMMENT states") + 1
    lines[place] += " 0.001 0.001 0.001"
    within(at(read("\n".join(lines)), STEPS), orbit(STEPS), 1e-15)


GOOD = oem_text(STEPS)
FIRST = next(line for line in GOOD.splitlines() if line.startswith("2022-01-17T12:00:00"))
LAST = GOOD.splitlines()[-1]
HERMITE = {"INTERPOLATION": "HERMITE", "INTERPOLATION_DEGREE": 7}
BAD = [
    ("", "line 1: CCSDS_OEM_VERS: must come first"),
    (GOOD.replace("VERS = 2.0", "VERS = 4.0"), "must be 1.0, 2.0 or 3.0 (got '4.0')"),
    (GOOD.replace("OEM_VERS", "AEM_VERS"), "line 1: CCSDS_AEM_VERS: is of an AEM, not of an OEM"),
    (GOOD[: GOOD.index("META_STOP")], "META_STOP: is missing: the file was cut short"),
    (GOOD[: GOOD.index("META_START")], "line 3: META_START: is missing"),
    (GOOD.removesuffix(LAST + "\n"), "states: the last state is earlier than STOP_TIME"),
    (GOOD[:-30], "state: must have an epoch, a position and a velocity"),
    (GOOD.replace(FIRST + "\n", ""), "line 12: states: the first state is later than START_TIME"),
    (GOOD.replace("= UTC", "= UT1"), "line 9: TIME_SYSTEM: must be one of UTC, TAI, GPS, TT"),
    (GOOD.replace("= EME2000", "= ITRF2000"), "line 8: REF_FRAME: must be one of EME2000"),
    (GOOD.replace("= Earth", "= SUN"), "line 7: CENTER_NAME: must be one of EARTH (got 'SUN')"),
    (GOOD.replace("CENTER_NAME = Earth\n", ""), "CENTER_NAME: is missing in the metadata"),
    (GOOD.replace("OBJECT_ID", "OBJECT_AGE"), "line 6: OBJECT_AGE: is no keyword of an OEM's"),
    (
        GOOD.replace(FIRST, f"{FIRST}\n{FIRST}"),
        "EPOCH: must be later than that of the state before",
    ),
    (GOOD.replace(FIRST, FIRST.replace("6800.0", "nan")), "state: must be a number (got 'nan')"),
    (GOOD.replace(FIRST, FIRST.replace("6800.0", "6_800")), "must be a number (got '6_800')"),
    (GOOD.replace(FIRST, FIRST.replace("6800.0", "2e9")), "position: must be within 1e+09 km"),
    (GOOD.replace(FIRST, FIRST.replace(" 0.0", " 300.0", 3)), "velocity: must be within 100 km/s"),
    (GOOD.replace(FIRST, FIRST + " 1.0"), "state: must have an epoch, a position and a velocity"),
    (GOOD.replace(FIRST, FIRST.replace("T12", " 12")), "state: must have an epoch"),
    (GOOD.replace(FIRST, FIRST.replace("-01-17", "-02-30")), "EPOCH: there is no such day"),
    (GOOD + GOOD[GOOD.index("META_START") :], "overlaps the segment at line 12"),
    (GOOD + "COVARIANCE_START\n", "COVARIANCE_STOP: is missing: the file was cut short"),
    (GOOD + "COVARIANCE_START\nCOVARIANCE_STOP\n" + LAST, "is out of place among the states"),
    (GOOD + "USER_KEY = 1\n", "USER_KEY: is out of place among the states"),
    (GOOD.split("COMMENT states")[0], "line 12: META_STOP: begins a segment of no state"),
    (oem_text(STEPS, INTERPOLATION="CHEBYSHEV"), "INTERPOLATION: must be one of HERMITE, LAGRANGE"),
    (oem_text(STEPS, INTERPOLATION="HERMITE"), "INTERPOLATION_DEGREE: is missing"),
    (
        oem_text(STEPS, **HERMITE | {"INTERPOLATION_DEGREE": "seven"}),
        "INTERPOLATION_DEGREE: must be a whole number from 1 to 19 (got 'seven')",
    ),
    (oem_text(STEPS, **HERMITE | {"INTERPOLATION_DEGREE": 20}), "from 1 to 19 (got '20')"),
    (oem_text(STEPS[:3], **HERMITE), "degree 7 needs 4 states; the segment has 3"),
    (oem_text(STEPS, USEABLE_START_TIME="2023-001T00:00:00"), "the segment has no useable time"),
    (
        oem_text(STEPS, STOP_TIME="2022-01-16T00:00:00"),
        "STOP_TIME: must not be before START_TIME",
    ),
    (b"CCSDS_OEM_VERS = 2.0\n\xff\xfe", "line 2: line: must be text"),
]


@pytest.mark.parametrize(("text", "words"), BAD)
def test_a_bad_file_is_refused_with_file_line_and_field(text, words):
    with pytest.raises(BadFile) as refusal:
        read(text)
    assert str(refusal.value).startswith("iss.oem, line ")
    assert words in str(refusal.value)


@pytest.mark.parametrize("factor", [0.0, -1.0, 0.9])
def test_velocities_that_are_not_those_of_the_positions_are_refused(factor):
    """Zeros that stand for none, and velocities relative to the turning Earth, were taken."""
    lines = []
    for line in GOOD.splitlines():
        words = line.split()
        if len(words) == 7 and line[:4].isdigit():
            words[4:] = (str(factor * float(each)) for each in words[4:])
        lines.append(" ".join(words))
    with pytest.raises(BadFile, match=r"velocity: of states 1 and 2 .* not that of their position"):
        read("\n".join(lines))


def test_bad_xml_is_refused_with_its_line():
    good = written_by_brahe("XML", np.arange(0.0, 51.0, 10.0))
    bad = [
        (good[: len(good) // 2], "XML: "),
        (good.replace("<oem", '<!DOCTYPE a [<!ENTITY b "c">]><oem', 1), "DOCTYPE: is not read"),
        (good.replace("X_DOT>", "X_DDOT>"), "X_DOT: must be there once in a state"),
        (good.replace("GCRF", "MARSIAU"), "REF_FRAME: must be one of"),
    ]
    for text, words in bad:
        with pytest.raises(BadFile, match=r"iss\.oem, line \d+: ") as refusal:
            read(text)
        assert words in str(refusal.value)


def test_a_file_that_cannot_be_opened_is_named(tmp_path):
    with pytest.raises(BadInput, match="--ephemeris: cannot be read: No such file") as refusal:
        read_ephemeris(tmp_path / "none.oem", "--ephemeris")
    assert "none.oem" in str(refusal.value)


def test_tabs_orders_of_keywords_and_comments_of_several_lines_change_nothing():
    """As anise wrote its files, and as figure 5-1 of CCSDS 502.0-B has its comments."""
    text = oem_text(STEPS)
    head, _, rest = text.partition("META_START\n")
    metadata, _, states = rest.partition("META_STOP\n")
    lines = metadata.replace(" = ", "\t=\t").splitlines()[::-1]
    metadata = "".join(f"\t{line}\n" for line in lines)
    comments = "COMMENT made by hand, 1996NOV 04. It is\nCOMMENT\tto be used = for tests only.\n"
    states = states.replace(" ", "\t").replace("COMMENT\tstates\n", comments)
    other = f"\ufeff{head}META_START\n{metadata}META_STOP\n{comments}{states}"
    np.testing.assert_array_equal(at(read(other), [70.0]), at(read(text), [70.0]))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("REF_FRAME", "TEME"),
        ("REF_FRAME", "ITRF2000"),
        ("CENTER_NAME", "MARS BARYCENTER"),
        ("TIME_SYSTEM", "UT1"),
    ],
)
def test_what_a_state_cannot_be_taken_from_is_refused_by_its_keyword(name, value):
    with pytest.raises(BadFile, match=name):
        read(oem_text(STEPS, **{name: value}))


@pytest.mark.parametrize("rows", [["1.0"], ["EPOCH = 2022-01-17T12:00:00", *["1 2 3 4 5 6 7"] * 9]])
def test_a_covariance_of_another_shape_changes_no_state(rows):
    text = oem_text(STEPS, extra=["COVARIANCE_START", *rows, "COVARIANCE_STOP"])
    try:
        known = read(text)
    except BadFile:
        return
    np.testing.assert_array_equal(at(known, [70.0]), at(read(oem_text(STEPS)), [70.0]))
