"""The page as markup: what it says, and what it does not let through."""

import re
from html.parser import HTMLParser

import httpx
import pytest

from service.operations import Operations
from service.settings import Settings
from service.times import parse_utc
from service.web.app import create_app
from service.web.dashboard.chart import chart_of, first_bucket
from tests.web.conftest import Server

HOSTILE = "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>{{7*7}}\u202e"
VOID = {"meta", "link", "input", "br", "img"}


class Markup(HTMLParser):
    """Elements with their attributes; fails on a tag that is closed out of turn."""

    def __init__(self, text):
        super().__init__()
        self.elements, self._open = [], []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag


@pytest.fixture
def empty(tmp_path):
    operations = Operations.open(Settings(database=f"sqlite:///{tmp_path}/acquire.db"))
    with Server(create_app(operations)) as address, httpx.Client(base_url=address) as client:
        yield client


def test_with_nothing_recorded_it_says_what_to_do(empty):
    answer = empty.get("/")
    assert answer.status_code == 200
    assert "No live batches yet" in answer.text
    assert "POST /api/v1/batches" in answer.text


def test_with_only_named_runs_it_leads_to_them(empty, batch):
    empty.post("/api/v1/batches", json=batch | {"run": "pass-7"}, timeout=60)
    text = empty.get("/").text
    assert "No live batches yet" in text
    assert '<a href="/?run=pass-7">pass-7</a> (1)' in text


def test_it_shows_chart_and_latest_batches_of_a_run(client, full_run):
    text = client.get(f"/?run={full_run}").text
    markup = Markup(text)
    assert text.count('class="plot"') == 2
    assert len([1 for tag, _ in markup.elements if tag == "tr"]) > 20
    assert "1999-03-01 (060) 00:" in text
    assert re.search(r"stars, \d+ ambiguous \([\d.]+ %\)", text)
    assert "no attitude" in text or "good" in text


def test_a_failed_solve_shows_no_attitude_at_all(client, post, batch, run):
    lone = batch["observations"][0] | {"stars": batch["observations"][0]["stars"][:1]}
    post(batch | {"run": run})
    later = {"time": "1999-03-01T05:00:00.000Z", "batch": "later", "observations": [lone]}
    post(batch | {"run": run} | later)
    text = client.get(f"/?run={run}").text
    latest = text[text.index("Latest batch ") : text.index("</p>", text.index("Latest batch "))]
    assert "05:00:00" in latest
    assert "no attitude" in latest
    assert "fewer than two unique stars" in latest
    assert "σ" not in latest


def test_names_of_clients_are_shown_as_they_are_and_do_nothing(client, post, batch, run):
    assert post(batch | {"batch": HOSTILE, "run": run}).status_code == 201
    text = client.get(f"/?run={run}").text
    tags = {tag for tag, _ in Markup(text).elements}
    assert "img" not in tags
    assert text.count("<script") == 1
    assert "&lt;script&gt;alert(1)" in text
    assert "{{7*7}}" in text


def test_nothing_comes_from_elsewhere_and_nothing_runs_in_place(client, full_run):
    answer = client.get(f"/?run={full_run}")
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    for tag, attributes in Markup(answer.text).elements:
        assert "style" not in attributes
        assert not [name for name in attributes if name.startswith("on")]
        for name in ("href", "src", "action"):
            assert attributes.get(name, "/").startswith("/"), (tag, attributes)


@pytest.mark.parametrize("file", ["page.css", "page.js", "icon.svg"])
def test_its_files_are_served(client, file):
    answer = client.get(f"/static/{file}")
    assert answer.status_code == 200
    assert "http://" not in answer.text.replace("http://www.w3.org/", "")
    assert answer.headers["X-Content-Type-Options"] == "nosniff"


def test_it_stays_small(client, full_run):
    assert len(client.get(f"/?run={full_run}").content) < 60_000


# ---- the chart -----------------------------------------------------------------------------------


def rates(start, observed, ambiguous, unmatched):
    return {"start": start, "observed": observed, "ambiguous": ambiguous, "unmatched": unmatched}


def test_an_hour_without_batches_is_a_gap_and_no_zero():
    found = [rates("1996-01-10T01:00:00Z", 10, 0, 0), rates("1996-01-10T05:00:00Z", 10, 5, 0)]
    chart = chart_of(found, parse_utc("1996-01-10T05:20:00Z"), "hour")
    assert len(chart.bars) == 2
    assert [round(bar.x / bar.width) for bar in chart.bars] == [1, 5]
    assert (chart.full_pct, chart.bars[1].ambiguous) == (60.0, pytest.approx(100 * 50 / 60))


def test_the_top_of_the_axis_is_never_below_the_highest_bar():
    for ambiguous in range(101):
        found = [rates("1996-01-10T05:00:00Z", 100, ambiguous, 0)]
        chart = chart_of(found, parse_utc("1996-01-10T05:20:00Z"), "hour")
        assert chart.bars[0].top <= 100.0
        assert chart.full_pct >= max(ambiguous, 1)


def test_batches_without_stars_have_no_share():
    found = [rates("1996-01-10T05:00:00Z", 0, 0, 0)]
    chart = chart_of(found, parse_utc("1996-01-10T05:20:00Z"), "hour")
    assert chart.bars[0].top == 0.0


def test_a_chart_reaches_back_four_days_of_hours_or_a_quarter_of_days():
    latest = parse_utc("1996-05-01T12:30:00Z")
    assert str(first_bucket(latest, "hour")) == "1996-04-27T13:00:00.000Z"
    assert str(first_bucket(latest, "day")) == "1996-01-31T00:00:00.000Z"
