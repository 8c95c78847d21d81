"""Annotations in a real browser: written by keyboard and on a phone, marked on the charts."""

import httpx
import pytest

from service.app.factory import open_app
from service.web.app import create_app
from tests.fresh_databases import sqlite_at
from tests.web.browser import CHROMIUM, Browser
from tests.web.fitting import faults
from tests.web.serving import Server, in_process_settings

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")

DRAWN = "document.getElementById('charts')?.dataset.drawn !== undefined"
CONNECTED = "document.getElementById('connection').dataset.state === 'live'"
LISTED = "[...document.querySelectorAll('[data-annotation] .text')].map(each => each.textContent)"
LABEL = "document.querySelector('[data-chart=stars]').getAttribute('aria-label')"
FOCUS = "document.querySelector('#annotate [name={}]').focus()"
VALUE = "document.querySelector('#annotate [name={}]').value"
STATUS = "document.getElementById('annotate-status').textContent"
INK = """(canvas => { const all = canvas.getContext('2d')
    .getImageData(0, 0, canvas.width, canvas.height).data;
    let sum = 0; for (const each of all) sum += each; return sum; })
    (document.querySelector('[data-chart=stars] canvas'))"""


@pytest.fixture(scope="module")
def other_browser(chromium):
    with Browser(chromium) as browser:
        yield browser


@pytest.fixture
def page(browser, other_browser, tmp_path, drawn):
    """The page of a spacecraft with ten batches, of a service of its own."""
    app = open_app(in_process_settings(sqlite_at(tmp_path / "acquire.db")))
    with Server(create_app(app)) as address:
        for each in drawn("XTE", 10, cadence_s=600.0):
            httpx.post(f"{address}/api/v1/batches", json=each, timeout=60).raise_for_status()
        yield f"{address}/spacecraft/XTE"
        for each in (browser, other_browser):
            each.call("Page.navigate", url="about:blank")
            each.complaints.clear()


def opened(browser, page, **how):
    browser.open(page, **how)
    browser.wait(lambda: browser.run(DRAWN))
    browser.wait(lambda: browser.run(CONNECTED))


def typed(browser, field, text):
    browser.run("document.getElementById('add-annotation').open = true")
    browser.run(FOCUS.format(field) + "; document.activeElement.select?.()")
    browser.call("Input.insertText", text=text)


def test_a_note_by_keyboard_is_marked_on_the_charts_of_every_reader(browser, other_browser, page):
    opened(other_browser, page, width=400, dark=True)
    opened(browser, page)
    before = browser.run(INK)
    typed(browser, "start", "1999-060T00:30:00Z")
    typed(browser, "text", "Wheel 2 unloaded <b>now</b>")
    browser.press("Tab")
    browser.press("Tab")
    browser.call("Input.insertText", text="J. Operator")
    browser.press("Enter")
    for each in (browser, other_browser):
        each.wait(lambda each=each: each.run(LISTED) == ["Wheel 2 unloaded <b>now</b>"])
        each.wait(lambda each=each: each.run(LABEL).endswith("annotations: 1, listed below"))
    browser.wait(lambda: browser.run(STATUS) == "Annotation added.")
    browser.wait(lambda: browser.run(DRAWN))
    assert browser.run(INK) != before
    assert browser.run(VALUE.format("text")) == ""
    assert "by J. Operator" in browser.run("document.querySelector('[data-annotation]').innerText")
    for each in (browser, other_browser):
        assert faults(each) == []
        assert each.run("document.documentElement.scrollWidth <= innerWidth")
        assert each.complaints == []


@pytest.mark.slow
def test_on_a_phone_a_tap_on_a_chart_gives_the_time_and_a_note_can_be_deleted(browser, page):
    opened(browser, page, width=400, height=800)
    place = browser.run(
        "(e => { e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect();"
        "return [b.left + b.width / 2, b.top + b.height / 2]; })"
        "(document.querySelector('[data-chart=stars] .u-over'))"
    )
    for kind in ("mousePressed", "mouseReleased"):
        browser.call(
            "Input.dispatchMouseEvent",
            type=kind,
            x=place[0],
            y=place[1],
            button="left",
            clickCount=1,
        )
    ends = "['start', 'end'].map(each => Date.parse(stretch.dataset[each]))"
    start_ms, end_ms = browser.run(ends)
    apart_ms = browser.run(f"Date.parse({VALUE.format('start')})") - (start_ms + end_ms) / 2
    assert abs(apart_ms) < 10 * 60 * 1000
    typed(browser, "text", "first line\nsecond line")
    typed(browser, "who", "jb")
    browser.run("document.querySelector('#annotate .main').click()")
    browser.wait(lambda: browser.run(LISTED) == ["first line\nsecond line"])
    browser.run("document.querySelector('[data-delete]').click()")
    # Without a reason the dialog stays, and the note as well.
    browser.run("document.querySelector('dialog .main').click()")
    assert browser.run("document.querySelector('dialog').open")
    browser.run("document.querySelector('dialog [name=comment]').value = 'a trial'")
    browser.run("document.querySelector('dialog .main').click()")
    browser.wait(lambda: browser.run(LISTED) == [])
    browser.wait(lambda: browser.run(STATUS) == "Annotation deleted.")
    assert browser.complaints == []


def test_a_note_is_added_within_the_first_screen_of_spacecraft_and_of_the_list(browser, page):
    top = "document.querySelector('#add-annotation > summary').getBoundingClientRect().top"
    for width, height in ((1440, 900), (400, 800)):
        opened(browser, page, width=width, height=height)
        assert browser.run(top) < height
    browser.open(page.replace("/spacecraft/XTE", "/annotations?spacecraft=XTE"))
    assert browser.run(top) < 300
    for field, text in (("start", "1999-060 00:30"), ("text", "slew"), ("who", "jb")):
        typed(browser, field, text)
    browser.run("document.querySelector('#annotate .main').click()")
    browser.wait(lambda: "slew" in browser.run("document.getElementById('list').innerText"))
    assert faults(browser) == []
    assert browser.complaints == []


def test_a_wrong_time_is_told_at_the_form_and_the_text_stays(browser, page):
    opened(browser, page)
    typed(browser, "start", "yesterday")
    typed(browser, "text", "keep me")
    typed(browser, "who", "jb")
    browser.press("Enter")
    assert "From must be UTC" in browser.run("document.getElementById('annotate').innerText")
    assert browser.run(VALUE.format("text")) == "keep me"
    browser.run("document.querySelector('[data-whole-period]').click()")
    bounds = browser.run("[stretch.dataset.start, stretch.dataset.end]")
    assert [browser.run(VALUE.format(each)) for each in ("start", "end")] == bounds
    browser.run("document.querySelector('#annotate .main').click()")
    browser.wait(lambda: browser.run(LISTED) == ["keep me"])
