"""Examples of frames and pictures: some that are solved, and some that are refused."""

import json
from typing import Any

from service.features.pictures.tracker.simulated import FrameSettings, draw_frames, frame_bytes
from service.missions.mission import load_missions
from service.web.examples import API, Walk


def send(walk: Walk) -> None:
    """Send a frame of a tracker, also as a picture of a camera, whole and cut off."""
    client, take = walk.client, walk.take
    (drawn,) = draw_frames(load_missions()["IMAGER"], walk.sky, FrameSettings(frames=1))
    known = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in drawn.known.items()
    }
    file = frame_bytes(drawn)

    def submit(name: str, content: bytes, spacecraft: str = "IMAGER", **changed: Any) -> None:
        url, headers = f"{API}/spacecraft/{spacecraft}/frames", {"Content-Type": "application/fits"}
        answer = client.post(url, params=known | changed, content=content, headers=headers)
        take("submit_frame", answer, name)

    submit("attitude", file)
    submit("cut_off", file[:5760], batch="cut-off")
    submit("no_camera", file, "XTE")
    octets = {"Content-Type": "application/octet-stream"}
    solve = f"{API}/pictures?spacecraft=IMAGER"
    solved = client.post(solve, content=file, headers=octets)
    del take("solve_picture", solved, "found")["stars"][2:]
    take("solve_picture", client.post(solve, content=file[:5760], headers=octets), "cut_off")
