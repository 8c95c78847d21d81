"""A mission of ten lines: what it leaves out follows from what it states, by shown rules."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from service.cli import main
from service.errors import BadConfiguration
from service.missions.defaults import RULES, TRACKER_RULES
from service.missions.mission import SHIPPED_FOLDER, parse_mission, read_mission
from service.simulate.sightings import in_field
from service.vectors import from_ra_dec, rotate_about, separation_deg
from tests.missions.stated_files import STATED_FOLDER, toml_text

DOCUMENT = Path(__file__).parents[2] / "docs" / "missions.md"
TEN_LINES = DOCUMENT.read_text(encoding="utf-8").split("```toml\n")[1].partition("```")[0]
TRACKER = """
[[trackers]]
field_of_view_radius_deg = 4
sigma_arcsec = 5
limit_mag = 6.5
"""


def changed(old, new):
    assert old in TEN_LINES
    return parse_mission(TEN_LINES.replace(old, new), "mine.toml")


def test_the_mission_of_ten_lines_in_the_document_is_whole():
    assert len([line for line in TEN_LINES.splitlines() if line.strip()]) <= 10
    mission = parse_mission(TEN_LINES, "mine.toml")
    assert mission.zone.kind == "cap"
    assert mission.identifier == "verified"
    assert mission.catalog.magnitude_limit_mag == 6.5


def test_six_values_are_required_and_every_other_has_a_default():
    """Four, where the tracker stands along the body's own axes: one axis alone is refused."""
    table = tomllib.loads(TEN_LINES)
    tracker = table["trackers"][0]
    required = set()
    for held in (table, tracker):
        for key in [*held]:
            value = held.pop(key)
            try:
                parse_mission(toml_text(table), "mine.toml")
            except BadConfiguration:
                required.add(key)
            held[key] = value
    assert required - {"trackers"} == {
        *("name", "field_of_view_deg", "sigma_arcsec", "limit_mag"),
        *("x_axis_body", "z_axis_body"),
    }
    for key in ("x_axis_body", "z_axis_body"):
        del tracker[key]
    del table["a_priori_error_deg"]
    assert parse_mission(toml_text(table), "mine.toml").identifier == "lost_in_space"


@pytest.mark.parametrize("name", ["xte", "swas", "soho", "imager"])
def test_a_shipped_file_means_what_it_meant_while_it_stated_every_value(name):
    """`stated` holds the files of the version before; the digest is of every value."""
    before = read_mission(STATED_FOLDER / f"{name}.toml")
    now = read_mission(SHIPPED_FOLDER / f"{name}.toml")
    assert now.digest == before.digest
    assert now.model_dump() == before.model_dump()
    stated, short = (
        len((folder / f"{name}.toml").read_text().splitlines())
        for folder in (STATED_FOLDER, SHIPPED_FOLDER)
    )
    assert short < stated


def test_the_zone_holds_the_field_for_every_error_that_the_file_allows(seed):
    """Errors about the three axes together, of boresights along and between the body axes."""
    rng = np.random.default_rng(seed)
    for x_axis, z_axis in (
        ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
        ([0.7071068, -0.7071068, 0.0], [0.5773503, 0.5773503, 0.5773503]),
    ):
        mission = changed(
            "x_axis_body = [1.0, 0.0, 0.0]   # the tracker's axes in body components\n"
            "z_axis_body = [0.0, 0.0, 1.0]",
            f"x_axis_body = {x_axis}\nz_axis_body = {z_axis}",
        )
        tracker = mission.trackers[0]
        errors_rad = np.radians(rng.choice((-0.5, 0.5), (200, 3)))
        shifted_deg = [
            separation_deg(tracker.boresight_body, rotate_about(each, tracker.boresight_body))
            for each in errors_rad
        ]
        room_deg = mission.zone.radius_deg - tracker.field_of_view_radius_deg
        assert max(shifted_deg) < room_deg < max(shifted_deg) + 0.15


