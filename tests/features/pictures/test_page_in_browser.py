"""The page of pictures in a real browser: solved, refused, without stars, and recorded if asked."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from service.features.pictures.tracker.simulated import FrameSettings, draw_frames, frame_bytes
from service.missions.mission import load_missions
from tests.features.pictures.test_over_http import PLEIADES
from tests.web.browser import CHROMIUM
from tests.web.fitting import faults

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")

STATUS = "document.getElementById('picture-status').textContent"


def choose(browser, file):
    """Choose a file as the dialog of the browser does."""
    root = browser.call("DOM.getDocument")["root"]["nodeId"]
    node = browser.call("DOM.querySelector", nodeId=root, selector="#file")["nodeId"]
    browser.call("DOM.setFileInputFiles", nodeId=node, files=[str(file)])


def solve(browser):
    browser.run("document.querySelector('#picture button.main').click()")
    browser.wait(lambda: "points of light" in browser.run(STATUS), 120.0)


@pytest.mark.parametrize(("width", "dark"), [(1440, False), (400, True)])
def test_a_picture_is_shown_with_its_stars_and_its_lens_and_not_recorded(
    browser, address, client, width, dark
):
    before = client.get("/api/v1/batches?run=*&limit=1").json()
    browser.open(f"{address}/pictures", width, 900, dark)
    choose(browser, PLEIADES)
    solve(browser)
    browser.wait(lambda: browser.run("document.getElementById('drawn').naturalWidth") >= 800)
    page = browser.run("document.querySelector('main').innerText")
    assert "Alcyone (HIP 17702)" in page
    assert "focal length" in page
    assert "± " in page
    assert faults(browser) == []
    assert client.get("/api/v1/batches?run=*&limit=1").json() == before
    assert browser.complaints == []


@pytest.mark.slow
def test_a_picture_without_stars_is_followed_by_what_to_try(browser, address, tmp_path):
    noise = np.random.default_rng(3).normal(40.0, 3.0, (480, 640)).clip(0, 255).astype(np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.png")
    browser.open(f"{address}/pictures")
    choose(browser, tmp_path / "noise.png")
    solve(browser)
    advice = browser.run("document.getElementById('failed').innerText")
    assert "No attitude was found" in advice
    assert "field of view" in advice
    (tmp_path / "text.png").write_text("no picture")
    choose(browser, tmp_path / "text.png")
    browser.run("document.querySelector('#picture button.main').click()")
    browser.wait(lambda: "Not solved" in browser.run(STATUS))
    assert browser.run("document.getElementById('failed').hidden")
    browser.complaints.clear()


@pytest.mark.slow
def test_a_dropped_frame_of_a_mission_is_recorded_if_that_is_asked(browser, address, client, app):
    (drawn,) = draw_frames(load_missions()["IMAGER"], app.sky, FrameSettings(frames=1, seed=77))
    file = io.BytesIO(frame_bytes(drawn))
    numbers = json.dumps(list(file.getvalue()))
    browser.open(f"{address}/pictures")
    browser.run(
        "document.getElementById('camera').value = 'IMAGER';"
        "const files = new DataTransfer();"
        f"files.items.add(new File([Uint8Array.from({numbers})], 'frame.fits'));"
        "document.dispatchEvent(new DragEvent('drop', {dataTransfer: files, cancelable: true}))"
    )
    browser.wait(lambda: "points of light" in browser.run(STATUS), 120.0)
    assert browser.run("document.getElementById('record-time').value") == drawn.known["time"]
    browser.run(
        "document.getElementById('record-batch').value = 'dropped';"
        "document.querySelector('#record-form button').click()"
    )
    browser.wait(lambda: browser.run("location.pathname").startswith("/batches/"), 60.0)
    found = client.get("/api/v1/batches?spacecraft=IMAGER&batch=dropped").json()["items"]
    assert [each["id"] for each in found] == [browser.run("location.pathname.split('/')[2]")]
    assert browser.complaints == []
