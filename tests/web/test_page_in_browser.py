"""The page in a real browser: it fits, keeps itself fresh, and complains of nothing."""

import httpx
import pytest

from service.operations import Operations
from service.settings import Settings
from service.web.app import create_app
from tests.web.browser import CHROMIUM, Browser
from tests.web.conftest import Server

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.mark.parametrize("query", ["", "?run=full", "?run=full&bucket=day", "?run=nobody"])
@pytest.mark.parametrize("width", [1440, 400])
@pytest.mark.parametrize("dark", [False, True])
def test_it_fits_its_window_without_complaint(browser, address, full_run, query, width, dark):
    browser.open(f"{address}/{query}", width=width, dark=dark)
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.complaints == []


def test_the_chart_is_drawn_and_its_bars_stand_on_the_axis(browser, address, full_run):
    browser.open(f"{address}/?run={full_run}")
    boxes = browser.run(
        "[...document.querySelectorAll('.bar rect.ambiguous')].map(bar => {"
        "const box = bar.getBoundingClientRect();"
        "return [box.height, box.bottom - bar.closest('svg').getBoundingClientRect().top]})"
    )
    assert max(height for height, _ in boxes) > 20
    assert {round(bottom) for _, bottom in boxes} == {112}


def test_dark_and_light_differ_and_both_can_be_read(browser, address, full_run):
    colours = {}
    for dark in (False, True):
        browser.open(f"{address}/?run={full_run}", dark=dark)
        for name in ("color", "backgroundColor"):
            found = browser.run(f"getComputedStyle(document.body).{name}")
            colours[dark, name] = [int(part) for part in found[4:-1].split(",")]
    for dark in (False, True):
        ink, paper = sum(colours[dark, "color"]), sum(colours[dark, "backgroundColor"])
        assert (ink > paper) == dark
        assert abs(ink - paper) > 450


def test_every_control_can_be_reached_by_keyboard(browser, address, full_run):
    browser.open(f"{address}/?run={full_run}")
    reached = set()
    for _ in range(12):
        browser.press("Tab")
        reached.add(browser.run("document.activeElement.id || document.activeElement.tagName"))
    assert {"run", "bucket", "BUTTON", "SUMMARY", "A"} <= reached


def test_a_new_batch_appears_by_itself_and_a_lost_server_is_told(browser, batch, tmp_path):
    operations = Operations.open(Settings(database=f"sqlite:///{tmp_path}/acquire.db"))
    with Server(create_app(operations)) as address:
        browser.open(f"{address}/")
        assert "No live batches yet" in browser.run("document.body.innerText")
        httpx.post(f"{address}/api/v1/batches", json=batch, timeout=60).raise_for_status()
        browser.wait(lambda: batch["batch"] in browser.run("document.body.innerText"))
        assert browser.complaints == []
    browser.wait(lambda: "No answer from the service" in browser.run("document.body.innerText"))
    browser.complaints.clear()
