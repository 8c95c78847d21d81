"""The console in a real browser, against the real server, with a replay at work."""

import json
import re
import time
from itertools import combinations, count

import httpx
import pytest

from service.app.factory import open_app
from service.times import parse_utc, shifted
from service.web.app import create_app
from service.web.console.formatting import completed_utc
from tests.fresh_databases import sqlite_at
from tests.storage.bulk import put, result_row
from tests.web.browser import CHROMIUM, Browser
from tests.web.fitting import CHARTS_DRAWN, assert_fits, faults
from tests.web.serving import Server, ended, in_process_settings

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")

CONNECTED = "document.getElementById('connection')?.dataset.state === 'live'"
DRAWN = "document.getElementById('charts')?.dataset.drawn !== undefined"

_numbers = count(1)


@pytest.fixture
def online_again(browser):
    """Whatever a test found, the browser is online for the next one."""
    yield
    browser.call("Network.emulateNetworkConditions", **OFFLINE | {"offline": False})
    browser.complaints.clear()


@pytest.fixture(scope="module")
def other_browser(chromium):
    with Browser(chromium) as browser:
        yield browser


def text(browser, selector="main"):
    return browser.run(f"document.querySelector({json.dumps(selector)})?.innerText ?? ''")


def shows(browser, wanted, selector="main"):
    browser.wait(lambda: wanted in text(browser, selector))


@pytest.fixture(scope="module")
def pages(client, full_run):
    found = client.get("/api/v1/batches", params={"run": full_run, "spacecraft": "XTE"}).json()[
        "items"
    ]
    return [
        "/?run=nobody",
        f"/compare?run={full_run}&spacecraft=XTE&a.identifier=starid&b.identifier=verified",
        "/batches/nothing",
        f"/batches/{found[0]['id']}",
        f"/batches/{found[0]['id']}?identifier=starid&tolerances.separation_deg=0.02",
    ]


def test_pages_of_a_batch_and_of_what_is_not_there_fit_and_have_no_fault(browser, address, pages):
    """Pages that need no id are looked at in `test_pages_in_browser`."""
    for page in pages:
        assert_fits(browser, f"{address}{page}")
    missing = [each for each in browser.complaints if "404" not in each]
    assert missing == []
    browser.complaints.clear()


def test_dark_and_light_follow_the_system_until_chosen(browser, address, full_run):
    ground = "getComputedStyle(document.body).backgroundColor"
    browser.open(f"{address}/?run={full_run}", dark=False)
    light = browser.run(ground)
    browser.open(f"{address}/?run={full_run}", dark=True)
    dark = browser.run(ground)
    assert light != dark
    browser.run("document.getElementById('theme').click()")
    assert browser.run(ground) == light
    browser.open(f"{address}/about", dark=True)
    assert browser.run(ground) == light
    browser.run("localStorage.removeItem('theme')")


def test_every_control_can_be_reached_by_keyboard_and_shows_it(browser, address, full_run):
    browser.open(f"{address}/spacecraft/XTE?run={full_run}")
    browser.wait(lambda: browser.run(DRAWN))
    browser.run("document.getElementById('more').open = true")
    wanted = {"Skip to the content", "Overview", "run", "theme", "More", "Zoom in", "by"}
    reached = set()
    # What other tests recorded is on the page, too: each alarm and note is a link more.
    for _ in range(200):
        if wanted <= reached:
            break
        browser.press("Tab")
        reached |= set(
            browser.run(
                "[document.activeElement.id, document.activeElement.textContent.trim(),"
                "document.activeElement.dataset?.chart ?? '']"
            )
        )
        assert browser.run(
            "getComputedStyle(document.activeElement).outlineStyle !== 'none'"
            "|| document.activeElement === document.body"
        )
    assert wanted <= reached
    assert "stars" in reached
    # The navigation is one stop; arrow keys go from page to page.
    browser.run("document.querySelector('nav a').focus()")
    browser.press("ArrowRight")
    assert browser.run("document.activeElement.textContent") == "Alarms"


BEFORE_THE_CHART = """(() => {
  const chart = document.querySelector("[data-chart]");
  const kinds = "a[href], button, input, select, textarea, summary, [tabindex]";
  return [...document.querySelectorAll(kinds)]
    .filter((each) => each.tabIndex >= 0 && !each.disabled && each.checkVisibility())
    .filter((each) => each.compareDocumentPosition(chart) & Node.DOCUMENT_POSITION_FOLLOWING)
    .map((each) => each.name || each.textContent.trim());
})()"""


def test_the_first_chart_is_ambiguity_and_few_controls_stand_before_it(browser, address, full_run):
    browser.open(f"{address}/spacecraft/XTE?run={full_run}", width=400)
    browser.wait(lambda: browser.run(DRAWN))
    assert browser.run("document.querySelector('[data-chart]').dataset.chart") == "stars"
    controls = browser.run(BEFORE_THE_CHART)
    assert len(controls) <= 8, controls
    # Four of them are above the chart; to share the view stands below it.
    assert controls[-5:] == ["range", "◀ Earlier", "Later ▶", "Compare with…", "More"]
    link = "document.querySelector('[data-copy]').getBoundingClientRect().top"
    assert browser.run(link) < 1000
    assert browser.run("document.querySelector('[data-chart]').getBoundingClientRect().top") < 500


def test_the_setting_that_would_help_is_named_on_the_page_of_the_spacecraft(
    browser, address, full_run
):
    browser.open(f"{address}/spacecraft/XTE?run={full_run}")
    browser.wait(lambda: browser.run(DRAWN))
    browser.run("document.querySelector('[data-part=best]').click()")
    shows(browser, "The one setting that would lower it", "#best")
    assert re.search(r"price|No single setting", text(browser, "#best"))
    assert browser.run("location.pathname") == "/spacecraft/XTE"
    # One of the other charts is drawn, or all.
    menu = "(menu => {{ menu.value = '{}'; menu.dispatchEvent(new Event('change')); }})"
    shown = (
        "[...document.querySelectorAll('#other-charts > section')].filter(e => !e.hidden).length"
    )
    assert browser.run(shown) > 1
    browser.run(menu.format("residual") + "(document.getElementById('other-chart'))")
    browser.wait(lambda: browser.run(shown) == 1)
    browser.run(menu.format("") + "(document.getElementById('other-chart'))")
    browser.wait(lambda: browser.run(shown) > 1)
    assert faults(browser) == []
    assert browser.complaints == []


