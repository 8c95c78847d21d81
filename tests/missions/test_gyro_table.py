"""The table `[gyro]` of a mission file."""

import math

import numpy as np
import pytest

from service.app.context import Context
from service.app.gyro import Gyro
from service.errors import BadBatch, BadConfiguration
from service.gyro.blocks import GyroBlockIn, block_from_model
from service.missions.mission import load_missions, parse_mission
from tests.gyro.blocks import body
from tests.missions.without_gyro import text_without_gyro

XTE = text_without_gyro("XTE")
NOISE = "sigma_v_rad_s0_5 = 3.2e-7\nsigma_u_rad_s1_5 = 3.2e-10\n"


def mission(table):
    return parse_mission(f"{XTE}\n[gyro]\n{table}", "xte.toml")


def test_a_mission_without_the_table_is_the_one_it_was():
    plain = parse_mission(XTE, "xte.toml")
    assert plain.gyro is None
    assert "gyro" not in plain.model_dump()
    assert mission(NOISE).digest != plain.digest


def test_the_missions_of_the_sample_telemetry_describe_a_gyro():
    """The frames of the fourth come without one."""
    gyros = {name: each.gyro for name, each in load_missions().items()}
    assert [name for name, gyro in gyros.items() if gyro is None] == ["IMAGER"]
    for gyro in filter(None, gyros.values()):
        assert gyro.body_from_gyro.tolist() == np.eye(3).tolist()


def test_what_the_table_leaves_out_has_the_default():
    gyro = mission(NOISE).gyro
    assert (gyro.scale, gyro.misalignment_arcsec, gyro.largest_rate_deg_per_s) == (0.0, 0.0, 10.0)
    assert gyro.body_from_gyro.tolist() == np.eye(3).tolist()


def test_axes_by_name_turn_rates_into_the_body():
    gyro = mission(f'{NOISE}axes = ["Z", "-X", "Y"]').gyro
    assert (gyro.body_from_gyro @ [1.0, 2.0, 3.0]).tolist() == [-2.0, 3.0, 1.0]


def test_axes_that_are_not_at_right_angles_are_solved_for():
    """Each rate is the part of the body's rate about its axis."""
    tilt = math.radians(54.7)
    axes = [
        [math.sin(tilt) * math.cos(turn), math.sin(tilt) * math.sin(turn), math.cos(tilt)]
        for turn in (0.0, 2.1, 4.2)
    ]
    gyro = mission(f"{NOISE}axes = {axes}").gyro
    rate_body = np.array([0.01, -0.02, 0.03])
    assert gyro.body_from_gyro @ (np.array(axes) @ rate_body) == pytest.approx(rate_body)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("sigma_v_rad_s0_5 = 1e-7", "gyro.sigma_u_rad_s1_5: is required"),
        (f'{NOISE}axes = ["X", "Y", "W"]', "gyro.axes"),
        (f'{NOISE}axes = ["X", "Y", "-X"]', "axes: the three must not lie near one plane"),
        (f"{NOISE}axes = [[1, 0, 0], [0, 2, 0], [0, 0, 1]]", "axes: each must be a unit vector"),
        (f"{NOISE}largest_rate_deg_per_s = 0", "gyro.largest_rate_deg_per_s"),
        (f"{NOISE}scale = nan", "gyro.scale"),
        (f"{NOISE}colour = 1", "gyro.colour: no such key; allowed here: axes, sigma_v_rad_s0_5"),
    ],
)
def test_a_wrong_key_is_named(table, message):
    with pytest.raises(BadConfiguration) as caught:
        mission(table)
    assert message in str(caught.value)


def test_the_largest_rate_of_the_mission_bounds_what_is_taken():
    missions = {"XTE": mission(f"{NOISE}largest_rate_deg_per_s = 0.05")}
    block = block_from_model(GyroBlockIn.model_validate(body()), "XTE")
    with pytest.raises(BadBatch, match=r"0.000872665 rad/s \(0.05 deg/s\)"):
        # It is refused before the records are looked at.
        Gyro(Context(None, missions, None, None)).record(block)
