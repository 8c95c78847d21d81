"""The signs of h and v, of alignment and of body rates, on a body that turns."""

import json
import math

import numpy as np
import pytest

from service.observations.calibrate import correct
from service.observations.schema import submission_from_json
from tests.observations.example import BATCH
from tests.reference.batches import rotation


def body_vectors(mission, stars, rates=(0.0, 0.0, 0.0)):
    body = {
        **BATCH,
        "body_rates_deg_per_s": list(rates),
        "observations": [{"tracker": "STARTRACKER_1", "stars": stars}],
    }
    return correct(submission_from_json(json.dumps(body)).batch, mission)[0].direction_body


T1 = math.tan(math.radians(1.0))
ALONG = 1.0 / math.hypot(T1, 1.0)


@pytest.mark.parametrize(
    ("name", "angles", "expected"),
    [
        # XTE's tracker axes X, Y, Z are body Y, Z, X: h leans towards body Y, v towards body Z.
        ("XTE", (0.0, 0.0), (1.0, 0.0, 0.0)),
        ("XTE", (1.0, 0.0), (ALONG, T1 * ALONG, 0.0)),
        ("XTE", (0.0, 1.0), (ALONG, 0.0, T1 * ALONG)),
        # SOHO's are the body's own.
        ("SOHO", (0.0, 0.0), (0.0, 0.0, 1.0)),
        ("SOHO", (1.0, 0.0), (T1 * ALONG, 0.0, ALONG)),
        ("SOHO", (0.0, -1.0), (0.0, -T1 * ALONG, ALONG)),
    ],
)
def test_h_leans_towards_tracker_x_and_v_towards_tracker_y(missions, name, angles, expected):
    found = body_vectors(missions[name], [{"h_deg": angles[0], "v_deg": angles[1]}])[0]
    assert found == pytest.approx(expected, abs=1e-15)


def test_both_angles_are_of_one_direction_and_not_one_after_the_other(missions):
    """(tan h, tan v, 1), so that h and v may be exchanged by mirroring the plane."""
    found = body_vectors(missions["SOHO"], [{"h_deg": 40.0, "v_deg": 30.0}])[0]
    plane = np.array([math.tan(math.radians(40.0)), math.tan(math.radians(30.0)), 1.0])
    assert found == pytest.approx(plane / np.linalg.norm(plane), abs=1e-15)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("offset_s", [-0.5, 0.25, 2.0])
def test_a_star_seen_from_a_turning_body_is_carried_back_to_the_epoch(missions, axis, offset_s):
    """A body that turns at w about its own axis for a time: physics, without the formula.

    Its axes turn by w t as seen from the stars, so a fixed star's body
    components turn by -w t; carrying them back to the epoch undoes just that.
    """
    rate = 0.06
    w = np.eye(3)[axis] * rate
    # Columns: the body's axes at the epoch, in inertial components; then turned with the body.
    at_epoch = rotation([1.0, 2.0, 3.0], 70.0)
    spin_axis_inertial = at_epoch @ np.eye(3)[axis]
    later = rotation(spin_axis_inertial, rate * offset_s) @ at_epoch
    star = at_epoch @ np.array([0.99, 0.1, -0.05])
    star /= np.linalg.norm(star)
    seen_later = later.T @ star
    # XTE's tracker components of what is seen: body Y, Z, X.
    tracker = seen_later[[1, 2, 0]]
    found = body_vectors(
        missions["XTE"], [{"vector": tracker.tolist(), "time_offset_s": offset_s}], w
    )[0]
    assert found == pytest.approx(at_epoch.T @ star, abs=1e-12)
    # The other sign would be off by twice the turn: 108 arcsec for half a second.
    assert np.linalg.norm(found - seen_later) > 1e-6 or abs(star @ spin_axis_inertial) > 0.98


def test_the_formula_with_its_sign(missions):
    """v(epoch) = exp([w x] dt) v: w = 90 deg/s about z carries body x to body y in a second."""
    found = body_vectors(
        missions["SOHO"], [{"vector": [1.0, 0.0, 0.0], "time_offset_s": 1.0}], (0.0, 0.0, 90.0)
    )[0]
    assert found == pytest.approx([0.0, 1.0, 0.0], abs=1e-15)
