"""From counts to body vectors: calibration, alignment, time tags, each checked apart."""

import json
import math

import numpy as np
import pytest

from service.errors import BadInput
from service.missions.mission import Calibration, Mission
from service.observations.calibrate import correct
from service.observations.focal_plane import tracker_vectors
from service.observations.schema import submission_from_json
from tests.observations.example import BATCH


def corrected(mission, stars, rates=(0.0, 0.0, 0.0), tracker="STARTRACKER_1"):
    body = {
        **BATCH,
        "spacecraft": mission.name,
        "body_rates_deg_per_s": list(rates),
        "observations": [{"tracker": tracker, "stars": stars}],
    }
    return correct(submission_from_json(json.dumps(body)).batch, mission)[0]


def test_a_vector_and_its_angles_are_the_same_direction(missions):
    h, v = 0.52, -1.21
    vector = np.array([math.tan(math.radians(h)), math.tan(math.radians(v)), 1.0])
    vector /= np.linalg.norm(vector)
    found = corrected(missions["XTE"], [{"h_deg": h, "v_deg": v}, {"vector": vector.tolist()}])
    assert found.direction_body[0] == pytest.approx(found.direction_body[1], abs=1e-15)


def test_sigma_is_the_star_s_own_or_the_tracker_s(missions):
    found = corrected(
        missions["XTE"], [{"h_deg": 0, "v_deg": 0}, {"h_deg": 0, "v_deg": 1, "sigma_arcsec": 9.0}]
    )
    assert found.sigma_arcsec == pytest.approx([3.0 / math.sqrt(2.0), 9.0], abs=1e-6)


@pytest.mark.parametrize(("angle_deg", "outside"), [(3.99, False), (4.01, True), (60.0, True)])
def test_a_star_beyond_the_field_of_view_is_marked_and_kept(missions, angle_deg, outside):
    found = corrected(missions["XTE"], [{"h_deg": angle_deg, "v_deg": 0.0}])
    assert found.outside_field_of_view.tolist() == [outside]
    assert len(found.direction_body) == 1


def test_a_star_behind_the_tracker_is_outside_too(missions):
    assert corrected(missions["XTE"], [{"vector": [0.0, 0.0, -1.0]}]).outside_field_of_view.all()


def test_each_star_is_carried_by_its_own_time_tag(missions):
    rates = (0.0, 0.0, 0.5)
    stars = [{"vector": [0.0, 0.0, 1.0], "time_offset_s": dt} for dt in (-1.0, 0.0, 0.5)]
    found = corrected(missions["XTE"], stars, rates).direction_body
    # The boresight is body X; turned about body Z by rate times offset.
    angles = np.degrees(np.arctan2(found[:, 1], found[:, 0]))
    assert angles == pytest.approx([-0.5, 0.0, 0.25], abs=1e-12)
    assert found[:, 2] == pytest.approx(0.0, abs=1e-16)


def test_rates_without_offsets_and_offsets_without_rates_change_nothing(missions):
    still = corrected(missions["XTE"], [{"h_deg": 1.0, "v_deg": 2.0}]).direction_body
    rates_only = corrected(missions["XTE"], [{"h_deg": 1.0, "v_deg": 2.0}], (1.0, 2.0, 3.0))
    offset = corrected(missions["XTE"], [{"h_deg": 1.0, "v_deg": 2.0, "time_offset_s": 100.0}])
    assert (rates_only.direction_body == still).all()
    assert (offset.direction_body == still).all()


def test_a_tracker_that_the_mission_has_not_is_named_with_those_it_has(missions):
    with pytest.raises(BadInput, match="STARTRACKER_1") as refusal:
        corrected(missions["XTE"], [{"h_deg": 0, "v_deg": 0}], tracker="STARTRACKER_9")
    assert refusal.value.faults[0].field == "observations.0.tracker"


class TestCalibration:
    ANGLES = np.array([[1.0, -2.0]])

    def true_angles(self, calibration):
        x, y, z = tracker_vectors(self.ANGLES, calibration)[0]
        return math.degrees(math.atan2(x, z)), math.degrees(math.atan2(y, z))

    def test_without_coefficients_measured_angles_are_the_true_ones(self):
        assert self.true_angles(Calibration()) == pytest.approx((1.0, -2.0))

    def test_the_scale_multiplies_and_the_terms_are_powers_of_both_angles(self):
        calibration = Calibration(
            scale=1.01,
            h_terms=((0, 0, 0.01), (1, 0, 0.002), (1, 1, 0.003)),
            v_terms=((0, 2, -0.001),),
        )
        h = 1.01 * (1.0 + 0.01 + 0.002 * 1.0 + 0.003 * 1.0 * -2.0)
        v = 1.01 * (-2.0 - 0.001 * 4.0)
        assert self.true_angles(calibration) == pytest.approx((h, v))

    def test_a_mission_s_calibration_is_applied_to_angles_and_not_to_vectors(self, mission_files):
        file = mission_files["XTE"]
        tracker = {**file["trackers"][0], "calibration": {"scale": 1.1}}
        mission = Mission.model_validate({**file, "trackers": [tracker]})
        vector = [math.sin(math.radians(1.0)), 0.0, math.cos(math.radians(1.0))]
        found = corrected(mission, [{"h_deg": 1.0, "v_deg": 0.0}, {"vector": vector}])
        # Tracker X is body Y.
        angles = np.degrees(np.arctan2(found.direction_body[:, 1], found.direction_body[:, 0]))
        assert angles == pytest.approx([1.1, 1.0])
