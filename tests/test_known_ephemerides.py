"""Velocity and position of a file for the batches of a replay that carry none."""

import json

import numpy as np
import pytest

from service.app.factory import open_app
from service.cli import main
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.times import parse_utc
from tests.ephemerides.orbits import ISS, oem_text, with_checksum

N = 6


@pytest.fixture(scope="module")
def lines(missions, sky):
    """Batches without velocity and position, but the last, which has both."""
    drawn = [each.batch for each in draw_pass(missions["XTE"], sky, Pass(N, 5))]
    bare = [
        {name: value for name, value in each.items() if name not in STATE} | {"sun_vector": None}
        for each in drawn
    ]
    return [*bare[:-1], bare[-1] | {"velocity_km_per_s": [7.0, 0.5, 0.25], "position_km": OWN}]


STATE = ("velocity_km_per_s", "position_km")
OWN = [1_000.0, 2_000.0, 6_000.0]


@pytest.fixture
def replayed(lines, tmp_path, capsys):
    telemetry = tmp_path / "pass.ndjson"
    telemetry.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    database = f"sqlite:///{tmp_path / 'a.db'}"

    def replay(*options):
        out = tmp_path / "answers.ndjson"
        where = ["--in-process", "--database", database, "--run", "here", "--results", str(out)]
        code = main(["replay", str(telemetry), "--json", *where, *map(str, options)])
        answers = out.read_text().splitlines() if out.exists() else []
        told = capsys.readouterr()
        if code:
            return told.err, []
        app = open_app(Settings(database=database))
        try:
            stored = [app.results.get(json.loads(each)["id"]) for each in answers]
        finally:
            app.close()
        return json.loads(told.out), stored

    return replay


def seconds_of(lines):
    begin = parse_utc(lines[0]["time"])
    return begin, [(parse_utc(line["time"]).tai_ns - begin.tai_ns) * 1e-9 for line in lines]


def test_the_state_of_an_oem_goes_into_batches_without_one(replayed, lines, tmp_path):
    begin, seconds = seconds_of(lines)
    file = tmp_path / "xte.oem"
    file.write_text(oem_text(np.arange(0.0, seconds[-1] + 61.0, 10.0), start=begin))
    told, stored = replayed("--ephemeris", file)
    assert told["state_from_file"] == N - 1
    for each, line in zip(stored[:-1], lines, strict=False):
        assert np.linalg.norm(each.input["position_km"]) == pytest.approx(6_800.0, rel=1e-9)
        assert np.linalg.norm(each.input["velocity_km_per_s"]) == pytest.approx(7.656, abs=1e-3)
        assert each.input["time"] == line["time"]
    assert [stored[-1].input[name] for name in STATE] == [[7.0, 0.5, 0.25], OWN]
    # The velocity of the Earth alone was used before.
    assert not any("velocity_of_earth_alone" in json.dumps(each.answer.warnings) for each in stored)


def test_the_state_of_two_line_elements_goes_into_them_too(replayed, lines, tmp_path):
    begin, _ = seconds_of(lines)
    epoch = f"{begin.text[2:4]}{begin.day_of_year:03d}.00000000"
    file = tmp_path / "xte.tle"
    first = with_checksum(ISS[0].replace("22017.50000000", epoch))
    file.write_text(f"XTE\n{first}\n{ISS[1]}\n")
    told, stored = replayed("--ephemeris", file)
    assert told["state_from_file"] == N - 1
    speed = np.linalg.norm(stored[0].input["velocity_km_per_s"])
    assert speed == pytest.approx(7.66, abs=0.02)


def test_batches_outside_the_file_have_no_state(replayed, lines, tmp_path):
    begin, _ = seconds_of(lines)
    file = tmp_path / "xte.oem"
    later = parse_utc(f"{int(begin.text[:4]) + 1}-001T00:00:00Z")
    file.write_text(oem_text(np.arange(0.0, 601.0, 60.0), start=later))
    told, stored = replayed("--ephemeris", file)
    assert told["state_from_file"] == 0
    assert not any(name in each.input for each in stored[:-1] for name in STATE)


def test_a_file_that_is_cut_short_is_refused_before_anything_is_recorded(replayed, tmp_path):
    file = tmp_path / "cut.oem"
    file.write_text(oem_text(np.arange(0.0, 601.0, 60.0))[:-30])
    error, _ = replayed("--ephemeris", file)
    assert "cut.oem, line 24: state: must have an epoch, a position and a velocity" in error
    assert not (tmp_path / "a.db").exists()
