"""The overview of 40 and of 200 spacecraft in a real browser, six of them in trouble."""

import gzip
import html
import json
import re

import httpx
import pytest

from service.app.factory import open_app
from service.web.app import create_app
from service.web.console.pages.overview import UNFOLDED
from tests.fresh_databases import sqlite_at
from tests.web import fleet
from tests.web.browser import CHROMIUM
from tests.web.fitting import assert_fits, faults
from tests.web.serving import Server, in_process_settings

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")

ROWS = "[...document.querySelectorAll('.fleet tbody tr')]"
NAMES = f"{ROWS}.map(row => row.querySelector('th').innerText)"
DRAWN = "document.getElementById('heat').dataset.drawn"
MOST_BYTES = 300_000


@pytest.fixture(scope="module", params=(40, pytest.param(200, marks=pytest.mark.slow)))
def filled(request, browser, tmp_path_factory):
    """A service with so many spacecraft in trouble and out of it: how many, and its address."""
    folder = tmp_path_factory.mktemp("fleet")
    missions = fleet.write_missions(folder / "missions", request.param)
    settings = in_process_settings(sqlite_at(folder / "acquire.db"), missions=missions)
    app = open_app(settings)
    fleet.fill(app, request.param)
    with Server(create_app(app)) as address:
        yield request.param, address
        # So that it does not look for the service that ends.
        browser.call("Page.navigate", url="about:blank")


def shown_names(browser):
    return [each for each in browser.run(NAMES) if each.startswith("SAT-")]


def test_all_in_trouble_stand_in_the_first_900_pixels(browser, filled):
    size, address = filled
    browser.open(address)
    browser.wait(lambda: browser.run(DRAWN) == str(size))
    assert set(shown_names(browser)[: fleet.IN_TROUBLE]) == set(fleet.troubled(size))
    places = browser.run(
        f"{ROWS}.map(row => row.getBoundingClientRect()).map(b => [b.bottom, b.height])"
    )
    assert places[fleet.IN_TROUBLE - 1][0] <= 900
    assert max(height for _, height in places) <= 48
    assert len(places) == UNFOLDED
    assert browser.run("document.documentElement.scrollHeight") <= 2500
    page = httpx.get(address).text
    assert f">Show {size + 4 - UNFOLDED} more</a> {size - UNFOLDED} without trouble, 4 that" in page
    loaded = browser.run("performance.getEntriesByType('resource').map(each => each.name)")
    files = {each for each in [address, *loaded] if "/events" not in each}
    assert sum(len(gzip.compress(httpx.get(each).content)) for each in files) < MOST_BYTES
    assert browser.complaints == []


def test_it_fits_wide_and_narrow_light_and_dark_without_any_fault(browser, filled):
    size, address = filled
    last = f"{ROWS}[{fleet.IN_TROUBLE - 1}].getBoundingClientRect().bottom"
    for views in ([(1440, True)], [(400, False), (400, True)]):
        assert_fits(browser, address, views, lambda: browser.run(DRAWN) == str(size))
        assert browser.run(last) <= 900
    assert browser.complaints == []


def test_a_silent_spacecraft_is_not_good_and_says_for_how_long(browser, tmp_path):
    missions = fleet.write_missions(tmp_path / "missions", 8)
    app = open_app(in_process_settings(sqlite_at(tmp_path / "acquire.db"), missions=missions))
    fleet.fill(app, 8, silent="SAT-000")
    row = "document.querySelector('.fleet tbody [href$=\"/SAT-000\"]').closest('tr')"
    cut = (
        "[...document.querySelectorAll('.c-latest a, .c-behind, .fleet .number, .c-worst')]"
        ".filter(e => e.offsetParent && e.scrollWidth > e.clientWidth + 1).length"
    )
    with Server(create_app(app)) as address:
        for width in (1440, 400):
            browser.open(address, width=width, dark=width == 400)
            browser.wait(lambda: browser.run(DRAWN) == "8")
            shown = browser.run(f"{row}.innerText").replace("\u202f", " ")
            assert "6 h 30 min" in shown
            assert browser.run(cut) == 0
            assert faults(browser) == []
        browser.open(address)
        shown = browser.run(f"{row}.innerText").replace("\u202f", " ")
        assert "silent 6 h 30 min" in shown
        assert "1999-03-01 (060) 17:30" in shown
        assert "good" not in shown
        browser.open(f"{address}/?show=stale")
        assert browser.run(NAMES) == ["SAT-000"]
        browser.call("Page.navigate", url="about:blank")
    browser.complaints.clear()