def test_a_square_field_reaches_to_its_corner_and_no_farther():
    tracker = changed("[8.0, 8.0]", "[8.0, 8.0]").trackers[0]
    corner = np.array([np.tan(np.radians(4.0)), np.tan(np.radians(4.0)), 1.0])
    corner_deg = np.degrees(np.arccos(1.0 / np.linalg.norm(corner)))
    assert corner_deg <= tracker.field_of_view_radius_deg < corner_deg + 0.002
    places = from_ra_dec([0.0, 45.0, 0.0, 90.0], [86.1, 84.5, 85.9, 84.5])
    assert in_field(tracker, places).tolist() == [True, True, False, False]


def test_a_sun_pointed_mission_has_a_band_about_the_sun():
    text = 'name = "SUNNY"\nsun_pointed_axis_body = [1, 0, 0]\n' + TRACKER
    mission = parse_mission(text, "sunny.toml")
    assert (mission.zone.kind, mission.zone.coelevation_deg) == ("band", 90.0)
    assert mission.zone.half_width_deg == 4.2
    assert mission.tests.pole
    second = TRACKER + "x_axis_body = [0, 1, 0]\nz_axis_body = [0.5, 0, 0.8660254]\n"
    two = parse_mission(text + second, "sunny.toml")
    assert two.trackers[1].coelevation_deg == pytest.approx(60.0)


def test_a_mission_that_knows_nothing_is_lost_in_space():
    mission = parse_mission('name = "LOST"\n' + TRACKER, "lost.toml")
    assert mission.identifier == "lost_in_space"
    assert not mission.knows_attitude


def test_a_camera_of_three_numbers_gives_the_field():
    text = 'name = "CAM"\na_priori_error_deg = 1\n[[trackers]]\nsigma_arcsec = 9\nlimit_mag = 6\n'
    camera = "[trackers.camera]\nwidth_px = 1000\nheight_px = 800\nfocal_length_px = 4000\n"
    tracker = parse_mission(text + camera, "cam.toml").trackers[0]
    assert tracker.camera is not None
    expected = 2.0 * np.degrees(np.arctan([500 / 4000, 400 / 4000]))
    assert tracker.field_of_view_deg == pytest.approx(expected, abs=1e-3)
    assert tracker.field_of_view_radius_deg == pytest.approx(
        tracker.camera.corner_radius_deg, abs=2e-3
    )
    angles = camera.replace("focal_length_px = 4000\n", "")
    by_field = parse_mission(
        text + f"field_of_view_deg = [{expected[0]}, {expected[1]}]\n" + angles, "cam.toml"
    )
    assert by_field.trackers[0].camera.focal_length_px == pytest.approx(4000, abs=1e-2)


def test_the_document_has_the_rules_of_the_program():
    document = DOCUMENT.read_text(encoding="utf-8")
    for rule in RULES:
        assert f"| `{rule.key}` | {rule.says} |\n" in document
    for key, says in TRACKER_RULES.items():
        assert f"| `trackers.{key}` | {says} |\n" in document


@pytest.mark.parametrize("name", ["XTE", "SOHO", "IMAGER", "mine.toml"])
def test_a_whole_mission_is_shown_with_origins_and_reads_back_as_the_same(
    name, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(TEN_LINES, encoding="utf-8")
    assert main(["mission", "show", name]) == 0
    shown = capsys.readouterr().out
    file = Path(name) if name.endswith(".toml") else SHIPPED_FOLDER / f"{name.lower()}.toml"
    mission = read_mission(file)
    assert parse_mission(shown, "shown.toml").digest == mission.digest
    origins = [line.rpartition("  # ")[2] for line in shown.splitlines() if " = " in line]
    assert all(
        each == "given" or each == "default" or each.startswith("derived: ") for each in origins
    )
    given = tomllib.loads(file.read_text(encoding="utf-8"))
    assert origins.count("given") == count_of(given)


def count_of(table):
    if isinstance(table, dict):
        return sum(map(count_of, table.values()))
    if isinstance(table, list) and table and isinstance(table[0], dict):
        return sum(map(count_of, table))
    return 1


def test_a_value_from_which_others_follow_is_the_only_one_named_where_it_is_wrong():
    with pytest.raises(BadConfiguration) as refusal:
        changed("sigma_arcsec = 5.0", "sigma_arcsec = 'fine'")
    assert len(str(refusal.value).splitlines()) == 1
    assert "trackers.0.sigma_arcsec" in str(refusal.value)
