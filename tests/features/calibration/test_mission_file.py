"""A calibration written into a mission file gives the directions that were estimated."""

import numpy as np
import pytest

from service.errors import BadConfiguration
from service.features.calibration.estimate import calibrate
from service.features.calibration.linearise import Model
from service.features.calibration.mission_file import calibrated_mission_text, tracker_lines
from service.missions.mission import parse_mission
from service.observations.focal_plane import tracker_vectors
from tests.features.calibration.drawn import (
    MISALIGNED,
    TRACKERS,
    Truth,
    bending,
    direction_of,
    drawn,
    field,
    true_angles,
)
from tests.missions.stated_files import STATED_FOLDER

PRESENT = """
[trackers.calibration]   # of the ground test
scale = 1.001
h_terms = [[1, 1, 0.0002]]
"""
TRACKER = """
[[trackers]]
name = "{name}"
x_axis_body = {axes[0]}    # on the panel
y_axis_body = {axes[1]}
z_axis_body = {axes[2]}
field_of_view_radius_deg = 4.0
sigma_arcsec = 6.0
magnitude_sigma_mag = 0.1
"""


def mission_text(calibrations=("", "")):
    head, _, _ = (STATED_FOLDER / "xte.toml").read_text(encoding="utf-8").partition("[[trackers]]")
    own = [
        TRACKER.format(
            name=each.name,
            axes=[list(axis) for axis in (each.x_axis_body, each.y_axis_body, each.z_axis_body)],
        )
        + calibration
        for each, calibration in zip(TRACKERS, calibrations, strict=True)
    ]
    return head + "".join(own)


def found_for(mission, seed, batches=2000):
    rng = np.random.default_rng(seed)
    truth = Truth(MISALIGNED, bending(rng), scale=(2e-4, -3e-4))
    stars = drawn(rng, batches, truth, sigma_arcsec=0.05, told_sigma_arcsec=0.05)
    object.__setattr__(stars, "trackers", mission.trackers)
    return truth, calibrate(stars, Model(degree=3))


def test_the_written_mission_corrects_angles_and_alignment_as_estimated():
    text = mission_text()
    truth, found = found_for(parse_mission(text, "m.toml"), 1, batches=300)
    mission = parse_mission(calibrated_mission_text(text, "m.toml", found), "m.toml")
    measured = field(np.random.default_rng(2), 400)
    for index, each in enumerate(mission.trackers):
        corrected = tracker_vectors(measured, each.calibration)
        expected = direction_of(true_angles(truth, index, measured))
        assert 206265 * np.abs(corrected - expected).max() < 0.5
    turned = mission.trackers[1].body_from_tracker @ TRACKERS[1].body_from_tracker.T
    found_arcsec = 206265 * np.array([turned[2, 1], turned[0, 2], turned[1, 0]])
    np.testing.assert_allclose(found_arcsec, MISALIGNED, atol=0.3)
    np.testing.assert_array_equal(
        mission.trackers[0].body_from_tracker, TRACKERS[0].body_from_tracker
    )


def test_a_calibration_that_is_there_already_is_corrected_and_not_replaced():
    """Corrections are added to the polynomials of the measured angles."""
    before = parse_mission(mission_text((PRESENT, "")), "m.toml").trackers[0]
    _, found = found_for(parse_mission(mission_text(), "m.toml"), 3, batches=100)
    text = calibrated_mission_text(mission_text((PRESENT, "")), "m.toml", found)
    after = parse_mission(text, "m.toml").trackers[0]
    fresh = parse_mission(calibrated_mission_text(mission_text(), "m.toml", found), "m.toml")
    measured = field(np.random.default_rng(4), 100)
    by = [
        np.degrees(np.arctan2(v[:, :2], v[:, 2:]))
        for v in (
            tracker_vectors(measured, each.calibration)
            for each in (before, after, fresh.trackers[0], TRACKERS[0])
        )
    ]
    np.testing.assert_allclose(by[1] - by[0], by[2] - by[3], atol=1e-9)


def test_everything_else_in_the_file_stays_as_it_is():
    text = mission_text((PRESENT, ""))
    _, found = found_for(parse_mission(text, "m.toml"), 5, batches=100)
    edited = calibrated_mission_text(text, "m.toml", found).splitlines()
    kept = [line for line in text.splitlines() if line in edited]
    missing = [line for line in text.splitlines() if line not in edited]
    assert len(kept) > 40
    assert all(line.split(" ")[0] in LINES_THAT_CHANGE for line in missing)


LINES_THAT_CHANGE = (
    "x_axis_body",
    "y_axis_body",
    "z_axis_body",
    "[trackers.calibration]",
    "scale",
    "h_terms",
)


def test_a_file_laid_out_otherwise_is_refused():
    text = mission_text()
    text = text.replace("z_axis_body = [0.0, 1.0, 0.0]", "z_axis_body = [\n0.0, 1.0, 0.0]")
    _, found = found_for(parse_mission(text, "m.toml"), 6, batches=100)
    with pytest.raises(BadConfiguration, match=r"m\.toml: "):
        calibrated_mission_text(text, "m.toml", found)


def test_the_reference_tracker_keeps_its_axes():
    _, found = found_for(parse_mission(mission_text(), "m.toml"), 7, batches=100)
    assert tracker_lines(TRACKERS[0], found)["tracker"] == {}
    assert set(tracker_lines(TRACKERS[1], found)["tracker"]) == {
        "x_axis_body",
        "y_axis_body",
        "z_axis_body",
    }