def test_a_chart_zooms_and_pans_and_the_address_says_where(browser, address, full_run):
    stretch = "start=1999-060T00:00:00Z&end=1999-060T00:20:00Z"
    browser.open(f"{address}/spacecraft/XTE?run={full_run}&{stretch}")
    browser.wait(lambda: browser.run(DRAWN))
    bounds = "(({start, end}) => [start, end])(document.getElementById('stretch').dataset)"
    before = browser.run(bounds)
    browser.run("document.querySelector('[data-key=\"+\"]').click()")
    browser.wait(lambda: browser.run(bounds) != before)
    start, end = browser.run(bounds)
    assert before[0] < start < end < before[1]
    assert f"start={start.replace(':', '%3A')}" in browser.run("location.href")
    browser.run("document.querySelector('[data-chart]').focus()")
    browser.press("ArrowLeft")
    browser.wait(lambda: browser.run(bounds)[0] < start)
    browser.run("history.back()")
    browser.wait(lambda: browser.run(bounds) == [start, end])
    # What is drawn anew under the mouse ends a drag.
    browser.wait(lambda: browser.run(DRAWN))
    browser.drag("[data-chart=stars] .u-over", 0.25, 0.75)
    browser.wait(lambda: browser.run(bounds)[0] > start)
    assert browser.complaints == []


def test_every_chart_is_drawn_on_a_logarithmic_axis(browser, address, client, drawn, run):
    """Small and large values: uPlot leaves out most of the ticks of many decades."""
    for batch in drawn("SOHO", 24, cadence_s=600.0):
        batch["observations"][0]["stars"][0]["magnitude"] = 2.0
        assert client.post("/api/v1/batches", json=batch | {"run": run}).status_code == 201
    browser.open(f"{address}/spacecraft/SOHO?run={run}&y=log")
    browser.wait(lambda: browser.run(DRAWN))
    assert browser.complaints == []


SIGN = """(form => { form.elements.who.value = 'J. Operator';
    form.elements.comment.value = 'it is clear'; form.querySelector('.main').click(); })(
    document.querySelector('dialog form'))"""


def test_a_field_for_times_reads_a_time_as_the_service_reads_it(browser, address):
    browser.open(f"{address}/batches")
    read = "import('{}/static/times.js').then(times => times.typedTime({}).text)"
    for typed in (
        "1999-03-01 (060) 13:52:00",
        "1999-03-01 (060) 13:52",
        "1999-060/13:52:00.250",
        "1999/3/1 9:05 utc",
        "1999.060.13.52.07",
        "1999-03-01T13:52:00+01:30",
        "1999-060",
    ):
        found = browser.run(read.format(address, json.dumps(typed)))
        assert parse_utc(found) == parse_utc(completed_utc(typed)), typed


def test_a_bad_time_is_told_beside_its_field_and_the_form_is_kept(browser, address, full_run):
    browser.open(f"{address}/batches?run={full_run}")
    fill = "document.querySelector('[name={0}]').value = '{1}'"
    browser.run("document.querySelector('[name=outcome]').value = 'unique'")
    browser.run(fill.format("start", "yesterday"))
    browser.run("document.querySelector('main form:not([role])').requestSubmit()")
    assert "From must be UTC, such as" in text(browser, "main form:not([role])")
    assert browser.run("document.activeElement.name") == "start"
    assert faults(browser) == []
    browser.run(fill.format("start", "1999-03-02 12:00"))
    browser.run(fill.format("end", "1999-060"))
    browser.run("document.querySelector('main form:not([role])').requestSubmit()")
    assert "To must not be before From" in text(browser, "main form:not([role])")
    assert browser.run("document.querySelector('[name=outcome]').value") == "unique"
    browser.run(fill.format("start", "1999-02-28"))
    browser.run(
        "(picker => { picker.value = '1999-03-04T00:00:00';"
        "picker.dispatchEvent(new Event('input', {bubbles: true})); })"
        "(document.querySelectorAll('[data-picks]')[1])"
    )
    assert browser.run("document.querySelector('[name=end]').value").startswith("1999-03-04T00:00")
    browser.run("document.querySelector('main form:not([role])').requestSubmit()")
    browser.wait(lambda: "outcome=unique" in browser.run("location.search"))
    assert "start=1999-02-28T00%3A00%3A00Z" in browser.run("location.search")
    shows(browser, "Newest first")
    assert browser.complaints == []


PICK = "document.getElementById('beside-{}')"
KEYS = "[data-chart=stars] + .chart-keys"


SAVED = """(() => {
  HTMLAnchorElement.prototype.click = function () { window.saved = [this.download, this.href]; };
  window.written = []; window.drawn = 0;
  const pen = CanvasRenderingContext2D.prototype;
  for (const name of ["fillText", "stroke", "fill", "drawImage"]) {
    const draw = pen[name];
    pen[name] = function (...what) {
      if (name === "fillText") window.written.push(what[0]);
      else window.drawn += 1;
      return draw.apply(this, what);
    };
  }
})()"""


def test_the_first_chart_is_saved_as_a_picture_with_its_key(browser, address, full_run):
    browser.open(f"{address}/spacecraft/XTE?run={full_run}&beside=SOHO")
    browser.wait(lambda: browser.run(DRAWN))
    shows(browser, "SOHO: ambiguous stars", KEYS)
    browser.run(SAVED)
    browser.run("document.querySelector('[data-picture]').click()")
    name, file = browser.run("window.saved")
    assert name == f"XTE-Ambiguous-and-unmatched-stars-{full_run}.png"
    assert file.startswith("data:image/png;base64,")
    written = " ".join(browser.run("window.written"))
    assert f"XTE: Ambiguous and unmatched stars Run {full_run}, 1999-" in written
    assert "━ XTE: ambiguous stars ╌ XTE: unmatched stars ━ SOHO: ambiguous stars" in written
    # The mark of each line has the colour of the line.
    tones = browser.run(
        f"[...document.querySelectorAll('{KEYS} > * > span')].map(e => getComputedStyle(e).color)"
    )
    assert len(set(tones)) == 3
    assert browser.complaints == []


CHARTS = """[...document.querySelectorAll("main svg[role=img], main [data-chart]")]
    .filter(each => each.checkVisibility() && !each.closest("table"))"""


