"""Mean elements as OMM, in the four forms of catalogs: the states of the same two-line sets."""

import csv
import io
import json
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from service.ephemerides.files import read_ephemeris
from service.errors import BadFile
from service.times import parse_utc, shifted
from tests.ephemerides.orbits import ISS, ISS_EPOCH
from tests.ephemerides.test_reading_tle import MOLNIYA, published, readable
from tests.ephemerides.test_reading_tle import read as read_set


def exponent(text):
    """A number as columns of a set have it, such as -14314-2."""
    return float(f"{text[0].strip()}.{text[1:6].strip()}e{text[6:8]}")


def fields_of(lines, **more):
    """The elements of a two-line set as a catalog names them."""
    first, second = lines
    year = int(first[18:20])
    since = timedelta(days=float(first[20:32]) - 1.0)
    epoch = datetime(year + (1900 if year > 56 else 2000), 1, 1, tzinfo=UTC) + since
    return {
        "OBJECT_NAME": "A SATELLITE",
        "OBJECT_ID": "1998-067A",
        "EPOCH": epoch.strftime("%Y-%m-%dT%H:%M:%S.%f"),
        "MEAN_MOTION": float(second[52:63]),
        "ECCENTRICITY": float(f".{second[26:33].replace(' ', '0')}"),
        "INCLINATION": float(second[8:16]),
        "RA_OF_ASC_NODE": float(second[17:25]),
        "ARG_OF_PERICENTER": float(second[34:42]),
        "MEAN_ANOMALY": float(second[43:51]),
        "EPHEMERIS_TYPE": 0,
        "CLASSIFICATION_TYPE": "U",
        "NORAD_CAT_ID": first[2:7].strip(),
        "ELEMENT_SET_NO": 999,
        "REV_AT_EPOCH": 12345,
        "BSTAR": exponent(first[53:61]),
        "MEAN_MOTION_DOT": float(first[33:43].replace(" ", "0")),
        "MEAN_MOTION_DDOT": exponent(first[44:52]),
        **more,
    }


META = {"CENTER_NAME": "EARTH", "REF_FRAME": "TEME", "TIME_SYSTEM": "UTC"}
META |= {"MEAN_ELEMENT_THEORY": "SGP4"}


def as_json(*sets):
    return json.dumps(sets if len(sets) > 1 else sets[0])


def as_csv(*sets):
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(sets[0]))
    writer.writeheader()
    writer.writerows(sets)
    return stream.getvalue()


def as_kvn(*sets):
    return "".join(
        "CCSDS_OMM_VERS = 3.0\nCOMMENT from a catalog\n"
        + "".join(f"{name} = {value}\n" for name, value in (META | each).items())
        for each in sets
    )


def as_xml(*sets):
    def tags(names, of):
        return "".join(f"<{name}>{of[name]}</{name}>" for name in names)

    def message(of):
        names = list(of)
        place = names.index("EPHEMERIS_TYPE")
        return (
            '<omm id="CCSDS_OMM_VERS" version="2.0"><header><CREATION_DATE/><ORIGINATOR/></header>'
            f"<body><segment><metadata>{tags(names[:2], of)}{tags(META, META)}</metadata><data>"
            f"<meanElements>{tags(names[2:place], of)}</meanElements>"
            f"<tleParameters>{tags(names[place:], of)}</tleParameters></data></segment></body>"
            "</omm>"
        )

    messages = "".join(map(message, sets))
    # Catalogs put even one message into an element of many.
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<ndm>{messages}</ndm>'


FORMS = {"json": as_json, "csv": as_csv, "kvn": as_kvn, "xml": as_xml}


def read(text, tmp_path, name="elements.txt"):
    (tmp_path / name).write_text(text)
    return read_ephemeris(tmp_path / name, "--ephemeris")


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_states_of_the_two_line_set(form, tmp_path):
    """Low, eccentric and far orbits agree as well as microseconds tell the epoch."""
    sets = [(ISS, ISS_EPOCH), (MOLNIYA, parse_utc("2006-06-25T08:00:00Z"))]
    for lines, epoch in sets:
        known, wanted = read(FORMS[form](fields_of(lines)), tmp_path), read_set(lines)
        assert known.object_name == "A SATELLITE"
        for hours in (-48.0, -1.5, 0.0, 0.7, 90.0):
            moment = shifted(epoch, 3600.0 * hours)
            np.testing.assert_allclose(known.at(moment), wanted.at(moment), rtol=0, atol=2e-5)


