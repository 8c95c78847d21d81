"""Values that stand for none and stars that are there twice: taken so with a remark, or refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from service.acquire import acquire
from service.errors import BadBatch
from service.missions.mission import load_missions
from service.observations.schema import fingerprint_of, submission_from_json
from service.observations.telemetry import read_lines
from service.sky.ephemeris import LIGHT_KM_PER_S, observer_velocity

REPEATED = Path(__file__).parent / "repeated"
XTE = load_missions()["XTE"]


def bodies(name):
    lines = list(read_lines(REPEATED / name))
    assert [line.fault for line in lines if line.fault is not None] == []
    return [json.loads(line.body) for line in lines]


def codes(warnings):
    return [each.partition(":")[0] for each in warnings]


def answered(body, sky):
    submission = submission_from_json(json.dumps(body))
    return submission, acquire(submission.batch, XTE, sky)


def test_a_file_appended_to_itself_gives_the_stars_once_with_a_remark(sky):
    """The input of a public report: a logger that was started twice."""
    for once, twice in zip(bodies("ok.csv"), bodies("twice.csv"), strict=True):
        assert len(twice["observations"][0]["stars"]) == 2 * len(once["observations"][0]["stars"])
        wanted, single = answered(once, sky)
        found, double = answered(twice, sky)
        assert double.counts == single.counts
        assert double.solution.quaternion.tolist() == single.solution.quaternion.tolist()
        assert "repeated_stars" in codes(double.warnings)
        assert "repeated_stars" not in codes(single.warnings)
        # Both are the same batch: the second that is sent is a repeat.
        assert found.fingerprint == wanted.fingerprint == fingerprint_of(found.text)
        again = submission_from_json(found.text)
        assert (again.text, again.fingerprint) == (found.text, found.fingerprint)


def test_stars_that_differ_in_anything_stay_apart():
    body = bodies("ok.csv")[0]
    star = body["observations"][0]["stars"][0]
    for key, value in (("magnitude", 3.25), ("time_offset_s", 0.5), ("sigma_arcsec", 7.0)):
        changed = json.loads(json.dumps(body))
        changed["observations"][0]["stars"].append(star | {key: value})
        batch = submission_from_json(json.dumps(changed)).batch
        assert batch.observations[0].count == len(body["observations"][0]["stars"]) + 1
        assert batch.remarks == ()


@pytest.mark.parametrize("number", [0.0, -99.99])
@pytest.mark.parametrize("field", ["velocity_km_per_s", "position_km"])
def test_a_velocity_or_a_position_of_one_number_three_times_is_not_given(field, number, sky):
    body = bodies("ok.csv")[0] | {field: [number] * 3}
    submission, found = answered(body, sky)
    assert getattr(submission.batch, field) is None
    assert f"{field}_not_given" in codes(found.warnings)
    if field == "velocity_km_per_s":
        assert "velocity_of_earth_alone" in codes(found.warnings)


@pytest.mark.parametrize(("about_earth", "is_said"), [(0.0, True), (1.0, True), (None, False)])
def test_a_velocity_about_the_sun_is_said(about_earth, is_said, sky):
    body = bodies("ok.csv")[0]
    own = np.array(ORBIT["velocity_km_per_s"])
    moment = submission_from_json(json.dumps(body)).batch.time
    earth = observer_velocity(moment, None) * LIGHT_KM_PER_S
    # A probe that is as fast as the Earth, the other way round.
    velocity = -earth if about_earth is None else earth + about_earth * own
    _, found = answered(body | {"velocity_km_per_s": velocity.tolist()}, sky)
    assert ("velocity_about_sun" in codes(found.warnings)) == is_said
    _, right = answered(body | {"velocity_km_per_s": own.tolist()}, sky)
    assert "velocity_about_sun" not in codes(right.warnings)


ORBIT = {"position_km": [-5782.8, -3856.1, 323.9], "velocity_km_per_s": [3.7556, -5.8787, -2.9363]}


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_a_position_in_another_unit_is_refused_by_its_value(factor):
    position = [each * factor for each in ORBIT["position_km"]]
    body = bodies("ok.csv")[0] | ORBIT | {"position_km": position}
    with pytest.raises(BadBatch, match=r"position_km.*(inside it|give kilometres)"):
        submission_from_json(json.dumps(body))


@pytest.mark.parametrize(
    ("position", "velocity"),
    [
        (ORBIT["position_km"], ORBIT["velocity_km_per_s"]),
        # About L1, geostationary, and on an orbit of its own about the Sun.
        ([1.5e6, 2e5, 1e5], [0.1, 0.3, 0.05]),
        ([42_164.0, 0.0, 0.0], [0.0, 3.07, 0.0]),
        ([3.0e7, 2.0e7, 1e6], [1.5, 2.0, 0.3]),
        ([2.0e8, 1e7, 0.0], [10.0, 25.0, 0.0]),
    ],
)
def test_orbits_of_spacecraft_are_taken(position, velocity):
    body = bodies("ok.csv")[0] | {"position_km": position, "velocity_km_per_s": velocity}
    batch = submission_from_json(json.dumps(body)).batch
    assert batch.position_km.tolist() == position
    assert batch.remarks == ()


@pytest.mark.parametrize("magnitude", [99.0, -999.0])
def test_magnitudes_that_no_star_has_are_refused_by_field_and_value(magnitude):
    body = bodies("ok.csv")[0]
    body["observations"][0]["stars"][1]["magnitude"] = magnitude
    with pytest.raises(BadBatch, match=rf"stars\.1\.magnitude.*{magnitude}"):
        submission_from_json(json.dumps(body))


@pytest.mark.parametrize("magnitude", [0.0, -1.0, 25.0])
def test_magnitudes_that_no_field_has_are_not_given(magnitude, sky):
    body = bodies("ok.csv")[0]
    for star in body["observations"][0]["stars"]:
        star["magnitude"] = magnitude
    _, found = answered(body, sky)
    assert "magnitudes_not_given" in codes(found.warnings)
    assert found.solution is not None
    # A single star may be as bright as that.
    body = bodies("ok.csv")[0]
    body["observations"][0]["stars"][0]["magnitude"] = 0.0
    assert submission_from_json(json.dumps(body)).batch.remarks == ()


def test_a_measured_attitude_whose_row_is_there_twice_is_taken_once(tmp_path, sky):
    header = "spacecraft,batch,time,tracker,measured_q1,measured_q2,measured_q3,measured_qc,"
    header += "measured_sigma_x_arcsec,measured_sigma_y_arcsec,measured_sigma_z_arcsec\n"
    row = "XTE,m1,1999-03-01T24:00:00Z,,0,0,0,1.0D+00,5.0d0,5,3.0D+1\n"
    (tmp_path / "m.csv").write_text(header + row + row)
    (line,) = read_lines(tmp_path / "m.csv")
    assert line.fault is None
    batch = submission_from_json(line.body).batch
    assert codes(batch.remarks) == codes(acquire(batch, XTE, sky).warnings) == ["repeated_rows"]
    # Fortran's exponents, and midnight at the end of a day.
    assert batch.time.text == "1999-03-02T00:00:00.000Z"
    assert batch.measurement.covariance_arcsec2.diagonal() == pytest.approx([25.0, 25.0, 900.0])
    (tmp_path / "m.csv").write_text(header + row + row.replace("5.0d0", "6.0"))
    (line,) = read_lines(tmp_path / "m.csv")
    assert "differs from line 2" in str(line.fault)