def test_rows_are_filtered_and_sorted_and_the_address_says_how(browser, filled):
    size, address = filled
    browser.open(address)
    browser.wait(lambda: browser.run(DRAWN) == str(size))
    browser.run(
        "(box => { box.value = 'sat-02'; box.dispatchEvent(new Event('input', {bubbles: true})); })"
        "(document.querySelector('#filter input[type=search]'))"
    )
    browser.wait(lambda: len(browser.run(NAMES)) == 10)
    assert "q=sat-02" in browser.run("location.search")
    browser.wait(lambda: browser.run(DRAWN) == "10")
    order = "document.querySelector('.fleet th.c-name').ariaSort"
    for wanted in ("ascending", "descending"):
        browser.run("document.querySelector('.fleet .c-name a[data-go]').click()")
        browser.wait(lambda wanted=wanted: browser.run(order) == wanted)
    assert browser.run(NAMES) == [f"SAT-{k:03d}" for k in range(29, 19, -1)]
    browser.open(browser.run("location.href"))
    assert browser.run(NAMES)[0] == "SAT-029"
    browser.open(f"{address}/?show=trouble")
    assert sorted(browser.run(NAMES)) == fleet.troubled(size)
    assert browser.complaints == []


def test_a_cell_of_the_heat_map_is_read_by_keyboard_and_leads_to_the_spacecraft(browser, filled):
    size, address = filled
    browser.open(f"{address}/?heat=unmatched_share")
    browser.wait(lambda: browser.run(DRAWN) == str(size))
    label = "document.getElementById('heat-map').getAttribute('aria-label')"
    worst = fleet.troubled(size)[0]
    assert browser.run(label).startswith(
        f"unmatched stars of {size} spacecraft; greatest 40 %, {worst}"
    )
    browser.run("document.getElementById('heat-map').focus()")
    browser.press("ArrowLeft")
    said = browser.run("document.getElementById('heat-readout').textContent")
    assert said.startswith(f"{worst}, 1999-03-0")
    assert said.endswith("40 % unmatched stars")
    browser.press("Enter")
    browser.wait(lambda: browser.run("location.pathname") == f"/spacecraft/{worst}")
    assert "start=1999-03-01T" in browser.run("location.search")
    browser.complaints.clear()


def test_without_scripts_the_rows_are_all_there(filled):
    size, address = filled
    page = httpx.get(address, params={"sort": "unmatched", "show": "no_attitude"}).text
    for name in fleet.troubled(size):
        assert json.dumps(name) in page or f">{name}</a>" in page
    assert page.count('<tr class="trouble">') == fleet.IN_TROUBLE


def test_on_a_narrow_screen_what_is_done_to_alarms_stands_beside_the_selection(browser, filled):
    _, address = filled
    browser.open(f"{address}/alarms", width=400)
    place = "document.querySelector('#bulk [data-act=acknowledge]').getBoundingClientRect()"
    is_seen = f"(b => b.height > 0 && b.top >= 0 && b.bottom <= innerHeight)({place})"
    assert not browser.run(is_seen)
    browser.run("document.querySelector('[data-select]').click()")
    assert browser.run(is_seen)
    assert faults(browser) == []


def test_many_alarms_are_acknowledged_at_once_and_the_header_counts_down(browser, filled):
    _, address = filled
    browser.open(f"{address}/alarms")
    browser.wait(
        lambda: browser.run("document.getElementById('connection').dataset.state") == "live"
    )
    assert browser.run("document.title").startswith(f"◆ ({fleet.IN_TROUBLE}) ")
    selected = "document.getElementById('message').textContent"
    browser.run("document.querySelector('[data-select-all]').click()")
    assert browser.run(selected) == f"{fleet.IN_TROUBLE} selected."
    browser.run("document.querySelector('[data-select]').click()")
    browser.run("document.querySelector('#bulk input[name=who]').value = 'J. Operator'")
    browser.run("document.querySelector('#bulk [data-act=acknowledge]').click()")
    browser.wait(lambda: browser.run(selected) == f"{fleet.IN_TROUBLE - 1} acknowledged.")
    browser.wait(lambda: browser.run("document.title").startswith("◆ (1) "))
    found = httpx.get(f"{address}/api/v1/alarms").json()["items"]
    assert sorted(each["state"] for each in found) == ["acknowledged"] * 5 + ["open"]
    browser.run("document.querySelector('[data-select]').click()")
    browser.run("document.querySelector('#bulk [data-act=shelve]').click()")
    browser.wait(lambda: browser.run(selected) == "1 shelved.")
    browser.wait(lambda: browser.run("document.querySelector('#open-alarms').textContent") == "")
    assert faults(browser) == []
    assert browser.complaints == []


