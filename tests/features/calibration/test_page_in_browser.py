"""A mission whose file is wrong, from a poor record to a good one, in one walk in a browser."""

import httpx
import pytest

from service.app.factory import open_app
from service.web.app import create_app
from tests.features.calibration.wrong_file import true_batches, with_true_file, write_mission_files
from tests.fresh_databases import sqlite_at
from tests.web.browser import CHROMIUM
from tests.web.fitting import faults
from tests.web.serving import Server, in_process_settings

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")

BEFORE, AFTER = 40, 20
COLUMN = """[...document.querySelectorAll("td[data-name={}]")].map((each) => each.innerText)"""
CELLS = """[...document.querySelectorAll("#trial tbody tr:nth-child({}) td")]
    .map((each) => parseInt(each.innerText))"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("missions")
    write_mission_files(folder)
    return folder


def latest_batches(browser, address):
    """How many of the newest `AFTER` batches have no good attitude, and their ambiguous stars."""
    browser.open(f"{address}/batches?spacecraft=TWO")
    status, ambiguous = (
        browser.run(COLUMN.format(name))[:AFTER] for name in ("attitude", "ambiguous")
    )
    assert len(status) == AFTER
    return sum("good" not in each for each in status), sum(int(each) for each in ambiguous)


def sent(address, batches):
    for each in batches:
        httpx.post(f"{address}/api/v1/batches", json=each, timeout=60).raise_for_status()


SIGN = """(form => { form.elements.who.value = 'J. Operator';
    form.elements.comment.value = 'after the first pass'; form.querySelector('.main').click(); })(
    document.querySelector('dialog form'))"""


@pytest.mark.slow
def test_calibrate_try_adopt_and_take_back(browser, folder):
    missions = folder / "assumed"
    app = open_app(in_process_settings(sqlite_at(folder / "acquire.db"), missions=missions))
    batches = true_batches(app.sky, BEFORE + AFTER)
    true = with_true_file(app.sky, batches[BEFORE:])
    with Server(create_app(app)) as address:
        sent(address, batches[:BEFORE])
        poor, _ = latest_batches(browser, address)
        assert poor > 0.8 * AFTER

        page = f"{address}/spacecraft/TWO/calibration"
        browser.open(page)
        assert "has no calibration yet" in browser.run("found.innerText")
        browser.run("calibrate.elements.who.value = 'J. Operator'")
        browser.run("document.querySelector('#calibrate button').click()")
        browser.wait(lambda: "version=1" in browser.run("location.search"), 60)
        # The page is shown while the rest of it is still read.
        browser.wait(lambda: browser.run("document.readyState") == "complete")
        told = browser.run("found.innerText")
        assert "residuals over the focal plane" in told
        assert "absolute alignment" in told
        assert browser.run("document.querySelectorAll('.maps svg.focal-plane').length") >= 6
        assert "SECOND alignment z" in browser.run("document.getElementById('history').innerText")

        browser.run("document.querySelector('#try button').click()")
        browser.wait(lambda: not browser.run("trial.hidden"), 60)
        before, after = browser.run(CELLS.format(1))
        assert before > 0.8 * BEFORE
        assert after <= 1
        in_force = "document.getElementById('in-force').innerText"
        assert "the mission file" in browser.run(in_force)

        browser.run("document.querySelector('[data-adopt]').click()")
        told = browser.run("document.querySelector('dialog').innerText")
        assert "None of the" in told
        assert "put the former calibration back" in told
        assert faults(browser) == []
        browser.run(SIGN)
        browser.wait(lambda: "version 1" in browser.run(in_force))
        assert "J. Operator" in browser.run(in_force)
        for width, dark in ((1440, False), (400, True)):
            browser.open(f"{page}?version=1", width=width, dark=dark)
            assert browser.run("document.documentElement.scrollWidth") <= width
            assert faults(browser) == [], (width, dark)

        sent(address, batches[BEFORE:])
        good, ambiguous = latest_batches(browser, address)
        assert abs(good - true[0]) <= 1
        assert abs(ambiguous - true[1]) <= 2

        browser.open(page)
        browser.run("""document.querySelector('[data-revert=""]').click()""")
        browser.run(SIGN)
        browser.wait(lambda: "the mission file" in browser.run(in_force))
        shown = browser.run("document.getElementById('history').innerText")
        assert "History of calibrations" in shown
        browser.call("Page.navigate", url="about:blank")
    assert browser.complaints == []