def test_every_chart_of_every_page_is_saved_in_the_same_way(browser, address, client, full_run):
    """The shapes of a chart are drawn, and its title, run, period and key are written."""
    query = {"run": full_run, "spacecraft": "XTE"}
    batch = client.get("/api/v1/batches", params=query).json()["items"][0]["id"]
    pages = [f"/batches/{batch}", "/spacecraft/XTE/period", "/spacecraft/XTE"]
    for page in pages:
        browser.open(f"{address}{page}?run={full_run}")
        browser.wait(lambda: browser.run(CHARTS_DRAWN))
        without = (
            f"{CHARTS}.filter(e => !e.closest('figure, section').querySelector('[data-picture]')"
        )
        assert (
            browser.run(f"{without} && !e.closest('section').querySelector('[data-picture]'))")
            == []
        )
        browser.run(SAVED)
        buttons = (
            "[...document.querySelectorAll('[data-picture]')].filter(e => e.checkVisibility())"
        )
        for k in range(browser.run(f"{buttons}.length")):
            browser.run(f"window.written = []; window.drawn = 0; {buttons}[{k}].click()")
            name, file = browser.run("window.saved")
            assert name.startswith("XTE-")
            assert name.endswith(f"-{full_run}.png")
            assert file.startswith("data:image/png;base64,")
            title, period, *words = browser.run("window.written")
            assert title.startswith("XTE")
            assert period.startswith(f"Run {full_run}, 1999-0")
            whole = f"{buttons}[{k}].closest('figure, section')"
            shapes = browser.run(f"{whole}.querySelectorAll('svg path, svg circle').length")
            assert browser.run("window.drawn") >= max(shapes, 1), (page, name)
            assert words or shapes == 0
    assert browser.complaints == []


def test_the_read_out_of_a_trend_has_the_value_of_every_line(browser, address, client, drawn, run):
    """Another spacecraft and the day before have batches at other times."""
    for name, day, second in (("XTE", "03-01", 0), ("SOHO", "03-01", 15), ("XTE", "02-28", 8)):
        for k, batch in enumerate(drawn(name, 20, seed=4)):
            time_of_day = f"00:{k // 2:02}:{second + 30 * (k % 2):02}"
            body = batch | {"batch": f"{name}-{day}-{k}", "time": f"1999-{day}T{time_of_day}Z"}
            client.post("/api/v1/batches", json=body | {"run": run}).raise_for_status()
    period = "start=1999-060T00:00:00Z&end=1999-060T00:10:00Z"
    browser.open(f"{address}/spacecraft/XTE?run={run}&beside=SOHO&before=day&{period}")
    browser.wait(lambda: browser.run(DRAWN))
    left, y, width = browser.run(
        "(b => [b.left, b.top + b.height / 2, b.width])"
        "(document.querySelector('[data-chart=stars] .u-over').getBoundingClientRect())"
    )
    for part in (0.2, 0.3, 0.4):
        place = {"x": left + part * width, "y": y}
        browser.call("Input.dispatchMouseEvent", type="mouseMoved", **place)
        read = text(browser, "[data-readout=stars]")
        for line in (r"UTC: XTE: ambiguous stars \d", r", SOHO: ambiguous stars \d"):
            assert re.search(line, read), read
        assert re.search(r", XTE: ambiguous stars, 1 d before \d", read), read
    # Where the pointer has left, the read-out keeps its height, and the chart its place.
    browser.open(browser.run("location.href"), width=400)
    browser.wait(lambda: browser.run(DRAWN))
    top = "document.querySelector('[data-chart=stars]').getBoundingClientRect().top"
    for x in (200, 210):
        place = {"x": x, "y": browser.run(top) + 90}
        browser.call("Input.dispatchMouseEvent", type="mouseMoved", **place)
    assert "1 d before" in text(browser, "[data-readout=stars]")
    before = browser.run(top)
    browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=5, y=5)
    browser.wait(lambda: "UTC: XTE" not in text(browser, "[data-readout=stars]"))
    assert abs(browser.run(top) - before) < 1
    assert browser.complaints == []


def test_a_point_of_a_trend_leads_to_its_batches_and_lines_can_be_hidden(
    browser, address, full_run
):
    browser.open(f"{address}/spacecraft/XTE?run={full_run}")
    browser.wait(lambda: browser.run(DRAWN))
    # Further spacecraft are picked from a list, several while it is open.
    browser.run("document.querySelector('#compare summary').click()")
    for name in ("SWAS", "SOHO"):
        browser.run(f"(box => {{ box.focus(); box.click(); }})({PICK.format(name)})")
        browser.wait(lambda name=name: f"beside={name}" in browser.run("location.search"))
    shows(browser, "Compare with… (2)", "#compare")
    assert browser.run("document.activeElement.id") == "beside-SOHO"
    shows(browser, "SWAS: ambiguous stars", KEYS)
    browser.run(f"{PICK.format('SWAS')}.click()")
    shows(browser, "Compare with… (1)", "#compare")
    browser.wait(lambda: "SWAS" not in text(browser, KEYS))
    assert "SOHO: ambiguous stars" in text(browser, KEYS)
    key = "document.querySelector('[data-chart=stars] + .chart-keys button')"
    assert "XTE: " in browser.run(f"{key}.innerText")
    browser.run(f"{key}.click()")
    assert browser.run(f"{key}.ariaPressed") == "false"
    browser.wait(lambda: browser.run(f"document.activeElement === {key}"))
    assert faults(browser) == []
    browser.run("document.querySelector('[data-chart=stars]').focus()")
    browser.press("Enter")
    browser.wait(lambda: "Batches from" in text(browser, "#charts-status"))
    browser.run("document.querySelector('#charts-status a').click()")
    browser.wait(lambda: browser.run("location.pathname") == "/batches")
    browser.wait(lambda: browser.run("document.querySelectorAll('#list tbody tr').length") >= 1)
    assert browser.complaints == []