@pytest.mark.parametrize("form", FORMS)
def test_an_epoch_may_have_a_space_for_its_t_and_a_z(form, tmp_path):
    fields = fields_of(ISS)
    known = read(FORMS[form](fields), tmp_path)
    for epoch in (fields["EPOCH"].replace("T", " "), fields["EPOCH"] + "Z"):
        other = read(FORMS[form](fields | {"EPOCH": epoch}), tmp_path)
        assert np.array_equal(other.at(ISS_EPOCH), known.at(ISS_EPOCH))


def test_the_verification_sets_have_the_same_states_as_elements(tmp_path):
    compared = 0
    for _, first, second, states in published():
        lines, wanted = readable(first, second)
        if wanted is None:
            continue
        known = read(as_json(fields_of(lines)), tmp_path)
        epoch = wanted.sets[0]
        for minutes in states[:5, 0].tolist():
            error, position, _ = epoch.elements.sgp4_tsince(minutes)
            other, found, _ = known.sets[0].elements.sgp4_tsince(minutes)
            assert error == other
            np.testing.assert_allclose(found, position, rtol=0, atol=1e-5)
            compared += 1
    assert compared > 50


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("number", ["799501299", "999100101", "5", "100000"])
def test_any_number_of_an_object_is_read(form, number, tmp_path):
    """Beyond 339,999, where those of two-line sets end, as of new constellations."""
    fields = fields_of(ISS, NORAD_CAT_ID=number, OBJECT_NAME="")
    known = read(FORMS[form](fields), tmp_path)
    assert known.object_name == number
    usual = read(FORMS[form](fields_of(ISS)), tmp_path)
    assert np.array_equal(known.at(ISS_EPOCH), usual.at(ISS_EPOCH))


@pytest.mark.parametrize("form", FORMS)
def test_of_several_sets_the_nearest_counts(form, tmp_path):
    later = fields_of(ISS) | {"EPOCH": shifted(ISS_EPOCH, 86_400.0).text.rstrip("Z")}
    known = read(FORMS[form](later, fields_of(ISS)), tmp_path)
    assert len(known.sets) == 2
    alone = read(FORMS[form](later), tmp_path)
    moment = shifted(ISS_EPOCH, 80_000.0)
    assert np.array_equal(known.at(moment), alone.at(moment))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"MEAN_MOTION": "x"}, "MEAN_MOTION: must be a number from 0.001 to 20"),
        ({"ECCENTRICITY": 1.5}, "ECCENTRICITY: must be a number from 0 to 1"),
        ({"EPOCH": "2024-02-30T00:00:00"}, "EPOCH: "),
        ({"EPHEMERIS_TYPE": 4}, "EPHEMERIS_TYPE: must be 0 or 2"),
        ({"INCLINATION": ""}, "INCLINATION: must be a number from 0 to 180"),
        ({"BSTAR": "nan"}, "BSTAR: must be a number"),
    ],
)
def test_a_bad_element_is_refused_by_file_line_and_field(form, more, words, tmp_path):
    with pytest.raises(BadFile, match=rf"elements.txt, line \d+: {words}"):
        read(FORMS[form](fields_of(ISS) | more), tmp_path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[", "JSON: must be a set of elements"),
        pytest.param('{"a":' + "[" * 100_000, "JSON: must be a set of elements", id="deep"),
        ("[1]", "JSON: must be a set of elements"),
        ("[]", "EPOCH: is missing: the file has no elements"),
        (as_kvn(fields_of(ISS)).replace("TEME", "EME2000"), "REF_FRAME: must be TEME"),
        (as_kvn(fields_of(ISS)).replace("= SGP4", "= DSST"), "MEAN_ELEMENT_THEORY: must be SGP4"),
        (as_xml(fields_of(ISS)).replace("</ndm>", ""), "XML: no element found"),
        (as_csv(fields_of(ISS)).rstrip() + ",1\n", "row: must have as many cells"),
        (as_json(fields_of(ISS), fields_of(MOLNIYA)), "NORAD_CAT_ID: must be the same"),
    ],
)
def test_a_file_that_is_no_elements_of_one_object_is_refused(text, words, tmp_path):
    with pytest.raises(BadFile, match=rf"elements.txt, line \d+: {words}"):
        read(text, tmp_path)


def test_digits_beyond_the_nanosecond_are_cut_off_and_empty_cells_are_none(tmp_path):
    fields = fields_of(ISS)
    usual = read(as_csv(fields), tmp_path)
    more = fields | {"EPOCH": fields["EPOCH"] + "0009999", "EPHEMERIS_TYPE": ""}
    known = read(as_csv(more), tmp_path)
    assert np.array_equal(known.at(ISS_EPOCH), usual.at(ISS_EPOCH))
