"""A mission whose file is wrong is flown, and `acquire calibrate` writes the file that is right."""

import json

import numpy as np
import pytest

from service.missions.mission import read_mission
from tests.features.calibration.wrong_file import write_mission_files

BATCHES = 60


@pytest.fixture
def replayed(acquire, tmp_path, monkeypatch):
    """A pass with bent fields and a tracker that is off, replayed with a file of neither."""
    write_mission_files(tmp_path)
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

    code, out, _ = acquire(*asked, "--degree", "2", "--record")
    assert code == 0
    assert "Recorded as version 1, " in out

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