def test_an_outlier_is_marked_at_the_edge_unless_all_values_are_asked_for(browser, tmp_path):
    app = open_app(in_process_settings(sqlite_at(tmp_path / "acquire.db")))
    begin = parse_utc("1999-03-01T00:00:00Z")
    rows = [
        result_row(
            app,
            shifted(begin, 300.0 * k),
            residual_rms_arcsec=900.0 if k == 100 else 2.0 + k % 3,
            status=None,
            reason="no_consistent_attitude",
        )
        for k in range(280)
    ]
    put(app, rows)
    readout = "[data-readout=residual]"
    label = "document.querySelector('[data-chart=residual]').getAttribute('aria-label')"
    with Server(create_app(app)) as url:
        browser.open(f"{url}/spacecraft/XTE")
        browser.wait(lambda: "▲ 1 beyond the edge, the farthest" in text(browser, readout))
        assert "greatest 900″" in browser.run(label)
        for y in ("all", "log"):
            choose = (
                "(field => { field.value = 'Y'; field.dispatchEvent(new Event('change',"
                " {bubbles: true})); })(document.querySelector('select[name=y]'))"
            )
            browser.run(choose.replace("Y", y))
            browser.wait(lambda y=y: f"y={y}" in browser.run("location.search"))
            browser.wait(lambda: "beyond the edge" not in text(browser, readout))
            assert faults(browser) == []
        browser.call("Page.navigate", url="about:blank")
    browser.complaints.clear()


def test_a_what_if_changes_what_becomes_of_an_ambiguous_star(browser, address, client, drawn):
    """Votes leave it ambiguous, verified identification names it; adopted, that stands."""
    run = f"try-{next(_numbers)}"
    found = ambiguous_by_votes(client, drawn, run)
    browser.open(f"{address}/batches/{found}")
    assert "▲ ambiguous" in text(browser, ".votes")
    before = text(browser, ".strip")
    browser.run("document.getElementById('w-identifier').focus()")
    browser.run(
        "(field => { field.value = 'verified';"
        "field.dispatchEvent(new Event('input', {bubbles: true})); })"
        "(document.getElementById('w-identifier'))"
    )
    shows(browser, "What-if, not recorded")
    assert "was ambiguous" in text(browser, ".votes")
    assert text(browser, ".strip") != before
    assert 'identifier = "verified"' in text(browser, "#toml")
    assert browser.run("document.activeElement.id") == "w-identifier"
    assert "identifier=verified" in browser.run("location.search")
    browser.run("document.querySelector('#outcome [data-adopt]').click()")
    told = text(browser, "dialog")
    assert "1 batch changes: unique stars" in told
    assert "To undo it" in told
    assert faults(browser) == []
    # Without a name nothing is sent.
    browser.run("document.querySelector('dialog .main').click()")
    assert found in browser.run("location.pathname")
    browser.run(SIGN)
    browser.wait(lambda: found not in browser.run("location.pathname"))
    shows(browser, "This is an adopted what-if")
    assert "ambiguous" not in text(browser, ".votes")
    assert client.get(f"/api/v1/batches/{found}").json()["current"] is False
    # The record of the adoption tells of it: no note that someone can delete.
    notes = client.get("/api/v1/annotations", params={"spacecraft": "XTE"}).json()["items"]
    assert not any("adopted" in each["text"] for each in notes)
    # Undone: the answer of the former is current again.
    browser.run("document.querySelector('.note [data-adopt]').click()")
    assert "▲ Fewer stars are identified" in text(browser, "dialog")
    browser.run(SIGN)
    browser.wait(lambda: "ambiguous" in text(browser, ".votes"))
    shows(browser, "This is an adopted what-if")
    browser.open(f"{address}/batches/{found}")
    shows(browser, "Not the current result.")
    shows(browser, "adopted by J. Operator")
    assert browser.complaints == []


def ambiguous_by_votes(client, drawn, run):
    """The id of a recorded batch in which votes tie for a star that verification names."""
    for each in drawn("XTE", 40, seed=2):
        asked = {"run": run, "options": {"identifier": "starid"}}
        answer = client.post("/api/v1/batches", json=each | asked).json()
        if not answer["counts"]["ambiguous"]:
            continue
        tried = client.post(
            f"/api/v1/batches/{answer['id']}/what-if", json={"options": {"identifier": "verified"}}
        ).json()
        if tried["counts"]["ambiguous"] == 0 and tried["counts"]["unique"] > 2:
            return answer["id"]
    raise AssertionError("no such batch was drawn")


def test_a_new_batch_appears_at_once_in_both_browsers(
    browser, other_browser, address, client, batch
):
    """Live, by the event stream; and a batch page that is open stays the batch it is."""
    run = f"two-{next(_numbers)}"
    for each in (browser, other_browser):
        each.open(f"{address}/?run={run}")
        assert f"No batches in run {run}" in text(each)
        each.wait(lambda each=each: each.run(CONNECTED))
    client.post("/api/v1/batches", json=batch | {"run": run}).raise_for_status()
    for each in (browser, other_browser):
        shows(each, batch["batch"])
    stripped = [re.sub(r"shown as of.*", "", text(each)) for each in (browser, other_browser)]
    assert stripped[0] == stripped[1]
    assert browser.complaints == other_browser.complaints == []


def test_a_lost_connection_is_told_and_what_was_missed_is_caught_up(
    browser, address, client, drawn, tmp_path
):
    """The server goes away and comes back with batches that nobody heard of."""
    settings = in_process_settings(sqlite_at(tmp_path / "acquire.db"))
    first, second, third = drawn("XTE", 3, seed=6)
    with Server(create_app(open_app(settings))) as own:
        port = int(own.rpartition(":")[2])
        httpx.post(f"{own}/api/v1/batches", json=first, timeout=60).raise_for_status()
        browser.open(f"{own}/")
        browser.wait(lambda: browser.run(CONNECTED))
        shows(browser, first["batch"])
    browser.wait(lambda: "Connection lost since" in text(browser, "#connection"))
    assert first["batch"] in text(browser)
    with Server(create_app(open_app(settings)), port) as own:
        for each in (second, third):
            httpx.post(f"{own}/api/v1/batches", json=each, timeout=60).raise_for_status()
        shows(browser, third["batch"])
        browser.wait(lambda: browser.run(CONNECTED))
    browser.open(f"{address}/about")
    browser.complaints.clear()


def test_dropped_in_the_middle_of_a_stream_of_batches_nothing_is_missed(
    browser, address, client, drawn
):
    run = f"drop-{next(_numbers)}"
    passed = drawn("XTE", 8, seed=9)
    client.post("/api/v1/batches", json=passed[0] | {"run": run}).raise_for_status()
    browser.open(f"{address}/batches?run={run}")
    browser.wait(lambda: browser.run(CONNECTED))
    for k, each in enumerate(passed[1:]):
        if k == 2:
            browser.call("Network.emulateNetworkConditions", **OFFLINE)
        client.post("/api/v1/batches", json=each | {"run": run}).raise_for_status()
    time.sleep(0.2)
    browser.call("Network.emulateNetworkConditions", **OFFLINE | {"offline": False})
    for each in passed:
        shows(browser, each["batch"])
    rows = browser.run("document.querySelectorAll('#list tbody tr').length")
    assert rows == len(passed)
    browser.complaints.clear()