def test_a_period_is_entered_by_its_length_or_by_its_ends(browser, filled):
    size, address = filled
    name = fleet.troubled(size)[0]
    browser.open(f"{address}/spacecraft/{name}")
    fill = "document.querySelector('.entries input[name={0}]').value = '{1}'"
    browser.run(fill.format("range", "6h"))
    browser.run("document.querySelector('form.entries').requestSubmit()")
    browser.wait(lambda: "range=6h" in browser.run("location.search"))
    bounds = "[stretch.dataset.start, stretch.dataset.end].map(each => Date.parse(each))"
    browser.wait(lambda: browser.run("document.readyState") == "complete")
    start_ms, end_ms = browser.run(bounds)
    assert end_ms - start_ms == 6 * 3600 * 1000
    browser.run(fill.format("start", "1999-060T12:00:00Z"))
    browser.run(fill.format("end", ""))
    browser.run("document.querySelector('form.entries').requestSubmit()")
    browser.wait(lambda: "start=1999-060" in browser.run("location.search"))
    browser.wait(lambda: browser.run("document.readyState") == "complete")
    start_ms, end_ms = browser.run(bounds)
    assert end_ms - start_ms == pytest.approx(12 * 3600 * 1000, abs=1000)
    browser.complaints.clear()


def test_spacecraft_to_compare_with_are_picked_from_a_list_narrowed_by_text(browser, filled):
    size, address = filled
    browser.open(f"{address}/spacecraft/SAT-000")
    browser.run("document.querySelector('#compare summary').click()")
    shown = "[...document.querySelectorAll('.picks li')].filter(e => e.checkVisibility()).length"
    # Those that never sent anything, too.
    assert browser.run(shown) == size + 3
    typed = "document.querySelector('[data-narrow] input')"
    browser.run(
        "(box => { box.value = 'sat-01';"
        f"box.dispatchEvent(new Event('input', {{bubbles: true}})); }})({typed})"
    )
    browser.wait(lambda: browser.run(shown) == 10)
    for number in range(4):
        browser.run(f"document.getElementById('beside-SAT-01{number}').click()")
        browser.wait(lambda number=number: f"SAT-01{number}" in browser.run("location.search"))
    browser.wait(lambda: "(4)" in browser.run("document.querySelector('#compare').innerText"))
    # The filter stays, and no chart tells more than four others apart.
    assert browser.run(f"{typed}.value") == "sat-01"
    browser.wait(lambda: browser.run(shown) == 10)
    assert browser.run("document.getElementById('beside-SAT-014').disabled")
    assert not browser.run("document.getElementById('beside-SAT-013').disabled")
    assert faults(browser) == []
    page = httpx.get(f"{address}/spacecraft/SAT-000?beside=SAT-001&beside=SAT-002").text
    assert len(json.loads(html.unescape(re.search(r'data-others="([^"]*)"', page)[1]))) == 2
    assert page.count(" checked> SAT-00") == 2
    assert browser.complaints == []


def test_what_was_typed_stays_when_something_happens_meanwhile(browser, filled):
    size, address = filled
    name = fleet.troubled(size)[0]
    browser.open(f"{address}/spacecraft/{name}")
    state = "document.getElementById('connection').dataset.state"
    browser.wait(lambda: browser.run(state) == "live")
    field = "document.querySelector('.entries input[name=start]')"
    browser.run(f"{field}.value = '1999-060T06:'")
    browser.run(f"{field}.closest('[data-region]').dataset.earlier = 'yes'")
    note = {"text": "A shift begins", "start": "1999-03-01T06:00:00Z", "who": "jb"}
    assert httpx.post(f"{address}/api/v1/annotations", json=note).status_code == 201
    browser.wait(lambda: browser.run(f"{field}.closest('[data-region]').dataset.earlier") is None)
    assert browser.run(f"{field}.value") == "1999-060T06:"
