"""The identifier `ptp` in the pipeline: a batch of the paper's camera, the a priori ignored."""

import json
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from service.acquire import acquire
from service.features.pictures.detection.points import find_points
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import FrameLimits
from service.missions.mission import Mission, parse_mission
from service.observations.schema import submission_from_json
from service.sky.whole_sky.guide import GuideKey
from service.vectors import attitude_error_arcsec, matrix_from_quaternion, quaternion_from_matrix
from studies.scenes import Conditions, SceneSky, draw_scenes

CAMERA = """
name = "CAMERA"
identifier = "ptp"
[zone]
kind = "cap"
axis_body = [0, 0, 1]
radius_deg = 10.0
[tolerances]
pair_separation_max_deg = 8.0
separation_deg = 0.05
magnitude_mag = 1.5
magnitude_order_mag = 1.5
cross_product_deg = 20.0
[catalog]
magnitude_limit_mag = 6.0
[[trackers]]
name = "STARTRACKER_1"
x_axis_body = [1, 0, 0]
y_axis_body = [0, 1, 0]
z_axis_body = [0, 0, 1]
field_of_view_radius_deg = 5.0
sigma_arcsec = 35.25
magnitude_sigma_mag = 0.5
"""
CONDITIONS = Conditions(position_px=1.0, magnitude_sigma_mag=0.0, fewest=7)
OFF_RIGHT, OFF_TURN = 0.1, 1.0
"""Degrees: what counts as right."""
PICTURES = Path(__file__).parents[1] / "features" / "pictures"
REAL = json.loads((PICTURES / "truth.json").read_text("utf-8"))["pictures"]


@pytest.fixture(scope="module")
def mission() -> Mission:
    return parse_mission(CAMERA, "camera.toml")


@pytest.fixture(scope="module")
def scenes(request):
    seed = request.config.getoption("--seed")
    return list(draw_scenes(SceneSky.to_magnitude(6.0), CONDITIONS, 12, seed))


def batch_of(scene, a_priori, **other):
    """The scene as a pipeline would send it, at the epoch of the simulator's sky."""
    body = {
        "spacecraft": "CAMERA",
        "batch": "1",
        "time": "2000-01-01T12:00:00Z",
        "aberration": "ignore",
        "a_priori": a_priori,
        "observations": [
            {
                "tracker": "STARTRACKER_1",
                "stars": [{"vector": vector} for vector in scene.direction.tolist()],
            }
        ],
        **other,
    }
    return submission_from_json(json.dumps(body)).batch


@pytest.mark.parametrize("real", REAL, ids=[each["file"] for each in REAL])
def test_a_real_picture_has_its_attitude_or_none(real, mission, sky):
    """The sixteen brightest points; about a tree most of them are no stars."""
    with (PICTURES / real["file"]).open("rb") as file:
        points = find_points(read_frame(file, FrameLimits(10_000_000)).counts)
    first = np.argsort(-points.flux_counts)[:16]
    middle = (points.width_px - 1) / 2, (points.height_px - 1) / 2
    places = np.column_stack([points.u_px, points.v_px])[first] - middle
    toward = np.column_stack([places / real["focal_length_px"], np.ones(len(first))])
    body = {
        "spacecraft": "CAMERA",
        "batch": "1",
        "time": "2019-07-29T20:47:26Z",
        "aberration": "ignore",
        "a_priori": {"quaternion": [0, 0, 0, 1]},
        "observations": [
            {
                "tracker": "STARTRACKER_1",
                "stars": [
                    {"vector": each}
                    for each in (toward.T / np.linalg.norm(toward, axis=1)).T.tolist()
                ],
            }
        ],
    }
    faint = (
        CAMERA.replace("limit_mag = 6.0", "limit_mag = 7.0")
        .replace("radius_deg = 5.0", "radius_deg = 7.3")
        .replace("35.25", "20.0")
    )
    camera = parse_mission(faint, "camera.toml")
    found = acquire(submission_from_json(json.dumps(body)).batch, camera, sky)
    if "tree" in real["file"]:
        assert found.solution is None
        return
    true = real["rotation_icrs_to_camera"]
    error = attitude_error_arcsec(matrix_from_quaternion(found.solution.quaternion), true)
    assert np.abs(error).max() < OFF_RIGHT * 3600
    assert found.counts["unique"] >= 15


def true_prior(scene):
    return {"quaternion": quaternion_from_matrix(scene.attitude).tolist()}


def opposite(scene):
    """An a priori attitude half a turn off: its zone holds none of the stars seen."""
    return {"quaternion": quaternion_from_matrix(np.diag([1.0, -1, -1]) @ scene.attitude).tolist()}


def test_with_an_a_priori_attitude_half_a_turn_off_the_attitude_is_still_found(
    scenes, mission, sky
):
    """And the answer says how far from the a priori it lies."""
    right = 0
    for scene in scenes:
        found = acquire(batch_of(scene, opposite(scene)), mission, sky)
        if found.solution is None:
            continue
        boresight, turn = scene.off_from(matrix_from_quaternion(found.solution.quaternion))
        assert boresight < OFF_RIGHT
        assert turn < OFF_TURN
        assert any("attitude_off_a_priori" in warning for warning in found.warnings)
        right += 1
    assert right >= 11


def test_the_a_priori_changes_no_star(scenes, mission, sky):
    for scene in scenes[:4]:
        names = [
            acquire(batch_of(scene, prior), mission, sky).trackers[0].identification.star.tolist()
            for prior in (true_prior(scene), opposite(scene))
        ]
        assert names[0] == names[1]


def test_the_identifier_can_be_asked_for_in_a_batch(scenes, missions, sky):
    """For a shipped mission, whose own identifier is another."""
    body = batch_of(scenes[0], true_prior(scenes[0]), options={"identifier": "ptp"})
    moved = structs.replace(body, spacecraft="XTE")
    found = acquire(moved, missions["XTE"], sky)
    assert found.choices.identifier == "ptp"
    assert np.isnan(found.trackers[0].identification.probability).all()


def test_the_guide_database_is_kept_on_the_shelf_and_its_loss_changes_nothing(scenes, mission, sky):
    batch = batch_of(scenes[0], true_prior(scenes[0]))
    first = acquire(batch, mission, sky)
    keys = [entry.key for entry in sky.cache.state().entries if isinstance(entry.key, GuideKey)]
    assert first.run_catalog.digest in [key.run_catalog for key in keys]
    sky.cache.drop(lambda key: isinstance(key, GuideKey))
    again = acquire(batch, mission, sky)
    assert again.trackers[0].identification.star.tolist() == (
        first.trackers[0].identification.star.tolist()
    )
    assert again.solution.quaternion.tolist() == first.solution.quaternion.tolist()


def test_a_mirrored_scene_has_no_attitude(scenes, mission, sky):
    for scene in scenes:
        found = acquire(batch_of(scene.mirrored(), true_prior(scene)), mission, sky)
        assert found.solution is None
        assert found.counts["unique"] == 0
