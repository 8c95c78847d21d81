"""Examples of a calibration: started, tried, adopted and reverted."""

import httpx

from service.missions.mission import load_missions
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.web.examples import API, Json, Walk


def send(walk: Walk) -> None:
    """Calibrate the scale of one tracker, from a run of its own."""
    client, take = walk.client, walk.take
    mission = load_missions()["XTE"]
    wanted = Pass(batches=20, troubles=NO_TROUBLES, angles_share=1.0)
    for drawn in draw_pass(mission, walk.sky, wanted):
        client.post(f"{API}/batches", json=drawn.batch | {"run": "commissioning"})
    here, signed = f"{API}/calibrations", {"who": "J. Operator"}
    asked: Json = {"spacecraft": "XTE", "run": "commissioning", "degree": 0, **signed}
    begun = client.post(here, json=asked)
    take("start_calibration", begun, "scale", asked)
    other = client.post(here, json=asked | {"trackers": ["STARTRACKER_2"]})
    take("start_calibration", other, "no_such_tracker")
    one = begun.headers["Location"]
    found = walk.ended(one)
    # A map has a hundred cells.
    shown: Json = found.json()
    shown["result"]["maps"][0]["cells"] = shown["result"]["maps"][0]["cells"][:2]
    take("get_calibration", httpx.Response(200, json=shown), "scale")
    take("list_calibrations", client.get(here), "one")
    tried: Json = {"sample": 5}
    take("try_calibration", client.post(f"{one}/trial", json=tried), "five_batches", tried)
    reason = {**signed, "note": "scale after the first pass"}
    take("adopt_calibration", client.post(f"{one}/adopt", json=reason), "first", reason)
    take("adopt_calibration", client.post(f"{one}/adopt", json=reason), "in_force_already")
    mission_file: Json = {**signed, "to": None}
    held = f"{API}/spacecraft/XTE/calibration"
    back = client.post(f"{held}/revert", json=mission_file)
    take("revert_calibration", back, "to_the_mission_file", mission_file)
    take("get_calibration_in_force", client.get(held), "the_mission_file")
