"""The page of the definitive attitude and its route: what the record says, and of nothing."""

import html
import re
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import httpx
import numpy as np
import pytest
from sqlalchemy import update

from service.app.factory import open_app
from service.attitude.definitive import Status
from service.features.definitive.charts import definitive_charts, direction_chart
from service.features.definitive.part import Definitive
from service.missions.mission import load_missions
from service.storage.sql.definitive_tables import graded_days
from service.times import parse_utc, shifted
from service.vectors import matrix_from_quaternion
from service.web.app import create_app
from service.web.console.charts.panels import TimeAxis
from tests.features.definitive.passes import GYRO, MODEL, NOON, mission_with, recorded_of
from tests.features.definitive.records import put_pass
from tests.features.definitive.simulated import ARCSEC, attitudes_of, gyro_of, slews, truth_of
from tests.fresh_databases import sqlite_at
from tests.waiting import wait_until
from tests.web.browser import CHROMIUM
from tests.web.fitting import assert_fits
from tests.web.markup import Markup
from tests.web.serving import Server, ended, in_process_settings

PAGE = "/spacecraft/XTE/grades"
ROUTE = "/api/v1/spacecraft/XTE/innovations"
SMOOTHED = {"run": "pass"}
WRONG = 120
"""This attitude of 226 is 300 arcsec off."""
in_browser = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")


def one_turned(attitudes, row, arcsec):
    q = attitudes.quaternion.copy()
    s, c = np.sin(0.5 * arcsec * ARCSEC), np.cos(0.5 * arcsec * ARCSEC)
    x, y, z, w = q[row]
    q[row] = [c * x + s * w, c * y + s * z, c * z - s * y, c * w - s * x]
    return replace(attitudes, quaternion=q)


