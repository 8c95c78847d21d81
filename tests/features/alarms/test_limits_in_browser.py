"""Limits in a real browser: previewed over recorded batches, set for one of several trackers."""

import httpx
import pytest

from service.app.factory import open_app
from service.web.app import create_app
from tests.fresh_databases import sqlite_at
from tests.web import fleet
from tests.web.browser import CHROMIUM
from tests.web.fitting import faults
from tests.web.serving import Server, in_process_settings

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")

CONNECTED = "document.getElementById('connection').dataset.state === 'live'"
FORM = "document.querySelector('[data-limit={}]')"
PREVIEW = "document.getElementById('preview-{}').innerText"
SECOND = "STARTRACKER_2"


@pytest.fixture(scope="module")
def fleet_address(browser, tmp_path_factory):
    """Eight spacecraft of two trackers, six of them in trouble."""
    folder = tmp_path_factory.mktemp("fleet")
    missions = fleet.write_missions(folder / "missions", 8)
    app = open_app(in_process_settings(sqlite_at(folder / "acquire.db"), missions=missions))
    fleet.fill(app, 8)
    with Server(create_app(app)) as address:
        yield address
        browser.call("Page.navigate", url="about:blank")


def test_a_preview_tells_and_draws_what_a_changed_limit_would_have_done(browser, fleet_address):
    name = fleet.troubled(8)[0]
    page = f"{fleet_address}/spacecraft/{name}/limits"
    for width, dark in ((1440, False), (400, True)):
        browser.open(page, width=width, dark=dark)
        browser.wait(lambda: browser.run(CONNECTED))
        form = FORM.format("unmatched_share")
        browser.run(f"{form}.elements['minimum_count'].value = '5'")
        browser.run(f"{form}.querySelector('[data-preview]').focus()")
        browser.press("Enter")
        told = PREVIEW.format("unmatched_share")
        browser.wait(lambda told=told: "nothing is changed" in browser.run(told))
        said = browser.run(told)
        assert "48 batches" in said
        assert "These limits: 1 alarm;" in said
        # Each of the last ten batches has four of ten: the mean over 20 passes a bound, too.
        assert "The limits in force: 1 alarm;" in said
        assert "values beyond critical" in said
        chart = "document.querySelector('#preview-unmatched_share .chart')"
        assert "times out of these limits: 1" in browser.run(f"{chart}.getAttribute('aria-label')")
        assert browser.run("document.documentElement.scrollWidth") <= width
        assert faults(browser) == [], (width, dark)
    here = f"{fleet_address}/api/v1/spacecraft/{name}/limits/unmatched_share"
    assert httpx.get(here).json()["history"] == []
    assert browser.complaints == []


def test_what_is_wrong_is_told_beside_the_fields(browser, fleet_address):
    browser.open(f"{fleet_address}/spacecraft/{fleet.troubled(8)[0]}/limits")
    browser.run(f"{FORM.format('silence_s')}.elements['warning.high'].value = 'x'")
    browser.run(f"{FORM.format('silence_s')}.querySelector('[data-preview]').click()")
    told = PREVIEW.format("silence_s")
    browser.wait(lambda: "warning.high must be a number, not x" in browser.run(told))


def test_a_limit_of_one_tracker_is_set_and_taken_back_on_its_page(browser, fleet_address):
    name = fleet.troubled(8)[0]
    browser.open(f"{fleet_address}/spacecraft/{name}/limits")
    browser.run(f"document.querySelector('a.button[href*={SECOND}]').click()")
    browser.wait(lambda: f"tracker={SECOND}" in browser.run("location.search"))
    browser.wait(lambda: browser.run("document.readyState") == "complete")
    browser.wait(lambda: browser.run(CONNECTED))
    assert SECOND in browser.run("document.querySelector('h1').innerText")
    browser.run("document.querySelector('#signed input[name=who]').value = 'J. Operator'")
    form = FORM.format("residual_ratio")
    browser.run(f"{form}.elements['watch.high'].value = '1.7'; {form}.requestSubmit()")
    browser.wait(lambda: "J. Operator" in browser.run("residual_ratio.innerText"))
    here = f"{fleet_address}/api/v1/spacecraft/{name}/limits/residual_ratio"
    assert httpx.get(here, params={"tracker": SECOND}).json()["limit"]["settings"]["watch"] == {
        "low": None,
        "high": 1.7,
    }
    assert httpx.get(here).json()["limit"]["is_default"]
    browser.run("document.querySelector('#residual_ratio [data-default]').click()")
    browser.wait(lambda: "as the spacecraft" in browser.run("residual_ratio.innerText"))
    assert browser.complaints == []
