"""Every page of the console as a picture: `python -m benchmarks.screenshots`.

A service of its own is filled with a day of every mission that is watched for alarms; a
browser then looks at every page, wide and narrow, light and dark.  The
pictures go to docs/images, where docs/operators.md shows some of them.
"""

import argparse
import io
import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import httpx
from PIL import Image
from tqdm import tqdm

from service.app.factory import App, open_app
from service.features.definitive.part import Definitive
from service.features.pictures.tracker.simulated import FrameSettings, draw_frames, frame_bytes
from service.missions.mission import load_missions
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import GyroWanted, draw_pass, with_gyro
from service.web.app import create_app
from tests.web.browser import CHROMIUM, Browser, chromium
from tests.web.serving import Server

FOLDER = Path(__file__).parents[1] / "docs" / "images"
PICTURE = Path(__file__).parents[1] / "tests" / "features" / "pictures" / "cedarsolve-pleiades.jpg"
RUN = "sample-pass"
BATCHES = 288
START = "1999-03-01T00:00:00.000Z"
CADENCE_S = 300.0
"""Seconds between batches: 288 batches are a day, the period that pages show first."""
GYRO = GyroWanted(step_s=10.0)
DAY = "start=1999-060T00:00:00Z&end=1999-061T00:00:00Z"
NOTES = (
    (
        "XTE",
        "1999-060T06:50:00Z",
        "1999-060T09:10:00Z",
        "A priori attitude drifts: gyro bias upload",
    ),
    ("XTE", "1999-060T15:20:00Z", None, "Particles seen by the tracker since dawn"),
    (None, "1999-060T21:00:00Z", "1999-060T21:20:00Z", "Ground station changes; a gap is expected"),
)
SIZES = {"wide": 1440, "narrow": 400}
TALLEST = {"wide": 1350, "narrow": 1100}
"""Greatest height of a screenshot in pixels; the rest of a long page is similar."""
QUALITY = 50
PATIENCE_S = 600.0


