"""`acquire mission new` and the commands that take a mission's file in place of its name."""

import json
from pathlib import Path

import pytest

from service.cli import main
from service.missions.mission import load_missions, parse_mission, read_mission
from service.vectors import angle_between_deg, matrix_from_quaternion

CUBE = ("--field", "8x8", "--sigma", "5", "--limit", "6.5", "--a-priori-error", "0.5")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(capsys, *arguments):
    assert main(["mission", "new", *arguments]) == 0
    return capsys.readouterr().out


def test_flags_give_a_mission_of_ten_lines(capsys):
    text = written(capsys, "MYCUBE", *CUBE)
    assert len(text.splitlines()) <= 10
    tracker = parse_mission(text, "x.toml").trackers[0]
    assert (tracker.field_of_view_deg, tracker.sigma_arcsec, tracker.limit_mag) == ((8, 8), 5, 6.5)


def test_each_boresight_gets_a_tracker_with_right_handed_axes(capsys):
    boresights = ("--boresight", "z", "--boresight=-x", "--boresight", "0.6,0,0.8")
    mission = parse_mission(written(capsys, "TRIO", *CUBE, *boresights), "x.toml")
    axes = [each.z_axis_body for each in mission.trackers]
    assert axes == [(0, 0, 1), (-1, 0, 0), (0.6, 0, 0.8)]


def test_a_sun_axis_gives_a_band_and_nothing_known_a_search_of_the_whole_sky(capsys):
    known = ("--field", "4", "--sigma", "3", "--limit", "7")
    sunny = parse_mission(written(capsys, "SUNNY", *known, "--sun-axis", "x"), "x.toml")
    assert sunny.zone.kind == "band"
    assert parse_mission(written(capsys, "LOST", *known), "x.toml").identifier == "lost_in_space"


def test_questions_are_asked_on_a_terminal_with_an_example_each(capsys, monkeypatch):
    class Terminal:
        answers = iter(["ASKED\n", "8x8\n", "5\n", "6.5\n", "-y\n", "0.5\n", "\n"])

        def isatty(self):
            return True

        def readline(self):
            return next(self.answers)

    monkeypatch.setattr("sys.stdin", Terminal())
    assert main(["mission", "new"]) == 0
    out, err = capsys.readouterr()
    assert parse_mission(out, "x.toml").trackers[0].z_axis_body == (0, -1, 0)
    assert err.count("such as") >= 6


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "NAME: is required, such as MYCUBE"),
        (("A", "--field", "8x8", "--limit", "6"), "--sigma: is required, such as 5"),
        (("A", "--field", "8by8", "--sigma", "5", "--limit", "6"), "--field: must be 8x8"),
        (("A", *CUBE, "--boresight", "up"), "--boresight: must be x, -x, y"),
    ],
)
def test_an_option_that_is_missing_or_wrong_is_named_with_an_example(arguments, words, capsys):
    assert main(["mission", "new", *arguments]) == 2
    assert words in capsys.readouterr().err


def test_missions_here_are_found_by_name_and_a_file_stands_for_its_spacecraft(folder, capsys):
    text = written(capsys, "MYCUBE", *CUBE)
    (folder / "missions").mkdir()
    (folder / "missions" / "mycube.toml").write_text(text)
    (folder / "apart.toml").write_text(text.replace("MYCUBE", "APART"))
    for name in ("MYCUBE", "apart.toml"):
        command = ["simulate", "telemetry", "--spacecraft", name, "--batches", "12", "--nominal"]
        assert main([*command, "pass.ndjson"]) == 0
        out, err = capsys.readouterr()
        assert "a priori error up to 0.5 deg about each axis, noise 5 arcsec" in out
        assert err == ""
    assert main(["mission", "show", "mycub"]) == 2
    err = capsys.readouterr().err
    for words in ("no spacecraft 'mycub'", "did you mean MYCUBE?", "./missions/*.toml", "not set"):
        assert words in err


def test_shipped_missions_are_hidden_where_that_is_asked_for(folder, capsys, monkeypatch):
    monkeypatch.setenv("ACQUIRE_SHIPPED_MISSIONS", "off")
    assert main(["mission", "show", "XTE"]) == 2
    assert "there are none" in capsys.readouterr().err
    assert load_missions(shipped=False) == {}


def test_the_simulator_draws_the_errors_of_the_mission_and_warns_beyond_its_zone(folder, capsys):
    (folder / "my.toml").write_text(written(capsys, "MYCUBE", *CUBE))
    command = ["simulate", "telemetry", "--spacecraft", "my.toml", "--batches", "40", "--nominal"]
    mission = read_mission(Path("my.toml"))
    for error_deg in (0.5, 3.0):
        assert main([*command, "--a-priori-error", str(error_deg), "pass.ndjson"]) == 0
        err = capsys.readouterr().err
        batches = [json.loads(line) for line in Path("pass.ndjson").read_text().splitlines()]
        truths = [json.loads(line) for line in Path("pass.truth.ndjson").read_text().splitlines()]
        beyond = 0
        for batch, truth in zip(batches, truths, strict=True):
            axes = [
                matrix_from_quaternion(each)[2]
                for each in (batch["a_priori"]["quaternion"], truth["quaternion"])
            ]
            off_deg = angle_between_deg(*axes)
            assert off_deg <= error_deg * 2**0.5 + 1e-6
            beyond += (
                off_deg + mission.trackers[0].field_of_view_radius_deg > mission.zone.radius_deg
            )
        assert (f"in {100 * beyond / 40:.1f} % of the batches" in err) == (beyond > 0)
    assert beyond > 0


def test_the_check_says_in_sentences_what_the_mission_can_expect(folder, capsys):
    (folder / "my.toml").write_text(written(capsys, "MYCUBE", *CUBE))
    assert main(["mission", "check", "my.toml", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["expected"]
    assert {each["sky"] for each in found} == {"clear", "dense"}
    for each in found:
        stars = each["stars"]
        assert stars["unique"] + stars["ambiguous"] + stars["unmatched"] == stars["observed"] > 0
        assert stars["unique"] > 0.9 * stars["observed"]
        assert stars["wrong"] == 0
