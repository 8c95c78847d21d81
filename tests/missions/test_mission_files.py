"""Mission files say what the paper's Table 1 says; a mistake is named with its remedy."""

import math
import pickle

import numpy as np
import pytest

from service.errors import BadConfiguration, NotFound
from service.missions.mission import (
    Band,
    Cap,
    load_missions,
    mission_named,
    parse_mission,
    rules_of,
)
from tests.missions.stated_files import STATED_FOLDER
from tests.missions.without_gyro import mission_without_gyro

XTE = (STATED_FOLDER / "xte.toml").read_text(encoding="utf-8")
SOHO = (STATED_FOLDER / "soho.toml").read_text(encoding="utf-8")


def test_the_paper_s_three_missions_and_one_with_a_camera_are_shipped(missions):
    assert sorted(missions) == ["IMAGER", "SOHO", "SWAS", "XTE"]
    for name, mission in missions.items():
        assert mission.name == name
        assert mission.trackers[0].name == "STARTRACKER_1"


@pytest.mark.parametrize("name", ["XTE", "SWAS"])
def test_cap_missions_have_the_paper_s_numbers(missions, name):
    mission = missions[name]
    assert isinstance(mission.zone, Cap)
    assert mission.zone.radius_deg == 10.66
    limits = mission.tolerances
    assert (limits.pair_separation_max_deg, limits.separation_deg) == (8.0, 0.0066)
    assert (limits.magnitude_mag, limits.magnitude_order_mag) == (0.6, 0.6)
    assert limits.cross_product_deg == 90.0
    assert mission.catalog.magnitude_limit_mag == 6.5
    assert mission.trackers[0].field_of_view_radius_deg == 4.0
    assert mission.trackers[0].sigma_arcsec * math.sqrt(2.0) == pytest.approx(3.0, abs=1e-6)


def test_the_band_mission_has_the_paper_s_numbers(missions):
    mission = missions["SOHO"]
    assert isinstance(mission.zone, Band)
    assert (mission.zone.coelevation_deg, mission.zone.half_width_deg) == (90.0, 2.1)
    limits = mission.tolerances
    assert (limits.pair_separation_max_deg, limits.separation_deg) == (4.0, 0.0066)
    assert (limits.cross_product_deg, limits.pole_difference_deg) == (90.0, 0.13)
    assert limits.pole_angle_deg == 7.2
    assert mission.catalog.magnitude_limit_mag == 8.0
    assert mission.trackers[0].field_of_view_radius_deg == 2.0


