"""The page of a period: from the overview to a degraded tracker's residuals, and what it says.

A spacecraft with two trackers, of which the second becomes noisy and recovers.
"""

import html
import json
import re
from urllib.parse import parse_qs

import httpx
import pytest

from service.app.factory import open_app
from service.web.app import create_app
from tests.fresh_databases import sqlite_at
from tests.storage.twin import FIRST, SECOND, batch, twin
from tests.web.browser import CHROMIUM
from tests.web.fitting import VIEWS, faults
from tests.web.markup import Markup
from tests.web.serving import Server, in_process_settings

QUICK = {"warning": {"high": 2.0}, "minimum_count": 3, "duration_s": 0}
PAGE = "/spacecraft/XTE/period"
LOUD = range(20, 50)
in_browser = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")


@pytest.fixture(scope="module")
def address(tmp_path_factory, sky, missions):
    """A service with the batches: the second tracker is nine times as noisy for a while."""
    database = sqlite_at(tmp_path_factory.mktemp("period") / "acquire.db")
    mission = twin(missions)
    app = create_app(open_app(in_process_settings(database), mission))
    with Server(app) as address, httpx.Client(base_url=address, timeout=120) as client:
        limits = {"settings": QUICK, "who": "J. Operator"}
        path = "/api/v1/spacecraft/XTE/limits/residual_ratio"
        client.put(path, json=limits).raise_for_status()
        for k in range(65):
            noise = (2.0, 18.0) if k in LOUD else (2.0, 2.0)
            text = batch(sky, mission, f"b{k}", after_s=30.0 * k, noise_arcsec=noise)
            headers = {"Content-Type": "application/json"}
            client.post("/api/v1/batches", content=text, headers=headers).raise_for_status()
        yield address


def text_of(page):
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", page)))


def spread_of(page, tracker):
    """The standard deviation that the histogram of a tracker states."""
    own = page.partition(f"Residuals of {tracker} over their expected")[2]
    return float(re.search(r"standard deviation ([\d.]+)", own).group(1))


@in_browser
@pytest.mark.slow
def test_two_clicks_lead_from_the_overview_to_the_residual_map_of_the_tracker(browser, address):
    browser.open(address)
    alarm = "document.querySelector('tbody .c-alarms a')"
    assert SECOND in browser.run(f"{alarm}.textContent")
    browser.run(f"{alarm}.click()")
    browser.wait(lambda: browser.run("location.pathname").startswith("/alarms/"))
    browser.wait(lambda: browser.run("document.readyState") == "complete")
    assert SECOND in browser.run("document.querySelector('h1').textContent")
    link = "[...document.querySelectorAll('a.button')].find(e => e.textContent === 'Residual map')"
    browser.run(f"{link}.click()")
    browser.wait(lambda: browser.run("location.pathname") == PAGE)
    browser.wait(lambda: browser.run("document.readyState") == "complete")
    assert f"tracker={SECOND}" in browser.run("location.search")
    assert browser.run("location.hash") == f"#residuals-{SECOND}"
    # The heading is in the window, with the map below it.
    top = browser.run(f"document.getElementById('residuals-{SECOND}').getBoundingClientRect().top")
    assert 0 <= top < 900
    titles = browser.run(
        "[...document.querySelectorAll('svg.focal-plane title')].map(e => e.textContent)"
    )
    assert [each for each in titles if each.startswith("Residuals of ")] == [
        each for each in titles if SECOND in each
    ]
    assert (
        browser.run(
            "document.querySelectorAll('.focal-plane .shade-4, .focal-plane .shade-3').length"
        )
        > 2
    )
    assert browser.complaints == []


@in_browser
@pytest.mark.parametrize(
    "path", [PAGE, f"{PAGE}?tracker={SECOND}&range=20min", "/spacecraft/XTE?range=40min"]
)
def test_it_fits_with_every_table_open_and_axe_finds_no_fault(browser, address, path):
    width, dark = VIEWS[0]
    browser.open(f"{address}{path}", width=width, dark=dark)
    if "period" not in path:
        browser.wait(lambda: browser.run("!!document.querySelector('.alarm-bars a')"))
    assert browser.run("document.documentElement.scrollWidth") <= width
    browser.run("document.querySelectorAll('details').forEach(each => each.open = true)")
    for width, dark in VIEWS:
        browser.show(width=width, dark=dark)
        assert browser.run("document.documentElement.scrollWidth") <= width
        assert faults(browser) == [], (width, dark)
    assert browser.complaints == []


@in_browser
def test_alarms_are_bars_below_the_trends_and_lead_to_the_alarm(browser, address):
    browser.open(f"{address}/spacecraft/XTE?range=40min")
    bars = "[...document.querySelectorAll('[data-bars=residual-ratio] a')]"
    browser.wait(lambda: browser.run(f"{bars}.length"))
    named = browser.run(f"{bars}.map(each => each.getAttribute('aria-label'))")
    (own,) = [each for each in named if SECOND in each]
    assert own.startswith(f"warning: {SECOND}: residual over predicted, from 1996-01-10 (010) 12:1")
    # It recovered: the bar ends before the chart does, and stands below its own area.
    assert "until now" not in own
    place = (
        "(e => { const c = document.querySelector('[data-chart=residual-ratio] .u-over')"
        ".getBoundingClientRect(), b = e.getBoundingClientRect();"
        "return [b.left - c.left, c.right - b.right, b.top - c.bottom]; })"
    )
    left, right, below = browser.run(f"{place}({bars}[0])")
    assert left > 0
    assert right > 0
    assert below > 0
    browser.run(f"{bars}.find(each => each.title.includes('{SECOND}')).click()")
    browser.wait(lambda: browser.run("location.pathname").startswith("/alarms/"))
    assert browser.complaints == []