@pytest.fixture(scope="module")
def address(tmp_path_factory, missions):
    """A service with half an hour at 1 Hz in two runs, of which one is smoothed."""
    rng = np.random.default_rng(11)
    truth = truth_of(slews, 1800.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    attitudes = attitudes_of(truth, np.arange(0, 1801, 8), (6.0, 6.0, 40.0), rng)
    attitudes = one_turned(attitudes, WRONG, 300.0)
    kept = (truth.time_s < 600.0) | (truth.time_s > 660.0)
    recorded = recorded_of(gyro.tai_ns[kept], gyro.rate_rad_s[kept], attitudes)
    database = sqlite_at(tmp_path_factory.mktemp("grades") / "acquire.db")
    mission = mission_with(missions["XTE"], gyro=GYRO)
    app = open_app(in_process_settings(database), mission)
    for run in ("pass", "bare"):
        put_pass(app, recorded, run=run)
    app.part(Definitive).days.smooth("XTE", run="pass")
    with Server(create_app(app)) as address:
        yield address


def text_of(page):
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", page)))


def figure(page, id):
    return page.partition(f'id="chart-{id}"')[2].partition("</figure>")[0]


def cells(page, id):
    """The rows of a chart's table of figures."""
    rows = re.findall(r"<tr><th scope=\"row\">.*?</tr>", figure(page, id))
    return [re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", row) for row in rows]


def arcsec(text):
    return float(text.rstrip("″").replace("−", "-"))


def test_sigmas_of_the_grades_are_those_of_the_record_raw_the_worst_smoothed_the_best(address):
    page = httpx.get(address + PAGE, params=SMOOTHED).raise_for_status().text
    Markup(page)
    for axis, raw, filtered, smoothed in cells(page, "sigma"):
        assert arcsec(raw) == pytest.approx(40.0 if axis == "z" else 6.0, rel=1e-3)
        assert arcsec(smoothed) < 0.9 * arcsec(filtered) < 0.5 * arcsec(raw)


def test_the_scale_of_sigmas_is_that_of_good_attitudes(tmp_path, missions):
    """Until the second of two attitudes five minutes apart, nothing is known of the bias."""
    rng = np.random.default_rng(11)
    truth = truth_of(slews, 1800.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    attitudes = attitudes_of(truth, np.arange(0, 1801, 300), (6.0, 6.0, 40.0), rng)
    mission = mission_with(missions["XTE"], gyro=GYRO)
    settings = in_process_settings(sqlite_at(tmp_path / "acquire.db"))
    app = open_app(settings, mission)
    try:
        put_pass(app, recorded_of(gyro.tai_ns, gyro.rate_rad_s, attitudes))
        app.part(Definitive).days.smooth("XTE")
        axis = TimeAxis(NOON, shifted(NOON, 1800.0))
        found = app.part(Definitive).days.of_period("XTE", "live", axis.start, axis.end)
        (chart,) = [each for each in definitive_charts(found, axis) if each.id == "sigma"]
    finally:
        app.close()
    sigma_arcsec = np.sqrt(found.samples["filtered"].covariance_arcsec2[:, [0, 3, 5]])
    assert sigma_arcsec.max() > 2000.0
    for panel in chart.panels:
        highest = re.search(r" to (\d+)", panel.note)
        assert float(highest[1]) < 100.0


def test_innovations_and_differences_scatter_about_as_their_bounds_say(address):
    page = httpx.get(address + PAGE, params=SMOOTHED).text
    for id in ("innovation", "difference"):
        for row in cells(page, id):
            assert float(row[3]) == pytest.approx(1.0, abs=0.2), (id, row)
    ((_, mean, inside, _),) = cells(page, "chi-square")
    assert float(mean) == pytest.approx(1.0, abs=0.2)
    assert float(inside.rstrip(" %")) > 90.0


def test_the_rejected_attitude_is_marked_and_counted(address):
    page = httpx.get(address + PAGE, params=SMOOTHED).text
    for id, panels in (("innovation", 3), ("difference", 3), ("chi-square", 1)):
        drawn = figure(page, id)
        assert drawn.count('class="rejected-at"') == panels
        assert [row[-1] for row in cells(page, id)] == ["1"] * panels
    assert "accepted" in text_of(page)
    assert 'data-name="rejected">1<' in page


def test_the_time_line_names_model_and_status_and_the_days_count_gaps(address):
    page = httpx.get(address + PAGE, params=SMOOTHED).text
    strips = page.partition('class="period-figure strips"')[2].partition("</figure>")[0]
    assert 'class="bar-gyro"' in strips
    assert 'class="bar-good"' in strips
    # The filtered grade begins as suspect.
    assert 'class="bar-suspect"' in strips
    assert 'data-name="gaps of the gyro">1<' in page


def test_what_is_drawn_is_bounded_however_long_the_period(address):
    page = httpx.get(address + PAGE, params=SMOOTHED | {"range": "60min"}).text
    steps = max(path.count("l") for path in re.findall(r' d="([^"]*)"', page))
    assert 200 < steps < 1300
    assert len(page) < 128_000
    year = httpx.get(address + PAGE, params=SMOOTHED | {"range": "year"}).raise_for_status()
    assert 'class="bar-gyro"' in year.text


def test_where_nothing_is_smoothed_the_page_says_so(address):
    page = httpx.get(address + PAGE, params={"run": "bare"}).raise_for_status().text
    assert "No definitive attitude in this period" in text_of(page)
    assert "<svg" not in page.partition('id="grades"')[2].partition("</main>")[0]
    none = httpx.get(address + PAGE, params={"run": "nothing"}).raise_for_status()
    assert "No batches of XTE in run nothing" in text_of(none.text)
    assert httpx.get(f"{address}/spacecraft/NONE/grades").status_code == 404


def test_the_page_of_the_spacecraft_leads_to_it(address):
    # A run without batches: those of the others are of attitudes alone.
    page = httpx.get(f"{address}/spacecraft/XTE", params={"run": "nothing"}).text
    assert re.search(r'href="/spacecraft/XTE/grades\?[^"]*run=nothing', page)


def test_the_route_gives_every_innovation_once_by_its_pages(address):
    found, url = [], f"{address}{ROUTE}?run=pass&limit=100"
    while url:
        answer = httpx.get(url).raise_for_status()
        found += answer.json()["items"]
        following = re.match(r'<([^>]*)>; rel="next"', answer.headers.get("Link", ""))
        url = address + following[1] if following else None
    assert len(found) == 226
    assert [k for k, each in enumerate(found) if each["outcome"] == "rejected"] == [WRONG]
    assert found[WRONG]["chi_square"] > 21.1
    assert found[WRONG]["innovation_arcsec"][0] == pytest.approx(300.0, abs=30.0)
    assert found[0]["innovation_arcsec"] is None


@pytest.mark.parametrize(
    ("asked", "status", "named"),
    [
        ({"cursor": "1.x"}, 422, "cursor"),
        ({"cursor": "9" * 100}, 422, "cursor"),
        ({"limit": 0}, 422, "limit"),
        ({"start": "yesterday"}, 422, "start"),
        ({"grade": "raw"}, 422, "grade"),
    ],
)
def test_the_route_names_what_is_wrong(address, asked, status, named):
    answer = httpx.get(address + ROUTE, params=asked)
    assert answer.status_code == status
    assert named in answer.text
    assert httpx.get(f"{address}/api/v1/spacecraft/NONE/innovations").status_code == 404


@in_browser
@pytest.mark.parametrize("run", ["pass", "bare"])
@pytest.mark.slow
def test_it_fits_and_axe_finds_no_fault(address, run, browser):
    assert_fits(browser, f"{address}{PAGE}?run={run}")
    assert browser.complaints == []
    browser.call("Page.navigate", url="about:blank")


@in_browser
def test_no_label_of_a_panel_stands_over_another_one(browser, address):
    browser.open(f"{address}{PAGE}?run=pass")
    boxes = browser.run(
        "[...document.querySelectorAll('.plot-axes')].map(plot => "
        "[...plot.querySelectorAll('text')].map(each => [each.getBBox().y, each.getBBox().height]))"
    )
    assert max(map(len, boxes)) > 2
    for labels in map(sorted, boxes):
        # A box holds the room above and below the letters, too.
        assert all(a + 0.8 * high <= b for (a, high), (b, _) in pairwise(labels)), labels
    sections = "[...document.querySelectorAll('section:has(.plot)')]"
    assert browser.run(f"{sections}.every(each => each.querySelector('[data-picture]'))")
    browser.call("Page.navigate", url="about:blank")


def test_no_line_of_the_boresight_crosses_the_wrap_at_360_degrees():
    app_axis = TimeAxis(NOON, shifted(NOON, 600.0))
    angle = np.radians(np.linspace(-20.0, 20.0, 401))
    # Body x turns about z through RA 0.
    quaternion = np.zeros((401, 4))
    quaternion[:, 2], quaternion[:, 3] = np.sin(angle / 2.0), np.cos(angle / 2.0)
    tracker = load_missions()["XTE"].trackers[0]
    samples = SimpleNamespace(
        tai_ns=NOON.tai_ns + np.arange(401, dtype=np.int64) * 1_500_000_000,
        status=np.full(401, int(Status.GOOD)),
        quaternion=quaternion,
    )
    found = SimpleNamespace(samples={"smoothed": samples}, is_gyro=np.ones(401, dtype=bool))
    chart = direction_chart(found, app_axis, tracker)
    ra, dec, roll = chart.panels
    assert [panel.axis for panel in chart.panels] == ["RA", "Dec", "roll"]
    (trace,) = ra.traces
    assert trace.line.count("M") == 2
    assert all(abs(int(step)) < 100 for step in re.findall(r"l\d+ (-?\d+)", trace.line))
    assert all(trace.line.count("M") == 1 for trace in (*dec.traces, *roll.traces))
    assert ra.ticks[-1][1].endswith("°")
    assert [text for _, text in app_axis.ticks()] == [f"12:0{minute}" for minute in (5,)]


def test_files_say_that_a_grade_falls_short_of_the_batches_and_jobs_link_their_files(
    tmp_path, missions
):
    rng = np.random.default_rng(11)
    truth = truth_of(slews, 7200.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    settings = in_process_settings(sqlite_at(tmp_path / "acquire.db"))
    app = open_app(settings, mission_with(missions["XTE"], gyro=GYRO))
    with Server(create_app(app)) as address, httpx.Client(base_url=address, timeout=60) as client:
        first = gyro.tai_ns < gyro.tai_ns[0] + 1800 * 10**9
        early = attitudes_of(truth, np.arange(0, 1800, 8), (6.0, 6.0, 40.0), rng)
        put_pass(app, recorded_of(gyro.tai_ns[first], gyro.rate_rad_s[first], early))
        jobs = "/api/v1/spacecraft/XTE/definitive-attitude"
        job = client.post(jobs, json={"who": "J. Operator"}).raise_for_status().json()
        wait_until(lambda: client.get(f"{jobs}/{job['id']}").json()["state"] == "done")
        page = client.get(PAGE).text
        days = [f"{shifted(NOON, hours * 3600.0).text[:10]}T00:00:00Z" for hours in (0, 24)]
        for field, day in zip(("start", "end"), days, strict=True):
            assert re.search(rf'name="{field}"[^>]* value="{day}"', page), page
        link = html.unescape(re.search(r'revision; <a href="([^"]+)">files</a>', page)[1])
        assert "make it again" not in client.get(link).text
        late = attitudes_of(truth, np.arange(6000, 6800, 8), (6.0, 6.0, 40.0), rng)
        put_pass(app, recorded_of(gyro.tai_ns[~first], gyro.rate_rad_s[~first], late))
        # The records of a pass are of their own time, before the attitude was made.
        assert "make it again" not in client.get(link).text
        early = update(graded_days).values(created=NOON.text)
        app.context.change(lambda connection: connection.execute(early))
        text = text_of(client.get(link).text)
        assert text.count("UTC: make it again") == 2, text


@in_browser
def test_a_chart_is_read_at_a_moment_and_zoomed_by_dragging(browser, address):
    browser.open(f"{address}{PAGE}?run=pass")
    plot = "#chart-direction [data-plot]"
    browser.run(f"document.querySelector('{plot}').focus()")
    browser.press("ArrowRight")
    note = "document.querySelector('#chart-direction [data-note]').textContent"
    moment, _, value = browser.run(note).partition(": ")
    shown = parse_utc(f"{NOON.text[:11]}{moment}.000Z")
    found = httpx.get(
        f"{address}/api/v1/spacecraft/XTE/attitude",
        params={
            "run": "pass",
            "grade": "smoothed",
            "start": shown.text,
            "end": shifted(shown, 2.0).text,
        },
    ).json()["items"][0]
    boresight = matrix_from_quaternion(found["quaternion"])[0]
    ra_deg = np.degrees(np.arctan2(boresight[1], boresight[0])) % 360.0
    assert float(re.match(r"smoothed ([\d.]+)°$", value)[1]) == pytest.approx(ra_deg, abs=0.3)
    others = browser.run("[...document.querySelectorAll('[data-note]')].map(e => e.textContent)")
    assert all(each.startswith(moment) for each in others)
    bounds = "(({start, end}) => (Date.parse(end) - Date.parse(start)) / 1000)(grades.dataset)"
    length_s = browser.run(bounds)
    browser.drag(plot, 0.25, 0.75)
    browser.wait(lambda: browser.run("location.search").count("start=") == 1)
    browser.wait(lambda: browser.run("document.readyState") == "complete")
    assert browser.run(bounds) == pytest.approx(0.5 * length_s, rel=0.03)
    # The files of the same period are a link away.
    browser.run("document.querySelector('#steps a[href*=\"/files\"]').click()")
    browser.wait(lambda: browser.run("location.pathname").endswith("/files"))
    browser.wait(lambda: browser.run("document.readyState") == "complete")
    links = browser.run("[...document.querySelectorAll('a[download]')].map(e => e.href)")
    smoothed = [each for each in links if "grade=smoothed" in each and "format=csv" in each]
    assert httpx.get(smoothed[0]).is_success
    assert browser.complaints == []
    browser.call("Page.navigate", url="about:blank")


@in_browser
def test_the_definitive_attitude_is_made_with_a_button_and_shows_its_progress(browser, address):
    page = f"{address}{PAGE}?run=bare"
    browser.open(page)
    body = "document.querySelector('main').innerText"
    assert "No definitive attitude in this period" in browser.run(body)
    browser.run("definitive.elements.who.value = 'J. Operator'")
    browser.run("document.querySelector('#definitive .main').click()")
    browser.wait(lambda: "Done: 1 of 1 days" in browser.run("message.innerText"), 120)
    browser.wait(lambda: "Segments and status" in browser.run(body))
    browser.wait(lambda: "by J. Operator: done, 1 of 1 days" in browser.run("jobs.innerText"))
    assert_fits(browser, page)
    api = f"{address}/api/v1/spacecraft/XTE"
    (job,) = httpx.get(f"{api}/definitive-attitude").json()["items"]
    assert (job["state"], job["done"], job["recorded"]) == ("done", 1, 1)
    found = httpx.get(f"{api}/attitude", params={"run": "bare", "grade": "smoothed"}).json()
    assert len(found["items"]) > 1000
    # What has not changed stays as it is; an unknown spacecraft and an unknown job are told.
    again = httpx.post(f"{api}/definitive-attitude", json={"run": "bare", "who": "J. Operator"})
    assert again.status_code == 202
    with httpx.Client(base_url=address) as client:
        assert ended(client, again)["recorded"] == 0
    assert httpx.get(f"{api}/definitive-attitude/nothing").status_code == 404


def test_a_mission_that_asks_for_it_gets_the_definitive_attitude_of_each_day(tmp_path, missions):
    mission = mission_with(missions["XTE"], smoothing={"daily": True})
    app = open_app(in_process_settings(sqlite_at(tmp_path / "acquire.db")), mission)
    try:
        midnight = parse_utc("1999-03-02T00:00:00Z")
        # The day before is complete two hours and ten minutes after its end.
        (early,) = app.part(Definitive).jobs.begin_due(shifted(midnight, 2 * 3600.0))
        (job,) = app.part(Definitive).jobs.begin_due(shifted(midnight, 2.5 * 3600.0))
        assert app.part(Definitive).jobs.begin_due(shifted(midnight, 12 * 3600.0)) == []
        assert early.end == "1999-03-01T00:00:00.000Z"
        assert (job.start, job.end) == ("1999-02-26T00:00:00.000Z", "1999-03-02T00:00:00.000Z")
        assert (job.who, job.spacecraft) == ("schedule", "XTE")
        wait_until(lambda: app.part(Definitive).jobs.get("XTE", job.id).state == "done")
    finally:
        app.close()