@pytest.mark.parametrize("name", ["XTE", "SWAS"])
def test_a_cap_mission_s_tracker_axes_are_body_y_z_and_x(missions, name):
    alignment = missions[name].trackers[0].body_from_tracker
    assert alignment.tolist() == [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    assert missions[name].axis_body.tolist() == [1.0, 0.0, 0.0]


def test_the_band_mission_s_tracker_axes_are_the_body_s(missions):
    assert missions["SOHO"].trackers[0].body_from_tracker.tolist() == np.eye(3).tolist()
    assert missions["SOHO"].axis_body.tolist() == [1.0, 0.0, 0.0]


MISTAKES = [
    (XTE.replace("radius_deg", "radius", 1), ("zone.radius", "radius_deg")),
    (
        XTE.replace("separation_deg = 0.0066", "SEPTOL = 0.0066"),
        ("tolerances.SEPTOL", "separation_deg"),
    ),
    (XTE.replace('kind = "cap"', 'kind = "cone"'), ("zone", "cap", "band", "cone")),
    (
        XTE.replace("radius_deg = 10.66", "radius_deg = -3"),
        ("zone.radius_deg", "above 0, such as 10.66", "-3"),
    ),
    (
        XTE.replace("magnitude_limit_mag = 6.5", 'magnitude_limit_mag = "faint"'),
        ("catalog.magnitude_limit_mag", "number", "faint"),
    ),
    (
        XTE.replace("magnitude_limit_mag = 6.5", "magnitude_limit_mag = nan"),
        ("catalog.magnitude_limit_mag", "finite"),
    ),
    (
        XTE.replace('solver = "quest"', 'solver = "kalman"'),
        ("solver", "'quest' or 'triad'", "kalman"),
    ),
    (XTE.replace("z_axis_body = [1.0", "z_axis_body = [-1.0"), ("trackers.0", "right-handed")),
    (XTE.replace("z_axis_body = [1.0", "z_axis_body = [2.0"), ("trackers.0", "unit vector")),
    (
        XTE.replace("z_axis_body = [1.0, 0.0, 0.0]\n", "").replace("y_axis_body", "# y"),
        ("trackers.0.z_axis_body: is required, such as [0.0, 0.0, 1.0]",),
    ),
    (
        XTE + XTE[XTE.index("[[trackers]]") :].partition("\n[gyro]")[0],
        ("trackers: each needs a name of its own; several are STARTRACKER_1",),
    ),
    (
        XTE.replace("z_axis_body = [1.0, 0.0, 0.0]", "z_axis_body = [1.0, 0.0]"),
        ("trackers.0.z_axis_body: must have 3 entries, not 2, such as",),
    ),
    (
        XTE.replace("\nsigma_arcsec =", "\nsigma ="),
        ("sigma: no such key; did you mean sigma_arcsec?",),
    ),
    (
        XTE.replace("axis_body = [1.0, 0.0, 0.0]      #", "axis_body = [0.0, 0.0, 0.0] #"),
        ("zone.axis_body: has no direction: give a unit vector",),
    ),
    (
        SOHO.replace("half_width_deg = 2.1", "half_width_deg = 120"),
        ("zone.half_width_deg", "90", "120"),
    ),
    (
        XTE.replace("pole = false", "pole = true"),
        ("tests", "a cap has no pole", "false is allowed"),
    ),
    (XTE + "\n[products]\nlargest_gap_s = 0\n", ("products.largest_gap_s", "above 0")),
    (XTE + '\n[products]\nobject_id = "1995\\n074A"\n', ("products.object_id", "text of the form")),
    (XTE + "\n[products]\nnaif_id = 95\n", ("products.naif_id", "below 0", "95")),
    (XTE + "\n[products]\ngap_s = 10\n", ("products.gap_s: no such key; allowed here: largest",)),
    (XTE + '\n[products]\nsclk_kernel = "x.tsc"\n', ("products", "needs naif_id")),
    (XTE + "\n[surprise]\nx = 1\n", ("surprise", "trackers")),
    ("name = ", ("not TOML",)),
    ("", ("name", "required")),
]


@pytest.mark.parametrize(("text", "words"), MISTAKES)
def test_a_mistake_names_the_file_the_key_and_what_is_allowed(text, words):
    with pytest.raises(BadConfiguration) as refusal:
        parse_mission(text, "site/hubble.toml")
    for word in ("site/hubble.toml", *words):
        assert word in str(refusal.value)


def test_several_mistakes_are_told_at_once():
    text = XTE.replace("radius_deg = 10.66", "radius_deg = -3").replace('"quest"', '"kalman"')
    with pytest.raises(BadConfiguration) as refusal:
        parse_mission(text, "x.toml")
    assert "zone.radius_deg" in str(refusal.value)
    assert "solver" in str(refusal.value)


def test_a_site_s_folder_adds_missions_and_replaces_shipped_ones(tmp_path):
    (tmp_path / "hubble.toml").write_text(XTE.replace('name = "XTE"', 'name = "HUBBLE"'))
    (tmp_path / "xte.toml").write_text(XTE.replace("radius_deg = 10.66", "radius_deg = 12"))
    missions = load_missions(tmp_path)
    assert sorted(missions) == ["HUBBLE", "IMAGER", "SOHO", "SWAS", "XTE"]
    assert missions["XTE"].zone.radius_deg == 12


def test_two_files_of_one_name_are_refused_with_both(tmp_path):
    for file in ("one.toml", "two.toml"):
        (tmp_path / file).write_text(XTE)
    with pytest.raises(BadConfiguration, match=r"two\.toml.*XTE.*one\.toml"):
        load_missions(tmp_path)


def test_a_folder_that_is_not_there_and_a_file_that_is_no_text_are_refused(tmp_path):
    with pytest.raises(BadConfiguration, match="no such folder"):
        load_missions(tmp_path / "nowhere")
    (tmp_path / "x.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BadConfiguration, match=r"x\.toml: cannot be read"):
        load_missions(tmp_path)


def test_the_digest_is_of_the_settings_and_not_of_their_layout(missions):
    laid_out_otherwise = parse_mission(XTE.replace("\n\n", "\n# a comment\n\n"), "x.toml")
    assert laid_out_otherwise.digest == missions["XTE"].digest
    assert parse_mission(XTE.replace("10.66", "10.67"), "x.toml").digest != missions["XTE"].digest
    assert missions["XTE"].digest.startswith("sha256:")


def test_an_unknown_spacecraft_is_named_with_those_there_are(missions):
    assert mission_named(missions, "XTE") is missions["XTE"]
    with pytest.raises(NotFound, match="IMAGER, SOHO, SWAS, XTE"):
        mission_named(missions, "VOYAGER")


@pytest.mark.parametrize(
    ("julian_year", "step", "epoch"),
    [(1996.02, 1.0, 1996.0), (1996.6, 1.0, 1997.0), (1996.3, 0.5, 1996.5), (2026.4, 5.0, 2025.0)],
)
def test_a_batch_s_epoch_is_its_time_rounded_to_the_mission_s_step(
    missions, julian_year, step, epoch
):
    settings = missions["XTE"].catalog.model_copy(update={"epoch_step_years": step})
    assert settings.epoch_of(julian_year) == epoch


def test_without_a_word_on_tests_the_paper_s_three_are_on_and_the_pole_s_in_bands_alone():
    def without_tests(text):
        return text[: text.index("[tests]")] + text[text.index("[catalog]") :]

    for text, pole in ((XTE, False), (SOHO, True)):
        tests = parse_mission(without_tests(text), "x.toml").tests
        assert (tests.magnitude, tests.cross_product, tests.pole) == (True, True, pole)
        assert (tests.fov_rotation, tests.match_groups) == (False, False)


def test_a_changed_copy_keeps_nothing_that_was_worked_out_from_the_old_values(missions):
    mission = missions["XTE"]
    for old in (mission, mission.model_copy()):
        assert old.rules.limits.magnitude == 0.6
        tolerances = old.tolerances.model_copy(update={"magnitude_mag": 0.9})
        changed = old.model_copy(update={"tolerances": tolerances})
        assert changed.rules.limits.magnitude == 0.9
        assert changed.digest != old.digest
        assert changed.model_copy(update={"tolerances": old.tolerances}).digest == old.digest


def test_in_another_process_a_mission_s_arrays_are_locked_as_they_are_here(missions):
    """Kernels are compiled anew for arrays that can be written, in the way of a batch."""
    here = missions["XTE"]
    assert not here.axis_body.flags.writeable
    assert not here.trackers[0].body_from_tracker.flags.writeable
    there = pickle.loads(pickle.dumps(here))
    assert there == here
    assert there.digest == here.digest
    assert not there.axis_body.flags.writeable
    assert not there.trackers[0].body_from_tracker.flags.writeable


def test_rules_hold_every_tolerance_and_test_as_the_kernels_read_them(missions):
    tolerances, tests = missions["SOHO"].tolerances, missions["SOHO"].tests
    names = list(type(tolerances).model_fields)[1:]
    for place, name in enumerate(names):
        other = tolerances.model_copy(update={name: getattr(tolerances, name) + 1.0})
        apart = np.subtract(rules_of(other, tests).limits, missions["SOHO"].rules.limits)
        assert np.flatnonzero(apart).tolist() == [place]
        assert apart[place] == pytest.approx(math.radians(1.0) if "deg" in name else 1.0)
    for place, name in enumerate(list(type(tests).model_fields)[:4]):
        other = tests.model_copy(update={name: not getattr(tests, name)})
        apart = np.not_equal(rules_of(tolerances, other).switches, missions["SOHO"].rules.switches)
        assert np.flatnonzero(apart).tolist() == [place]


CLOCK = "KPL/SCLK\n\\begindata\nSCLK_DATA_TYPE_95 = ( 1 )\n"
PRODUCTS = """
[products]
largest_gap_s = 10.0
object_id = "1995-074A"
naif_id = -95
sclk_kernel = "clocks/xte.tsc"
"""


def test_a_mission_without_products_is_what_it_was_before_it_could_have_them(missions):
    """The digest was printed by the version before the table `[products]`, without a gyro."""
    assert mission_without_gyro("XTE").digest == (
        "sha256:1a499a850b01d14896a3cbb4a999e8c7c4fc00f57655296d0228dc9e6e019ca3"
    )
    assert "products" not in missions["XTE"].model_dump_json()
    assert parse_mission(XTE + "\n[products]\n", "x.toml").digest == missions["XTE"].digest
    own = missions["XTE"].products
    assert (own.largest_gap_s, own.object_id, own.naif_id) == (60.0, None, -999)
    assert own.sclk_kernel is None


def test_a_mission_names_its_identifiers_and_a_clock_beside_its_file(tmp_path, missions):
    (tmp_path / "clocks").mkdir()
    (tmp_path / "clocks" / "xte.tsc").write_text(CLOCK)
    (tmp_path / "xte.toml").write_text(XTE + PRODUCTS)
    mission = load_missions(tmp_path)["XTE"]
    own = mission.products
    assert (own.largest_gap_s, own.object_id, own.naif_id) == (10.0, "1995-074A", -95)
    assert own.sclk_kernel == tmp_path / "clocks" / "xte.tsc"
    assert mission.digest != missions["XTE"].digest
    assert str(tmp_path) not in mission.model_dump_json()


@pytest.mark.parametrize(
    ("clock", "words"),
    [
        (None, "xte.tsc: cannot be read: No such file"),
        (CLOCK.replace("_95", "_96"), "no clock of -95: it has no SCLK_DATA_TYPE_95"),
        (CLOCK.replace("_95", "_950"), "no clock of -95: it has no SCLK_DATA_TYPE_95"),
        ("DAF/CK", "must begin with KPL/SCLK"),
    ],
)
def test_a_clock_that_is_not_the_spacecraft_s_is_refused_by_file(tmp_path, clock, words):
    (tmp_path / "clocks").mkdir()
    if clock is not None:
        (tmp_path / "clocks" / "xte.tsc").write_text(clock)
    (tmp_path / "xte.toml").write_text(XTE + PRODUCTS)
    with pytest.raises(BadConfiguration) as refusal:
        load_missions(tmp_path)
    assert f"{tmp_path / 'xte.toml'}: products" in str(refusal.value)
    assert words in str(refusal.value)