def test_the_page_of_a_spacecraft_without_batches_works_and_shows_the_first_one(
    browser, address, client, batch
):
    """No script fails, and with the first batch its charts come."""
    run = f"first-{next(_numbers)}"
    browser.open(f"{address}/spacecraft/XTE?run={run}")
    shows(browser, f"No batches of XTE in run {run}")
    browser.wait(lambda: browser.run(CONNECTED))
    assert browser.complaints == []
    client.post("/api/v1/batches", json=batch | {"run": run}).raise_for_status()
    shows(browser, batch["batch"])
    browser.wait(lambda: browser.run(DRAWN))
    assert browser.complaints == []


def test_the_menu_of_runs_has_the_batches_that_the_page_has(browser, address, client, drawn):
    """Also those of another run; and a run that is chosen from it then is shown."""
    run, other = f"menu-{next(_numbers)}", f"menu-{next(_numbers)}"
    first, second = drawn("XTE", 2, seed=11)
    client.post("/api/v1/batches", json=first | {"run": run}).raise_for_status()
    browser.open(f"{address}/?run={run}")
    browser.wait(lambda: browser.run(CONNECTED))
    menu = "[...document.querySelectorAll('#run option')].map(each => each.textContent)"
    assert f"{run} (1)" in browser.run(menu)
    client.post("/api/v1/batches", json=first | {"run": other}).raise_for_status()
    client.post("/api/v1/batches", json=second | {"run": run}).raise_for_status()
    browser.wait(lambda: {f"{run} (2)", f"{other} (1)"} <= set(browser.run(menu)))
    assert browser.run("document.getElementById('run').value") == run
    browser.run(
        f"(menu => {{ menu.value = {json.dumps(other)};"
        "menu.dispatchEvent(new Event('change', {bubbles: true})); })"
        "(document.getElementById('run'))"
    )
    browser.wait(lambda: f"run={other}" in browser.run("location.search"))
    shows(browser, first["batch"])
    assert browser.complaints == []


RAW = ("Failed to fetch", "NetworkError", "Load failed", "Unexpected token")
"""What browsers call a request without an answer, and an answer that is no JSON."""


def test_where_the_service_does_not_answer_people_are_told_what_to_do(
    browser, address, client, drawn, online_again
):
    """On every page that asks for something: what happened, and what to do."""
    run = f"away-{next(_numbers)}"
    first, second = drawn("XTE", 2, seed=12)
    answer = client.post("/api/v1/batches", json=first | {"run": run}).json()

    def offline(is_offline):
        browser.call("Network.emulateNetworkConditions", **OFFLINE | {"offline": is_offline})

    def told(selector, *words):
        # What stood there before may say that the service does not answer, too.
        expected = ("does not answer", "check that it is running", *words)
        browser.wait(lambda: all(each in text(browser, selector) for each in expected))
        said = text(browser, selector)
        assert not [each for each in RAW if each in said], said

    browser.open(f"{address}/spacecraft/XTE?run={run}")
    browser.wait(lambda: browser.run(DRAWN))
    browser.wait(lambda: browser.run(CONNECTED))
    offline(True)
    click(browser, "[data-key='+']")
    told("#charts-status", "Not shown")
    browser.run("document.dispatchEvent(new CustomEvent('drawn'))")
    told("#charts-status", "The trends could not be read")
    offline(False)

    browser.open(f"{address}/batches/{answer['id']}")
    browser.wait(lambda: browser.run(CONNECTED))
    offline(True)
    browser.run("document.getElementById('try').requestSubmit()")
    told("#try-status", "Not computed")
    offline(False)

    browser.open(f"{address}/runs?run={run}")
    browser.wait(lambda: browser.run(CONNECTED))
    offline(True)
    click(browser, "[data-send]")
    told("#message", "Not done")
    offline(False)

    browser.open(f"{address}/batches?run={run}")
    browser.wait(lambda: browser.run(CONNECTED))
    # The stream goes on, and the page itself is not given.
    browser.run("window.fetch = () => Promise.reject(new TypeError('Failed to fetch')); 0")
    client.post("/api/v1/batches", json=second | {"run": run}).raise_for_status()
    told("#connection", "Not up to date", "trying again")
    browser.open(f"{address}/about")
    browser.complaints.clear()


WRITTEN = """(() => {
  window.written = [];
  const fillText = CanvasRenderingContext2D.prototype.fillText;
  CanvasRenderingContext2D.prototype.fillText = function (text, x, y, ...rest) {
    const size = this.measureText(text), at = this.getTransform().transformPoint({x, y});
    const chart = this.canvas.closest("[data-chart]")?.dataset.chart;
    const isLimit = /^(watch|warning|critical)/.test(text);
    // A limit belongs into the plot, a tick's label onto the canvas.
    const plot = this.canvas.parentElement.querySelector(".u-over");
    const s = devicePixelRatio, top = isLimit && plot ? plot.offsetTop * s : 0;
    const bottom = isLimit && plot ? top + plot.offsetHeight * s : this.canvas.height;
    window.written.push({
      chart, text, isLimit,
      left: at.x - size.actualBoundingBoxLeft,
      right: this.canvas.width - at.x - size.actualBoundingBoxRight,
      top: at.y - size.actualBoundingBoxAscent - top,
      bottom: bottom - at.y - size.actualBoundingBoxDescent,
    });
    return fillText.call(this, text, x, y, ...rest);
  };
})()"""


