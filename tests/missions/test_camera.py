"""A camera turns directions into places and back, and says what is wrong with its file."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import BadConfiguration, BadInput
from service.missions.mission import SHIPPED_FOLDER, load_missions, parse_mission
from service.vectors import ARCSEC_PER_RADIAN, angle_between_deg

IMAGER = (SHIPPED_FOLDER / "imager.toml").read_text(encoding="utf-8")
CAMERA = load_missions()["IMAGER"].trackers[0].camera

on_the_sensor = st.floats(-20.0, 1044.0)


@given(u=on_the_sensor, v=on_the_sensor)
def test_a_place_comes_back_from_its_direction(u, v):
    back = CAMERA.places(CAMERA.directions(np.array([u]), np.array([v])))
    assert np.allclose(np.ravel(back), (u, v), atol=1e-7)


def test_the_boresight_is_where_the_file_says_and_the_axes_are_the_tracker_s():
    boresight = CAMERA.directions(np.array([CAMERA.center_u_px]), np.array([CAMERA.center_v_px]))
    assert np.allclose(boresight, [[0.0, 0.0, 1.0]])
    right = CAMERA.directions(np.array([CAMERA.center_u_px + 10]), np.array([CAMERA.center_v_px]))
    below = CAMERA.directions(np.array([CAMERA.center_u_px]), np.array([CAMERA.center_v_px + 10]))
    assert right[0, 0] > 0
    assert below[0, 1] > 0


def test_what_lies_behind_the_sensor_has_no_place():
    u, v = CAMERA.places(np.array([[0.1, 0.1, -0.9], [0.0, 0.0, 1.0]]))
    assert np.isnan(u).tolist() == [True, False]
    assert np.isnan(v).tolist() == [True, False]


def test_an_error_in_pixels_is_the_angle_it_moves_a_direction_by(rng):
    u, v = rng.uniform(0, 1023, (2, 50))
    shift = 0.01
    sigma = CAMERA.tangent_sigmas_arcsec(u, v, np.full(50, shift), np.full(50, shift))
    moved = [
        angle_between_deg(CAMERA.directions(u, v), CAMERA.directions(u + du, v + dv)) * 3600.0
        for du, dv in ((shift, 0.0), (0.0, shift))
    ]
    assert np.allclose(sigma, np.sqrt((moved[0] ** 2 + moved[1] ** 2) / 2.0), rtol=2e-3)
    assert np.allclose(sigma, shift * ARCSEC_PER_RADIAN / CAMERA.focal_length_px, rtol=0.05)


def test_a_magnitude_comes_back_from_its_light():
    magnitudes = np.array([-1.0, 2.5, 6.5])
    light = CAMERA.flux_counts(magnitudes, 0.2)
    assert np.allclose(CAMERA.magnitude(light, 0.2), magnitudes)
    assert np.isnan(CAMERA.magnitude(np.array([-5.0, 0.0]), 0.2)).all()


def test_the_shipped_field_of_view_reaches_to_the_corners_of_the_sensor():
    tracker = load_missions()["IMAGER"].trackers[0]
    radius = CAMERA.corner_radius_deg
    assert radius <= tracker.field_of_view_radius_deg < radius + 0.1


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "focal_length_px = 5852.0",
            "focal_length_mm = 50",
            ("focal_length_mm", "focal_length_px"),
        ),
        ("gain_e_per_count = 2.0", "gain_e_per_count = 0", ("gain_e_per_count", "above 0")),
        ('centroid = "matched"', 'centroid = "guess"', ("centroid", "'recursive'")),
        ("bias_counts = 200.0", "bias_counts = 50000", ("camera", "below saturation_counts")),
        ("[[3, 0, 0.0135]", "[[-3, 0, 0.0135]", ("u_terms", "at least 0")),
    ],
)
def test_a_mistake_in_a_camera_names_the_key_and_what_is_allowed(old, new, words):
    with pytest.raises(BadConfiguration) as refusal:
        parse_mission(IMAGER.replace(old, new), "site/imager.toml")
    for word in ("site/imager.toml", *words):
        assert word in str(refusal.value)


def test_a_mission_without_a_camera_says_so(missions):
    with pytest.raises(BadInput, match="XTE describes no camera"):
        missions["XTE"].camera_tracker(None, "tracker")
    with pytest.raises(BadInput, match="IMAGER has STARTRACKER_1"):
        missions["IMAGER"].camera_tracker("NOPE", "tracker")
    assert missions["IMAGER"].camera_tracker(None, "tracker")[1] == CAMERA
