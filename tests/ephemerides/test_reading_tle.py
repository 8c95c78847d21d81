"""Two-line element sets: states are those that SGP4's authors published, and Orekit's."""

import io
from importlib import resources

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import GCRS, TEME, CartesianRepresentation
from astropy.time import Time
from astropy.utils import iers

from service.ephemerides import tle
from service.ephemerides.files import read_ephemeris
from service.ephemerides.tle import eme2000_from_teme, read_tle
from service.errors import BadFile, NotAvailable
from service.times import parse_utc, shifted
from tests.ephemerides.orbits import ISS, ISS_EPOCH, with_checksum

VERIFICATION = resources.files("sgp4")


MOLNIYA = [
    "1 08195U 75081A   06176.33215444  .00000099  00000-0  11873-3 0   813",
    "2 08195  64.1586 279.0717 6877146 264.7651  20.2257  2.00491383225656",
]


def read(lines):
    text = lines if isinstance(lines, bytes) else "\n".join(lines).encode()
    return read_tle("iss.tle", io.BytesIO(text), "--ephemeris")


@pytest.mark.parametrize("number", ["T0000", "A5544", "    5"])
def test_a_number_with_a_letter_or_with_spaces_changes_no_state(number):
    """Numbers above 99999 begin with a letter, not I or O ("Alpha-5")."""
    moment = ISS_EPOCH
    renamed = [with_checksum(line[:2] + number + line[7:]) for line in ISS]
    assert np.array_equal(read(renamed).at(moment), read(ISS).at(moment))
    with pytest.raises(BadFile, match="satellite number"):
        read([with_checksum(line[:2] + "I0000" + line[7:]) for line in ISS])


def published():
    """The lines of each verification set, and its states: minutes, km and km/s in TEME."""
    lines = VERIFICATION.joinpath("SGP4-VER.TLE").read_text("ascii").splitlines()
    sets = [line for line in lines if line[:2] in ("1 ", "2 ")]
    pairs = {
        first[2:7].strip(): (first, second)
        for first, second in zip(sets[::2], sets[1::2], strict=True)
    }
    states, of = {}, ""
    for line in VERIFICATION.joinpath("tcppver.out").read_text("ascii").splitlines():
        words = line.split()
        if words[1:] == ["xx"]:
            of = words[0]
        elif of:
            states.setdefault(of, []).append([float(word) for word in words[:7]])
    return [
        (number, *pairs[number], np.array(states[number])) for number in pairs if number in states
    ]


def epoch_of(first):
    year = int(first[18:20]) + (1900 if int(first[18:20]) > 56 else 2000)
    midnight = parse_utc(f"{year}-{first[20:23].replace(' ', '0')}T00:00:00Z")
    return shifted(midnight, float(first[23:32]) * 86_400.0)


def readable(first, second):
    """The lines with checksums, where their columns are those of the format."""
    lines = [with_checksum(first), with_checksum(second)]
    try:
        return lines, read(lines)
    except BadFile:
        return lines, None


def test_states_are_those_that_the_authors_of_sgp4_published():
    compared = 0
    for number, first, second, states in published():
        _, known = readable(first, second)
        if known is None:
            continue
        epoch = epoch_of(first)
        for minutes, *state in states:
            # Published are 8 decimals of km; the days of an epoch have 8 decimals, 0.9 ms.
            moment = shifted(epoch, minutes * 60.0)
            found = known.at(moment)
            if abs(minutes) > tle.MAX_AGE_D * 1_440.0 or found is None:
                continue
            rotation = eme2000_from_teme(moment)
            state = np.array(state)
            wanted = np.concatenate([rotation @ state[:3], rotation @ state[3:]])
            assert np.abs(found[:3] - wanted[:3]).max() < 2e-5, number
            assert np.abs(found[3:] - wanted[3:]).max() < 2e-8, number
            compared += 1
    assert compared > 400


@pytest.mark.parametrize(
    ("lines", "epoch"), [(ISS, ISS_EPOCH), (MOLNIYA, parse_utc("2006-06-25T08:00:00Z"))]
)
def test_states_are_those_of_orekit_in_j2000(orekit, lines, epoch):
    moments = [shifted(epoch, 7 * 3_600.0 * step) for step in range(-20, 21)]
    times = [moment.tai_ns * 1e-9 for moment in moments]
    theirs = np.array(orekit.ask(kind="tle", lines=lines, times=times))
    known = read(lines)
    ours = np.array([known.at(moment) for moment in moments])
    for part in (slice(0, 3), slice(3, 6)):
        error = np.linalg.norm(ours[:, part] - theirs[:, part], axis=1)
        assert (error / np.linalg.norm(theirs[:, part], axis=1)).max() < 1e-6


