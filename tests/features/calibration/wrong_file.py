"""A mission of two trackers whose file is wrong, and telemetry of what is true of it."""

import json
import math
from itertools import islice
from pathlib import Path

from service.acquire import acquire
from service.missions.mission import SHIPPED_FOLDER, parse_mission
from service.observations.schema import submission_from_json
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass

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
AXES = "y_axis_body = [1.0, 0.0, 0.0]\nz_axis_body = [0.0, 1.0, 0.0]"


def mission_texts() -> dict[str, str]:
    """The file as it is assumed to be, and as it should be: SECOND turned, its field bent."""
    xte = (SHIPPED_FOLDER / "xte.toml").read_text(encoding="utf-8")
    assumed = xte.replace('name = "XTE"', 'name = "TWO"') + SECOND
    turn = math.radians(TURNED_ARCSEC / 3600.0)
    # About body Z: x of the tracker stays, y (body X) and z (body Y) turn.
    true = assumed.replace(
        AXES,
        f"y_axis_body = [{math.cos(turn)}, {math.sin(turn)}, 0.0]\n"
        f"z_axis_body = [{-math.sin(turn)}, {math.cos(turn)}, 0.0]",
    )
    assert true != assumed
    return {"assumed": assumed, "true": true + CALIBRATION}


def write_mission_files(folder: Path) -> None:
    """Both, each in a folder of its own."""
    for name, text in mission_texts().items():
        (folder / name).mkdir()
        (folder / name / "two.toml").write_text(text, "utf-8")


def with_true_file(sky, batches):
    """Of batches acquired with the true file: those without a good attitude, ambiguous stars."""
    mission = parse_mission(mission_texts()["true"], "true")
    found = [
        acquire(submission_from_json(json.dumps(each)).batch, mission, sky) for each in batches
    ]
    poor = sum(each.solution is None or each.solution.suspect for each in found)
    return poor, sum(each.counts["ambiguous"] for each in found)


def true_batches(sky, batches, seed=3):
    """Batches as the true mission measures them, as JSON."""
    mission = parse_mission(mission_texts()["true"], "true")
    wanted = Pass(batches=batches, seed=seed, angles_share=1.0, troubles=NO_TROUBLES)
    return [each.batch for each in islice(draw_pass(mission, sky, wanted), batches)]