def main() -> int:
    """Record data in a service, open every page, and write the screenshots."""
    parser = argparse.ArgumentParser(
        prog="benchmarks.screenshots",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where the pictures go")
    parser.add_argument("--only", help="pages by name, with commas between, e.g. batch,alarms")
    asked = parser.parse_args()
    if CHROMIUM is None:
        parser.error("there is no chromium on this machine")
    with tempfile.TemporaryDirectory() as folder:
        app = open_app(Settings(database=f"sqlite:///{folder}/acquire.db"))
        with Server(create_app(app)) as address:
            pages = filled(address, app)
            if asked.only:
                pages = {name: pages[name] for name in asked.only.split(",")}
            asked.folder.mkdir(parents=True, exist_ok=True)
            with chromium(Path(folder) / "profile") as devtools, Browser(devtools) as browser:
                total = look(browser, address, pages, asked.folder)
    print(f"{total / 1e6:.2f} MB in {asked.folder}")
    return 0


def filled(address: str, app: App) -> Mapping[str, str]:
    """Replay a pass of every mission and act on its alarms; returns the addresses of pages."""
    with httpx.Client(base_url=address, timeout=PATIENCE_S) as client:
        while client.get("/readyz").status_code != 200:
            time.sleep(0.2)
        for name, mission in load_missions().items():
            wanted = Pass(batches=BATCHES, seed=1, start=START, cadence_s=CADENCE_S)
            drawn = list(draw_pass(mission, app.sky, wanted))
            if mission.gyro is not None:
                length_s = CADENCE_S * (BATCHES - 1)
                drawn = list(with_gyro(drawn, mission, GYRO, length_s, wanted.seed))
            replay(client, [line for each in drawn for line in (each.batch, *each.gyro)])
            if name == "XTE":
                by_votes = {"options": {"identifier": "starid"}}
                sent = [each.batch | by_votes for each in drawn]
                replay(client, sent, f"{RUN}-votes")
        # What `acquire smooth` does where no service runs.
        app.part(Definitive).days.smooth("XTE", run=RUN)
        alarms = client.get("/api/v1/alarms", params={"run": RUN, "state": "all"}).json()["items"]
        signed = {"who": "J. Operator", "comment": "a priori attitude drifts; slew at 08:00"}
        xte = [each for each in alarms if each["spacecraft"] == "XTE"]
        client.post(f"/api/v1/alarms/{xte[-1]['id']}/acknowledge", json=signed).raise_for_status()
        shelved = signed | {"comment": "known, until the upload", "minutes": 120}
        client.post(f"/api/v1/alarms/{alarms[0]['id']}/shelve", json=shelved).raise_for_status()
        for spacecraft, start, end, text in NOTES:
            note = {"start": start, "end": end, "text": text, "who": "J. Operator"}
            client.post("/api/v1/annotations", json=note | {"spacecraft": spacecraft})
        batch = looked_into(client)
        frame = taken(client, app)
        calibrate(client)
        replays = client.get("/api/v1/replays").json()["items"]
    run = f"run={RUN}"
    tried = "identifier=starid&tolerances.separation_deg=0.012"
    return {
        "overview": f"/?{run}",
        "spacecraft": f"/spacecraft/XTE?{run}&{DAY}",
        "period": f"/spacecraft/XTE/period?{run}&{DAY}",
        "batch": f"/batches/{batch}",
        "what-if": f"/batches/{batch}?{tried}",
        "frame": f"/batches/{frame}#frame",
        "pictures": "/pictures",
        "batches": f"/batches?{run}&outcome=ambiguous",
        "compare": f"/compare?{run}",
        "alarms": f"/alarms?{run}&state=all",
        "alarm": f"/alarms/{xte[-1]['id']}",
        "annotations": f"/annotations?{run}",
        "limits": f"/spacecraft/XTE/limits?{run}",
        "runs": f"/runs?{run}",
        "replay": f"/replays/{replays[0]['id']}?{run}",
        "missions": f"/missions?{run}",
        "advice": f"/advice/XTE?{run}&sample=60",
        "grades": f"/spacecraft/XTE/grades?{run}&{DAY}",
        "calibration": f"/spacecraft/XTE/calibration?{run}",
        "about": f"/about?{run}",
        "sign-in": "/sign-in",
    }


def looked_into(client: httpx.Client) -> str:
    """Id of a solved XTE batch with a star that is not in the catalog."""
    asked = {"run": RUN, "spacecraft": "XTE", "outcome": "unmatched", "status": "good"}
    found = client.get("/api/v1/batches", params=asked).json()["items"]
    return str(max(found, key=lambda each: (each["counts"]["unique"], each["id"]))["id"])


def taken(client: httpx.Client, app: App) -> str:
    """Id of a batch made from a frame."""
    (drawn,) = draw_frames(load_missions()["IMAGER"], app.sky, FrameSettings(frames=1, seed=5))
    query = {k: v if isinstance(v, str) else json.dumps(v) for k, v in drawn.known.items()}
    answer = client.post(
        "/api/v1/spacecraft/IMAGER/frames",
        params=query | {"run": "frames"},
        content=frame_bytes(drawn),
        headers={"Content-Type": "application/fits"},
    )
    return str(answer.raise_for_status().json()["id"])


def calibrate(client: httpx.Client) -> None:
    """Calibrate the tracker of XTE from its sample pass."""
    asked = {"spacecraft": "XTE", "run": RUN, "who": "J. Operator"}
    answer = client.post("/api/v1/calibrations", json=asked).raise_for_status()
    wait_while(client, answer.headers["Location"], ("queued", "running"))


def replay(client: httpx.Client, lines: Sequence[Mapping[str, Any]], run: str = RUN) -> None:
    """Replay a file of batches, and wait until the last one is recorded."""
    answer = client.post(
        "/api/v1/replays",
        params={"run": run, "alarms": run == RUN},
        content=b"\n".join(json.dumps(each).encode() for each in lines),
        headers={"Content-Type": "application/x-ndjson"},
    )
    answer.raise_for_status()
    wait_while(client, answer.headers["Location"], ("running",))


def wait_while(client: httpx.Client, place: str, states: Sequence[str]) -> None:
    """Wait until a replay or calibration has left the given states."""
    end = time.monotonic() + PATIENCE_S
    while client.get(place).json()["state"] in states:
        if time.monotonic() > end:
            raise TimeoutError(f"{place} does not end")
        time.sleep(0.1)


def look(browser: Browser, address: str, pages: Mapping[str, str], folder: Path) -> int:
    """Take all screenshots; returns the number of bytes written."""
    total = 0
    views = [(page, size, dark) for page in pages for size in SIZES for dark in (False, True)]
    for page, size, dark in tqdm(views, desc="pictures", unit="picture"):
        browser.open(address + pages[page], width=SIZES[size], height=900, dark=dark)
        browser.wait(lambda: browser.run(SETTLED))
        if page == "pictures":
            solve(browser)
        top = browser.run(TOP)
        height = min(browser.run("document.documentElement.scrollHeight") - top, TALLEST[size])
        picture = browser.picture(SIZES[size], height, top)
        file = folder / f"{page}-{size}-{'dark' if dark else 'light'}.webp"
        with Image.open(io.BytesIO(picture)) as image:
            image.convert("RGB").save(file, "WEBP", quality=QUALITY, method=6)
        total += file.stat().st_size
    return total


def solve(browser: Browser) -> None:
    """Select a picture on the page of pictures, and wait for its stars."""
    root = browser.call("DOM.getDocument")["root"]["nodeId"]
    node = browser.call("DOM.querySelector", nodeId=root, selector="#file")["nodeId"]
    browser.call("DOM.setFileInputFiles", nodeId=node, files=[str(PICTURE)])
    browser.run("document.querySelector('#picture button.main').click()")
    browser.wait(lambda: browser.run("document.getElementById('drawn').naturalWidth"), PATIENCE_S)


TOP = """location.hash ? Math.round(
    document.querySelector(location.hash).closest("section").getBoundingClientRect().top + scrollY
) : 0"""
"""Script for the top of a screenshot: the section that the address names."""
SETTLED = """(() => {
  const charts = document.getElementById("charts");
  const connection = document.getElementById("connection");
  const told = connection === null || connection.dataset.state !== "idle";
  const drawn = [...document.images].every((each) => each.complete);
  return told && drawn && (charts === null || charts.dataset.drawn !== undefined);
})()"""


if __name__ == "__main__":
    raise SystemExit(main())