@pytest.mark.parametrize("year", [1998, 2006, 2022])
def test_the_axes_are_those_of_astropy(year):
    """Within 0.1 arcsec: the newer nutation, and the frame bias, which the service lets be."""
    moment = parse_utc(f"{year}-04-16T03:00:00Z")
    times = Time([moment.text[:-1]] * 3, scale="utc")
    axes = CartesianRepresentation(*np.eye(3) * 7_000.0, unit=u.km)
    with iers.conf.set_temp("auto_download", False):
        found = TEME(axes, obstime=times).transform_to(GCRS(obstime=times)).cartesian
    theirs = found.xyz.to_value(u.km) / 7_000.0
    assert np.degrees(np.abs(theirs - eme2000_from_teme(moment)).max()) * 3_600.0 < 0.1


def test_the_set_of_the_nearest_epoch_counts():
    later = [with_checksum(ISS[0].replace("22017.5", "22020.5")), ISS[1]]
    both = read(["ISS (ZARYA)", *later, "0 ISS (ZARYA)", *ISS])
    assert both.object_name == "ISS (ZARYA)"
    for days, lines in ((1.4, ISS), (1.6, later), (-6.9, ISS), (9.9, later)):
        moment = shifted(ISS_EPOCH, days * 86_400.0)
        np.testing.assert_array_equal(both.at(moment), read(lines).at(moment))
    for days in (-7.1, 10.1):
        assert both.at(shifted(ISS_EPOCH, days * 86_400.0)) is None


def test_a_leap_second_is_a_second_like_any_other():
    lines = [with_checksum(ISS[0].replace("22017.5", "17001.0")), ISS[1]]
    known = read(lines)
    epoch = parse_utc("2017-01-01T00:00:00Z")
    before, within = known.at(shifted(epoch, -2.0)), known.at(parse_utc("2016-12-31T23:59:60Z"))
    assert np.linalg.norm(within[:3] - before[:3]) == pytest.approx(7.66, abs=0.05)


def test_a_decayed_object_has_no_state():
    """Of the verification: SGP4 says that it has decayed within two days."""
    first, second, states = next(rest for number, *rest in published() if number == "28872")
    _, known = readable(first, second)
    assert known.at(shifted(epoch_of(first), states[-1][0] * 60.0)) is not None
    # Published are states every 5 minutes until it decays.
    moment = shifted(epoch_of(first), states[-1][0] * 60.0 + 300.0)
    assert known.at(moment) is None


def changed(line, begin, text):
    """A line with other text from a column on, counted from 1, and its checksum."""
    line = ISS[line - 1]
    return with_checksum(line[: begin - 1] + text + line[begin - 1 + len(text) :])


BAD = [
    ([], "line 1: line 1: is missing: the file is neither an OEM nor a TLE"),
    (["ISS"], "line 1: line 1: is missing"),
    (ISS[:1], "line 1: line 2: is missing: the file was cut short"),
    ([ISS[1]], "line 1: line 2: must follow line 1 of its set"),
    ([ISS[0], ISS[0]], "line 2: line 2: must begin with 2 and a space"),
    ([ISS[0][:-1] + "x", ISS[1]], "line 1: checksum: must be "),
    ([ISS[0], ISS[1][:-1] + str((int(ISS[1][-1]) + 1) % 10)], "line 2: checksum: must be "),
    ([ISS[0], ISS[1].replace("51.6441", "51.6442")], "line 2: checksum: must be "),
    ([ISS[0][:60], ISS[1]], "line 1: line 1: must have 69 characters; it has 60"),
    ([ISS[0], ISS[1] + "0"], "line 2: line 2: must have 69 characters; it has 70"),
    ([ISS[0], changed(2, 3, "25545")], "line 2: satellite number: must be 25544, as above"),
    ([*ISS, *MOLNIYA], "line 3: satellite number: must be 25544, as above: a file is of one"),
    ([changed(1, 19, "22400.5"), ISS[1]], "line 1: epoch: there is no such day"),
    ([changed(1, 19, "60"), ISS[1]], "line 1: epoch: the year must be from 1972 to 2099"),
    ([changed(1, 19, "2x"), ISS[1]], "line 1: epoch: is not as columns 19 to 32 of line 1"),
    ([changed(1, 54, " 1146x-3"), ISS[1]], "line 1: drag term: is not as columns 54 to 61"),
    ([changed(1, 63, "4"), ISS[1]], "line 1: ephemeris type: is not as columns 63 to 63"),
    ([ISS[0], changed(2, 9, " 51,6441")], "line 2: inclination: is not as columns 9 to 16"),
    ([ISS[0], changed(2, 27, "00 6817")], "line 2: eccentricity: is not as columns 27 to 33"),
    ([ISS[0], changed(2, 53, " 0.00000000")], "line 2: mean motion: must be above 0"),
    ([ISS[0], changed(2, 27, "9999999")], "elements: are refused by SGP4"),
    ([changed(1, 53, "\0"), ISS[1]], "line 1: line: must have no control character"),
    ([changed(1, 53, "x"), ISS[1]], "line 1: line 1: must have a space in column 53"),
    ("\u00e9".encode(), "line 1: line: must be ASCII text"),
    (b"1 " + b"0" * 300, "line 1: line: must have at most 200 bytes"),
]


