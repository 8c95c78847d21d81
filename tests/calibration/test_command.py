"""A mission whose file is wrong is flown, and `acquire calibrate` writes the file that is right."""

import json
import math

import numpy as np
import pytest

from service.missions.mission import SHIPPED_FOLDER, read_mission

BATCHES = 60
SECOND = """
[[trackers]]
name = "SECOND"
x_axis_body = [0.0, 0.0, 1.0]
y_axis_body = [1.0, 0.0, 0.0]
z_axis_body = [0.0, 1.0, 0.0]
field_of_view_radius_deg = 4.0
sigma_arcsec = 2.0
magnitude_sigma_mag = 0.1
"""
CALIBRATION = """
[trackers.calibration]
h_terms = [[2, 0, 2e-4]]
v_terms = [[0, 2, -2e-4]]
"""
TURNED_ARCSEC = 80.0


@pytest.fixture
def replayed(acquire, tmp_path, monkeypatch):
    """A pass with bent fields and a tracker that is off, replayed with a file of neither."""
    xte = (SHIPPED_FOLDER / "xte.toml").read_text(encoding="utf-8")
    assumed = xte.replace('name = "XTE"', 'name = "TWO"') + SECOND
    turn = math.radians(TURNED_ARCSEC / 3600.0)
    # About body Z: x of the tracker stays, y (body X) and z (body Y) turn.
    true = assumed.replace(
        "y_axis_body = [1.0, 0.0, 0.0]\nz_axis_body = [0.0, 1.0, 0.0]",
        f"y_axis_body = [{math.cos(turn)}, {math.sin(turn)}, 0.0]\n"
        f"z_axis_body = [{-math.sin(turn)}, {math.cos(turn)}, 0.0]",
    )
    assert true != assumed
    for folder, text in (("true", true + CALIBRATION), ("assumed", assumed)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "two.toml").write_text(text, "utf-8")
    monkeypatch.setenv("ACQUIRE_MISSIONS", str(tmp_path / "true"))
    wanted = ("--batches", BATCHES, "--seed", 3, "--angles", 1, "--nominal")
    simulated = acquire(
        "simulate", "telemetry", "--spacecraft", "TWO", *wanted, tmp_path / "pass.ndjson"
    )
    assert simulated[0] == 0, simulated
    monkeypatch.setenv("ACQUIRE_MISSIONS", str(tmp_path / "assumed"))
    assert acquire("replay", tmp_path / "pass.ndjson", "--in-process", "--run", "r")[0] == 0
    return tmp_path


def test_the_written_file_has_what_was_wrong(acquire, replayed):
    asked = ("calibrate", "TWO", "--run", "r", "--quiet")
    code, out, complaint = acquire(*asked, "-o", replayed / "new.toml")
    assert code == 0, complaint
    assert f"{BATCHES} of {BATCHES} batches had identified stars" in out
    assert "2: 1.0" in out
    assert "absolute alignment: the stars give the attitude through the trackers" in out
    true = read_mission(replayed / "true" / "two.toml").trackers[1]
    assumed = read_mission(replayed / "assumed" / "two.toml").trackers[1]
    new = read_mission(replayed / "new.toml").trackers[1]
    off, left = (
        206265 * np.abs(true.body_from_tracker - each.body_from_tracker).max()
        for each in (assumed, new)
    )
    assert off > 79.0
    assert left < 8.0

    code, out, _ = acquire(*asked, "--degree", "2", "--tracker", "SECOND", "--json")
    told = json.loads(out)
    assert code == 0
    assert (told["degree"], told["held_out"]) == (2, [])
    assert {each["tracker"] for each in told["unknowns"]} == {"SECOND"}
    assert len(told["covariance"]) == len(told["unknowns"])
    (bent,) = (each for each in told["unknowns"] if each["name"] == "SECOND h P2(x) P0(y)")
    # h^2 is (2 P2 + 1) / 3 of the edge squared.
    assert abs(bent["value"] - 3600 * 2e-4 * 16 * 2 / 3) < 4 * bent["sigma"]


def test_mistakes_name_the_argument(acquire, replayed):
    for more, complaint in (
        (("--tracker", "THIRD"), "--tracker: TWO has STARTRACKER_1, SECOND"),
        (("--degree", "9"), "degree: must be from 0 to 7"),
        (("-o", replayed / "assumed" / "two.toml"), "--output: is the mission file in use"),
        (("--start", "2001-01-01T00:00:00Z"), "have no identified stars"),
    ):
        code, _, told = acquire("calibrate", "TWO", "--run", "r", "--quiet", *more)
        assert code == 2, told
        assert complaint in told
