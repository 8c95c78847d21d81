"""A tracker's own quaternion against the convention, written out and through scipy."""

import json
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.acquire import acquire
from service.errors import BadInput
from service.missions.mission import load_missions
from service.observations.schema import submission_from_json

HALF_ROOT = math.sqrt(0.5)


def measured(sky, mission, **measurement):
    body = {
        "spacecraft": mission.name,
        "batch": "q",
        "time": "1996-01-10T12:00:00Z",
        "measurement": measurement,
        "a_priori": None,
    }
    return acquire(submission_from_json(json.dumps(body)).batch, mission, sky)


def test_thirty_degrees_about_z_is_recorded_as_it_was_sent(sky):
    # The body turned by +30 deg about z: what lies along inertial x is at -30 deg in the body.
    sent = [0.0, 0.0, math.sin(math.radians(15.0)), math.cos(math.radians(15.0))]
    found = measured(sky, load_missions()["XTE"], quaternion=sent, sigma_arcsec=[1.0, 2.0, 3.0])
    solution = found.solution
    assert solution.quaternion == pytest.approx(sent, abs=1e-15)
    cosine, sine = math.cos(math.radians(30.0)), math.sin(math.radians(30.0))
    assert solution.matrix @ [1.0, 0.0, 0.0] == pytest.approx([cosine, -sine, 0.0], abs=1e-15)
    assert np.array_equal(solution.covariance_arcsec2, np.diag([1.0, 4.0, 9.0]))
    assert (solution.method, solution.suspect, found.path) == ("measured", False, "measured")


def test_a_tracker_along_body_x_gives_an_attitude_and_sigmas_about_body_axes(sky):
    mission = load_missions()["XTE"]
    (tracker,) = mission.trackers
    # XTE's tracker looks along body X.
    assert tracker.boresight_body == pytest.approx([1.0, 0.0, 0.0])
    found = measured(
        sky,
        mission,
        quaternion=[0.0, HALF_ROOT, 0.0, HALF_ROOT],
        tracker=tracker.name,
        sigma_arcsec=[6.0, 5.0, 40.0],
    ).solution
    # scipy's rotation takes tracker vectors to inertial ones; body from tracker comes after.
    to_inertial = Rotation.from_quat([0.0, HALF_ROOT, 0.0, HALF_ROOT]).as_matrix()
    assert found.matrix == pytest.approx(tracker.body_from_tracker @ to_inertial.T, abs=1e-14)
    # The large sigma is about the boresight, which is body X.
    assert found.covariance_arcsec2[0, 0] == pytest.approx(1600.0)
    assert sorted(np.diag(found.covariance_arcsec2)) == pytest.approx([25.0, 36.0, 1600.0])


def test_the_sign_of_a_quaternion_does_not_matter(sky):
    q = np.array([0.1, 0.2, 0.3, 0.9273618495495703])
    one, other = (
        measured(sky, load_missions()["XTE"], quaternion=each, sigma_arcsec=[1.0, 1.0, 1.0])
        for each in (q.tolist(), (-q).tolist())
    )
    assert one.solution.quaternion == pytest.approx(other.solution.quaternion, abs=1e-15)
    assert one.solution.quaternion[3] > 0.0


def test_a_tracker_that_the_mission_has_not_is_named(sky):
    with pytest.raises(BadInput) as refusal:
        measured(
            sky,
            load_missions()["XTE"],
            quaternion=[0.0, 0.0, 0.0, 1.0],
            tracker="NO_SUCH",
            sigma_arcsec=[1.0, 1.0, 1.0],
        )
    assert refusal.value.faults[0].field == "measurement.tracker"