def test_bars_of_a_tracker_are_its_own_and_those_of_all(address):
    for tracker, others in ((FIRST, {None, FIRST}), (SECOND, {None, SECOND})):
        page = httpx.get(f"{address}/spacecraft/XTE", params={"tracker": tracker}).text
        found = json.loads(html.unescape(re.search(r'data-alarms="([^"]*)"', page).group(1)))
        assert {each["tracker"] for each in found} <= others
    assert any(each["tracker"] == SECOND for each in found)


def test_a_period_shows_who_was_noisy_then_and_that_all_was_well_before(address):
    quiet = {"start": "1996-01-10T12:00:00Z", "end": "1996-01-10T12:10:00Z"}
    loud = {"start": "1996-01-10T12:10:00Z", "end": "1996-01-10T12:25:00Z"}
    before = httpx.get(address + PAGE, params=quiet).text
    during = httpx.get(address + PAGE, params=loud).text
    for page in (before, during):
        Markup(page)
    for tracker in (FIRST, SECOND):
        assert spread_of(before, tracker) == pytest.approx(1.0, abs=0.15)
    assert spread_of(during, SECOND) > 4.0
    assert spread_of(during, SECOND) > 2.0 * spread_of(during, FIRST)
    assert "20 batches, all of this period" in text_of(before)


def test_each_link_of_an_alarm_to_a_period_covers_the_alarm_from_its_raise_to_its_return(address):
    with httpx.Client(base_url=address, timeout=120) as client:
        for alarm in client.get("/api/v1/alarms", params={"state": "all"}).json()["items"]:
            page = html.unescape(client.get(f"/alarms/{alarm['id']}").text)
            links = re.findall(r'href="/(?:spacecraft|advice)/XTE[^"]*\?([^"#]*start=[^"#]*)', page)
            # The cause, where one is named, has a link to the comparison with the period before.
            assert len(links) == 3 + ("Compare with the" in page)
            for asked in map(parse_qs, links):
                times = [alarm[name]["time"] for name in ("raised", "worst")]
                assert asked["start"][0] < min(times)
                assert max(times) < asked["end"][0]


def test_the_advice_for_an_alarm_tells_how_noisy_the_tracker_was_though_it_has_recovered(address):
    with httpx.Client(base_url=address, timeout=120) as client:
        alarms = client.get("/api/v1/alarms", params={"state": "all"}).json()["items"]
        (own,) = [
            each["id"]
            for each in alarms
            if (each["tracker"], each["quantity"]) == (SECOND, "residual_ratio")
        ]
        page = client.get(f"/alarms/{own}").text
        (link,) = re.findall(r'href="/advice/XTE([^"]*)">advice for its time', page)
        query = html.unescape(link)
        (said,) = re.findall(f"Noise of {SECOND} is [^<]*", client.get(f"/advice/XTE{query}").text)
        advice = client.get(f"/api/v1/spacecraft/XTE/advice{query}").raise_for_status().json()
    assert "look for what happened to the tracker then" in said
    noise = {each["tracker"]: each for each in advice["noise"]}
    assert noise[FIRST]["worst"] is None
    worst = noise[SECOND]["worst"]
    assert worst["sigma_arcsec"]["low"] < 18.0 < worst["sigma_arcsec"]["high"]
    assert worst["batches"] == pytest.approx(len(LOUD), abs=2)
    assert noise[SECOND]["sigma_arcsec"]["value"] < 4.0


def test_a_period_without_data_says_so(address):
    gone = {"start": "1997-01-10T12:00:00Z", "end": "1997-01-10T12:10:00Z"}
    page = httpx.get(address + PAGE, params=gone)
    assert page.status_code == 200
    assert "No batches in this period." in text_of(page.text)
    assert "<svg" not in page.text.partition('id="period"')[2].partition("</main>")[0]
    none = httpx.get(address + PAGE, params={"run": "nothing"})
    assert "No batches of XTE in run nothing" in text_of(none.text)


@pytest.mark.parametrize(
    ("asked", "status", "field"),
    [
        ({"tracker": "NONE"}, 422, "tracker"),
        ({"range": "6x"}, 422, "range"),
        ({"start": "yesterday"}, 422, "start"),
    ],
)
def test_what_is_wrong_is_named(address, asked, status, field):
    answer = httpx.get(address + PAGE, params=asked)
    assert answer.status_code == status
    assert field in text_of(answer.text)
    assert next(iter(asked.values())) in text_of(answer.text)


def test_an_unknown_spacecraft_is_not_found(address):
    assert httpx.get(f"{address}/spacecraft/NONE/period").status_code == 404


def test_one_batch_and_batches_without_attitude_are_shown_for_what_they_are(address, sky, missions):
    one = json.loads(batch(sky, twin(missions), "one", run="few"))
    for each in one["observations"]:
        each["stars"] = each["stars"][:1] if each["tracker"] == FIRST else []
    one["observations"] = [each for each in one["observations"] if each["stars"]]
    posted = httpx.post(f"{address}/api/v1/batches", json=one, timeout=60)
    assert posted.raise_for_status().json()["attitude"] is None
    text = text_of(httpx.get(address + PAGE, params={"run": "few"}).raise_for_status().text)
    assert "1 batch, all of this period" in text
    assert "there are no residuals" in text
    assert "No batch of this period has an attitude" in text