@pytest.mark.parametrize(("lines", "words"), BAD)
def test_a_bad_file_is_refused_with_file_line_and_field(lines, words):
    with pytest.raises(BadFile) as refusal:
        read(lines)
    assert str(refusal.value).startswith("iss.tle, ")
    assert words in str(refusal.value)


def test_without_sgp4_the_command_that_installs_it_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr("service.extras.find_spec", lambda package: None)
    file = tmp_path / "iss.tle"
    file.write_text("\n".join(ISS))
    with pytest.raises(NotAvailable, match=r"pip install 'attitude-acquisition\[tle\]'"):
        read_ephemeris(file, "--ephemeris")


@pytest.mark.parametrize(
    "lines",
    [
        b"\xef\xbb\xbf" + "\n".join(ISS).encode(),
        b"\xef\xbb\xbf" + "\r\n".join(["ISS (ZARYA)", *ISS]).encode(),
        "\n".join(["made by hand", "", "0 ISS", *ISS, "end"]).encode(),
        "\n".join(f"{line}   " for line in ISS).encode(),
    ],
    ids=["byte order mark", "mark before a name", "text around the set", "spaces at the ends"],
)
def test_what_is_around_a_set_changes_nothing(lines):
    np.testing.assert_array_equal(read(lines).at(ISS_EPOCH), read(ISS).at(ISS_EPOCH))


@pytest.mark.parametrize(
    ("line", "field", "padded"),
    [
        (1, "0006817", "   6817"),
        (1, " 60.2000", "060.2000"),
        (0, "22017.5", "22 17.5"),
        (0, "98067A  ", "        "),
        (0, " .00006000", "+.00006000"),
        (0, " 11466-3", "+11466-3"),
    ],
)
def test_numbers_padded_with_spaces_or_zeros_are_the_same_set(line, field, padded):
    """As CelesTrak describes the format, and as catalogs of several sites write it."""
    lines = list(ISS)
    assert field in lines[line]
    lines[line] = with_checksum(lines[line].replace(field, padded, 1))
    np.testing.assert_array_equal(read(lines).at(ISS_EPOCH), read(ISS).at(ISS_EPOCH))


def test_a_satellite_number_padded_with_spaces_is_read():
    lines = [with_checksum(line.replace("25544", "  511")) for line in ISS]
    np.testing.assert_array_equal(read(lines).at(ISS_EPOCH), read(ISS).at(ISS_EPOCH))


def test_a_set_without_checksums_is_refused_by_its_length():
    with pytest.raises(BadFile, match="must have 69 characters; it has 68"):
        read([line[:68].replace("  999", " 9990") for line in ISS])


def test_the_name_is_the_line_above_the_first_set():
    """Bulletins of amateurs have lines before it, and end with /EX."""
    before = ["SB KEPS @ AMSAT $ORB99060.N", "HR AMSAT ORBITAL ELEMENTS", "MOLNIYA 2-14"]
    found = read([*before, *MOLNIYA, "/EX"])
    assert found.object_name == "MOLNIYA 2-14"
    assert len(found.sets) == 1


DECAYING = [
    "1 55897U 22151AAV 25058.12407234  .09435527  24934+0  44853-1 0  9999",
    "2 55897  98.5849 110.9278 0014449 269.2407  90.7207 15.92146194 26688",
]


def test_a_decaying_object_has_no_state_far_from_its_epoch():
    """A public report: SGP4 puts it a million kilometres away, and names no error."""
    known = read([with_checksum(line[:68] + "0") for line in DECAYING])
    epoch = parse_utc("2025-02-27T02:58:40Z")
    for days, is_known in ((-6.9, False), (-5.0, False), (-1.0, True), (0.0, True), (6.0, False)):
        state = known.at(shifted(epoch, 86400.0 * days))
        assert (state is not None) == is_known
        assert state is None or 6500.0 < np.linalg.norm(state[:3]) < 6800.0
