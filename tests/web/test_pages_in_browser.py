"""Every page of a service without data, with one spacecraft's and with 40: it fits, axe content."""

import httpx
import pytest

from service.app.factory import open_app
from service.web.app import create_app
from tests.fresh_databases import sqlite_at
from tests.web import fleet
from tests.web.browser import CHROMIUM
from tests.web.console_pages import console_addresses
from tests.web.fitting import assert_fits
from tests.web.serving import Server, in_process_settings

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")

BATCHES = 12
ANNOTATION = {"start": "1999-03-01T00:10:00Z", "text": "Wheel 2 unloaded; " * 20, "who": "jb"}


# Of nothing, `test_console` reads every page; of a fleet, `test_fleet_in_browser` the first one.
@pytest.fixture(
    params=(1, pytest.param(0, marks=pytest.mark.slow), pytest.param(40, marks=pytest.mark.slow))
)
def pages(request, browser, tmp_path, drawn):
    """The addresses of every page of a service with data of so many spacecraft."""
    size, missions, name = request.param, None, "XTE"
    if size == 40:
        missions, name = fleet.write_missions(tmp_path / "missions", size), fleet.troubled(size)[0]
    settings = in_process_settings(sqlite_at(tmp_path / "acquire.db"), missions=missions)
    app = open_app(settings)
    if size == 40:
        fleet.fill(app, size)
        fleet.fill(app, size, run="again")
    with (
        Server(create_app(app)) as url,
        httpx.Client(base_url=f"{url}/api/v1", timeout=60) as client,
    ):
        for each in drawn("XTE", BATCHES, seed=4) if size == 1 else ():
            for run, identifier in (("live", "starid"), ("again", "verified")):
                body = each | {"run": run, "options": {"identifier": identifier}}
                client.post("/batches", json=body).raise_for_status()
        if size:
            note = ANNOTATION | {"spacecraft": name}
            client.post("/annotations", json=note).raise_for_status()
        alarms = client.get("/alarms").json()["items"]
        found = [each.replace("XTE", name) for each in console_addresses()]
        found += [f"/alarms/{each['id']}" for each in alarms[:1]]
        if size == 40:
            # Some pages read what was sent, of which the rows of the fleet have nothing.
            found = [each for each in found if "/advice" not in each and "/period" not in each]
            found += [f"/spacecraft/{name}{page}?tracker=STARTRACKER_2" for page in ("", "/limits")]
        yield [url + each for each in found]
        browser.call("Page.navigate", url="about:blank")
        browser.complaints.clear()


def test_every_page_fits_and_axe_finds_nothing(browser, pages):
    for page in pages:
        assert_fits(browser, page)
    assert browser.complaints == []