@pytest.mark.parametrize("width", [1440, 400])
@pytest.mark.parametrize(
    ("start", "end"),
    [
        ("1999-03-01T00:00:00.000Z", "1999-03-01T00:10:00.000Z"),
        ("1999-02-28T00:20:00.000Z", "1999-03-01T00:20:00.000Z"),
        ("1999-03-01T00:00:00.000Z", "1999-03-01T00:00:40.000Z"),
        ("1998-03-01T00:00:00.000Z", "1999-03-02T00:00:00.000Z"),
    ],
    ids=["minutes", "day", "seconds", "year"],
)
def test_no_label_of_a_chart_is_cut_off(browser, address, client, drawn, width, start, end):
    """Neither those of limits near the top nor those at the ends of the axes."""
    run = f"labels-{width}"
    for each in drawn("XTE", 20, seed=4):
        client.post("/api/v1/batches", json=each | {"run": run}).raise_for_status()
    every = "localStorage.setItem('other-chart', '');"
    added = browser.call("Page.addScriptToEvaluateOnNewDocument", source=every + WRITTEN)
    try:
        query = {"run": run, "start": start, "end": end}
        browser.open(str(httpx.URL(f"{address}/spacecraft/XTE", params=query)), width=width)
        browser.wait(lambda: browser.run(DRAWN))
        written = browser.run("written")
    finally:
        browser.call("Page.removeScriptToEvaluateOnNewDocument", **added)
        browser.run("localStorage.clear()")
    assert {"stars", "magnitude"} <= {each["chart"] for each in written}
    assert any(each["isLimit"] for each in written)
    sides = ("left", "right", "top", "bottom")
    cut = [each for each in written if min(each[side] for side in sides) < 0]
    assert cut == []


@pytest.mark.parametrize(("spacecraft", "stars"), [("SOHO", 12), ("SOHO", 40), ("IMAGER", 40)])
def test_no_label_of_a_star_stands_over_another_one(
    browser, address, client, drawn, spacecraft, stars
):
    """Every number is there; a name for which there is no room is left to the table."""
    (crowded,) = drawn(spacecraft, 1, seed=3, stars=stars)
    run = f"crowd-{spacecraft}-{stars}"
    answer = client.post("/api/v1/batches", json=crowded | {"run": run}).json()
    assert answer["counts"]["observed"] > 10
    browser.open(f"{address}/batches/{answer['id']}")
    boxes = browser.run(
        "[...document.querySelectorAll('.sky-chart .number, .sky-chart .name')].map(each => {"
        "const {x, y, width, height} = each.getBBox();"
        # A box holds the room above and below the letters, too.
        "return [each.textContent, x, y + 0.2 * height, x + width, y + 0.85 * height]; })"
    )
    numbers = [each[0] for each in boxes if each[0].isdigit()]
    assert numbers == [str(k + 1) for k in range(answer["counts"]["observed"])]
    assert len(boxes) > len(numbers) + 5
    over = [
        (a[0], b[0])
        for a, b in combinations(boxes, 2)
        if min(a[3], b[3]) > max(a[1], b[1]) and min(a[4], b[4]) > max(a[2], b[2])
    ]
    assert over == []
    assert browser.complaints == []


@pytest.mark.parametrize(
    ("page", "content"),
    [
        ("/spacecraft/XTE/files", "#attitudes + div tbody tr"),
        ("/advice/XTE", ".advice p, .advice li"),
        ("/docs", "#contents + dl a"),
        ("/batches/{}", "[aria-labelledby=trackers] tbody tr, .sky-chart, .note"),
        ("/alarms", "#alarms tbody tr, #alarms .empty"),
        ("/runs", "#runs tbody tr"),
        ("/about", "#well + div tbody tr"),
        ("/audit", "#list tbody tr, #list .empty"),
    ],
)
def test_content_begins_in_the_first_500_pixels_of_a_narrow_page(
    browser, address, client, full_run, page, content
):
    """Batches of each state, with the notes and warnings that stand above their star field."""
    states = {}
    for name in ("XTE", "SOHO") if "{}" in page else ():
        query = {"run": full_run, "spacecraft": name}
        for each in client.get("/api/v1/batches", params=query).json()["items"]:
            states[name, each["status"], each["counts"]["ambiguous"] > 0] = each["id"]
    for id in states.values() or [""]:
        browser.open(f"{address}{page.format(id)}?run={full_run}", width=400)
        first = f"[...document.querySelectorAll({json.dumps('main ' + content)})]"
        top = f"{first}.find(each => each.checkVisibility()).getBoundingClientRect().top"
        assert browser.run(top) < 500, text(browser)
    assert browser.complaints == []


def test_a_long_reason_leaves_room_for_the_other_columns(browser, address, client):
    note = {"start": "1999-03-01T00:10:00Z", "text": "Wheel 2 unloaded; " * 60 + "end", "who": "jb"}
    client.post("/api/v1/annotations", json=note).raise_for_status()
    browser.open(f"{address}/audit?action=annotation")
    shows(browser, "Wheel 2 unloaded")
    narrow = "[...document.querySelectorAll('#list td.wide')].filter(e => e.offsetWidth < 100)"
    assert browser.run(f"{narrow}.map(each => each.innerText)") == []


def test_settings_of_several_missions_are_folded_and_those_of_one_are_not(browser, address):
    opened = "[...document.querySelectorAll('[id^=settings-]')].filter(each => each.open).length"
    browser.open(f"{address}/missions", width=400)
    assert browser.run(opened) == 0
    browser.open(f"{address}/missions?spacecraft=XTE", width=400)
    assert browser.run(opened) == 1


OFFLINE = {"offline": True, "latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}


# ---- a shift: a replay that is watched -----------------------------------------------------------


@pytest.fixture(scope="module")
def watched(client, drawn):
    """A pass of XTE in which the a priori attitude goes wrong, replayed with alarms."""
    run = "watched"
    lines = "\n".join(json.dumps(each) for each in drawn("XTE", 160, seed=1))
    answer = client.post(
        "/api/v1/replays",
        params={"run": run, "alarms": "true"},
        content=lines,
        headers={"Content-Type": "application/x-ndjson"},
    )
    assert answer.status_code == 202
    return run, answer.headers["Location"]


SEND = """(form => {{ const files = new DataTransfer();
    files.items.add(new File([{}], 'pass.ndjson')); form.elements.file.files = files.files;
    form.querySelector('button').click(); }})(document.getElementById('replay'))"""


def test_a_replay_is_cancelled_and_continued_where_its_row_is(browser, address, batch):
    """The row leads to the form, with the run filled in; then it says that it was continued."""
    run = f"again-{next(_numbers)}"
    lines = "".join(json.dumps(batch | {"batch": f"{run}-{k}"}) + "\n" for k in range(20_000))
    browser.open(f"{address}/runs")
    browser.run(f"document.querySelector('#replay [name=run]').value = {json.dumps(run)}")
    browser.run(SEND.format(json.dumps(lines)))
    rows = (
        f"[...document.querySelectorAll('#runs tr')].filter(row => row.innerText.includes('{run}'))"
    )
    cancel = f"{rows}.map(row => row.querySelector('[data-send^=DELETE]')).find(Boolean)"
    again = f"{rows}.map(row => row.querySelector('a[href*=into]')).find(Boolean)"
    browser.wait(lambda: browser.run(f"!!{cancel}"))
    browser.run(f"{cancel}.click()")
    browser.wait(lambda: browser.run(f"!!{again}"))
    browser.run("document.querySelector('#replay').reset()")
    browser.run(f"{again}.click()")
    browser.wait(lambda: browser.run("document.querySelector('#replay [name=run]').value") == run)
    assert browser.run("document.activeElement.name") == "file"
    browser.run(SEND.format(json.dumps(lines[:1000].partition("\n")[0])))
    browser.wait(lambda: browser.run(f"{rows}.some(row => row.innerText.includes('continued '))"))
    assert not browser.run(f"!!{again}")
    assert browser.complaints == []


def test_replays_of_every_run_are_followed_where_they_are_listed(browser, address, client, batch):
    """The rows count lines and tell the end while live batches are the chosen run."""
    lines = "".join(json.dumps(batch | {"batch": f"followed-{k}"}) + "\n" for k in range(3_000))
    browser.open(f"{address}/runs")
    browser.wait(lambda: browser.run(CONNECTED))
    runs = [f"followed-{next(_numbers)}" for _ in range(2)]
    for run in runs:
        client.post(
            "/api/v1/replays",
            params={"run": run, "name": run},
            content=lines,
            headers={"Content-Type": "application/x-ndjson"},
        ).raise_for_status()
    row = (
        "[...document.querySelectorAll('#runs tr:has([data-name=lines])')]"
        ".find(each => each.innerText.includes('{}'))"
    )
    counted = {run: set() for run in runs}

    def is_over():
        for run in runs:
            shown = browser.run(f"{row.format(run)}?.querySelector('[data-name=lines]').innerText")
            counted[run].add(shown)
        return all(browser.run(f"!!{row.format(run)}?.innerText.includes('done')") for run in runs)

    browser.wait(is_over, 60)
    assert all(len(counted[run]) > 2 for run in runs), counted
    assert browser.run("location.search") == ""
    assert browser.complaints == []


def test_the_reason_why_a_replay_cannot_be_cancelled_stays_in_sight(
    browser, address, client, batch
):
    """The row dates from before the end of the replay; after the refusal it says the end."""
    run = f"over-{next(_numbers)}"
    lines = "".join(json.dumps(batch | {"batch": f"{run}-{k}"}) + "\n" for k in range(4_000))
    answer = client.post(
        "/api/v1/replays",
        params={"run": run, "name": run},
        content=lines,
        headers={"Content-Type": "application/x-ndjson"},
    )
    browser.open(f"{address}/runs", height=400)
    button = f"document.querySelector('[data-send=\"DELETE {answer.headers['Location']}\"]')"
    browser.wait(lambda: browser.run(f"!!{button}"))
    # A region with selected text is not drawn anew.
    browser.run(f"getSelection().selectAllChildren({button}.closest('tr').querySelector('th'))")
    ended(client, answer)
    browser.run(f"{button}.click()")
    browser.wait(lambda: "Not done: " in text(browser, "#message"))
    browser.run("getSelection().removeAllRanges()")
    browser.wait(lambda: browser.run(f"!{button}"))
    time.sleep(1.5)
    assert "Not done: " in text(browser, "#message")
    top, bottom = browser.run(
        "(b => [b.top, b.bottom])(document.getElementById('message').getBoundingClientRect())"
    )
    assert 0 <= top < bottom < 401
    browser.complaints.clear()


def test_a_shift_from_the_overview_to_the_star_and_the_alarm(browser, address, client, watched):
    """A spike is followed down to the stars; the alarm it raised is acknowledged and cleared."""
    run, replay = watched
    browser.open(f"{address}/?run={run}")
    browser.wait(lambda: client.get(replay).json()["state"] == "done", 60)
    shows(browser, "back in limits", "#run-state")
    shows(browser, "1999-060-0160", "#overview")

    click(browser, "#overview .spark-link[aria-label='XTE, trend of the last day']")
    browser.wait(lambda: "/spacecraft/XTE" in browser.run("location.href"))
    browser.wait(lambda: browser.run(DRAWN))
    said = browser.run("document.querySelector('[data-chart=stars]').getAttribute('aria-label')")
    assert re.search(r"unmatched stars: greatest \d+ % at 1999-03-01 \(060\)", said)
    click(browser, "#worst tbody a")
    browser.wait(lambda: "/batches/" in browser.run("location.pathname"))
    browser.wait(lambda: browser.run("document.readyState") == "complete")
    assert browser.run("document.querySelectorAll('.sky-chart .seen').length") >= 3
    assert browser.run("document.querySelectorAll('.sky-chart .seen:not(.unique)').length") >= 1

    browser.open(f"{address}/alarms?run={run}")
    rows = "[...document.querySelectorAll('#alarms tbody tr')].map(row => row.innerText)"
    (raised,) = [each for each in browser.run(rows) if "a priori" in each]
    assert "open" in raised
    assert "out now" not in raised
    browser.run(
        "[...document.querySelectorAll('#alarms tbody tr')]"
        ".find(row => row.innerText.includes('a priori')).querySelector('a').click()"
    )
    browser.wait(lambda: "/alarms/" in browser.run("location.pathname"))
    browser.wait(lambda: browser.run("!!document.getElementById('act-form')"))
    browser.wait(lambda: browser.run(CONNECTED))
    browser.run(
        "(form => { form.elements.who.value = 'J. Operator';"
        "form.elements.comment.value = 'slew at 00:30, as announced'; })"
        "(document.getElementById('act-form'))"
    )
    click(browser, "[data-act=acknowledge]")
    shows(browser, "acknowledged by J. Operator", "#alarm-history")
    shows(browser, "slew at 00:30, as announced", "#alarm-history")
    shows(browser, "cleared", "#alarm")
    places = browser.run(
        "[...document.querySelectorAll('#alarm-history a')].map(each => each.href)"
    )
    assert {httpx.get(place, timeout=60).status_code for place in places} == {200}
    browser.wait(lambda: browser.run("document.querySelector('[data-act=acknowledge]').disabled"))
    for page in (browser.run("location.pathname"), f"/alarms?run={run}&state=all"):
        browser.open(f"{address}{page}")
        assert faults(browser) == []
    assert browser.complaints == []


def test_acknowledged_but_still_out_of_limits_an_alarm_stays(browser, address, client, drawn):
    """Somebody knows of it; it is over only with a batch that is back in limits."""
    run, tight = "unwell", {"warning": {"high": 0.5}, "minimum_count": 1, "duration_s": 0}
    limit = "/api/v1/spacecraft/SOHO/limits/no_attitude_share"
    client.put(limit, json={"settings": tight, "who": "J. Operator"}).raise_for_status()
    client.put(f"/api/v1/runs/{run}", json={"alarms": True}).raise_for_status()
    (lone,) = drawn("SOHO", 1, stars=1)
    client.post("/api/v1/batches", json=lone | {"run": run}).raise_for_status()
    (alarm,) = client.get("/api/v1/alarms", params={"run": run}).json()["items"]

    browser.open(f"{address}/alarms/{alarm['id']}?run={run}")
    browser.wait(lambda: browser.run("!!document.getElementById('act-form')"))
    browser.wait(lambda: browser.run(CONNECTED))
    browser.run("document.getElementById('act-form').elements.who.value = 'J. Operator'; 0")
    click(browser, "[data-act=acknowledge]")
    shows(browser, "acknowledged by J. Operator", "#alarm-history")
    state = "document.getElementById('alarm').dataset.state"
    browser.wait(lambda: browser.run(state) == "acknowledged")
    assert "back in limits" not in browser.run("document.getElementById('alarm').innerText")

    settings = tight | {"warning": {"high": 1.0}}
    client.put(limit, json={"settings": settings, "who": "J. Operator"}).raise_for_status()
    following = drawn("SOHO", 2)[1]
    client.post("/api/v1/batches", json=following | {"run": run}).raise_for_status()
    browser.wait(lambda: browser.run(state) == "cleared")
    shows(browser, "back in limits", "#alarm")
    client.delete(limit, params={"who": "J. Operator"}).raise_for_status()
    assert browser.complaints == []


def test_a_limit_is_changed_on_its_page_and_kept_with_who_and_why(browser, address, client):
    browser.open(f"{address}/spacecraft/SWAS/limits")
    browser.wait(lambda: browser.run(CONNECTED))
    browser.run(
        "(form => { form.elements.who.value = 'J. Operator';"
        "form.elements.comment.value = 'crowded field'; })(document.getElementById('signed'))"
    )
    form = "document.querySelector('[data-limit=ambiguous_share]')"
    browser.run(f"{form}.elements['watch.high'].value = '20'")
    browser.run(f"{form}.requestSubmit()")
    shows(browser, "by J. Operator", "#ambiguous_share")
    shows(browser, "crowded field", "#ambiguous_share")
    limit = client.get("/api/v1/spacecraft/SWAS/limits/ambiguous_share").json()["limit"]
    assert limit["settings"]["watch"]["high"] == 0.2
    browser.run(f"{form}.elements['watch.high'].value = '90'")
    browser.run(f"{form}.requestSubmit()")
    shows(browser, "Not done", "#message")
    click(browser, "#ambiguous_share [data-default]")
    shows(browser, "as shipped", "#ambiguous_share")
    assert client.get("/api/v1/spacecraft/SWAS/limits/ambiguous_share").json()["limit"][
        "is_default"
    ]
    browser.complaints.clear()


def click(browser, selector):
    browser.wait(lambda: browser.run(f"!!document.querySelector({json.dumps(selector)})"))
    browser.run(
        f"(e => e.tagName === 'BUTTON' || e.tagName === 'A' ? e.click() : 0)"
        f"(document.querySelector({json.dumps(selector)}))"
    )


def test_a_new_critical_alarm_sounds_once_if_that_is_switched_on(browser, address):
    browser.open(f"{address}/alarms")
    rung = "Number(document.getElementById('sound').dataset.rung ?? 0)"
    alarm = {"id": "a", "run": "live", "state": "open", "current_severity": "critical"}

    def receive(**changed):
        data = json.dumps(json.dumps(alarm | changed))
        browser.run(
            "import('/static/live_updates.js').then(({ received }) => "
            f"received(new MessageEvent('alarm', {{data: {data}}})))"
        )

    browser.wait(lambda: browser.run(CONNECTED))
    receive()
    assert browser.run(rung) == 0
    # A browser makes no sound before somebody has clicked.
    browser.run("sound.scrollIntoView()")
    x, y = browser.run("(b => [b.x + 9, b.y + 9])(sound.getBoundingClientRect())")
    for kind in ("mousePressed", "mouseReleased"):
        browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
    # The click sounds once, so that one knows how.
    assert browser.run("[localStorage.sound, sound.textContent]") == ["on", "Sound on"]
    assert browser.run(rung) == 1
    receive(id="b", current_severity="warning")
    receive(id="b", run="another")
    assert browser.run(rung) == 1
    receive(id="b")
    receive(id="b")
    assert browser.run(rung) == 2
    receive(id="b", current_severity=None)
    receive(id="b")
    assert browser.run(rung) == 3
    browser.run("document.getElementById('sound').click()")
    receive(id="c")
    assert browser.run(rung) == 3
    assert browser.complaints == []


@pytest.mark.slow
def test_a_point_of_the_sky_leads_to_its_batch(browser, address, client, full_run):
    found = client.get("/api/v1/batches", params={"run": full_run, "spacecraft": "XTE"}).json()
    batches = {each["time"]: each["id"] for each in found["items"]}
    page = f"{address}/spacecraft/XTE/period?run={full_run}&range=day"
    browser.open(page)
    chart = "document.querySelector('.all-sky')"
    points = "JSON.parse(document.querySelector('#sky-figure [data-json]').content.textContent)"
    point = (
        f"(({{x, y}}) => [x, y])(new DOMPoint(...{points}[0].slice(0, 2))"
        f".matrixTransform({chart}.getScreenCTM()))"
    )
    browser.run(f"{chart}.scrollIntoView({{block: 'center'}})")
    x, y = browser.run(point)
    for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
        browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
    browser.wait(lambda: browser.run("location.pathname").startswith("/batches/"))
    assert browser.run("location.pathname.split('/')[2]") in batches.values()
    browser.open(page)
    browser.run(f"{chart}.focus()")
    browser.press("ArrowLeft")
    assert "Batch at " in text(browser, "#sky-status")
    browser.press("Enter")
    browser.wait(lambda: browser.run("location.pathname").startswith("/batches/"))
    newest = max(batches)
    assert browser.run("location.pathname.split('/')[2]") == batches[newest]
    assert browser.complaints == []
