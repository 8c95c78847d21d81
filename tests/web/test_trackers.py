"""A spacecraft with two trackers over HTTP: histories, limits, alarms and pages of each."""

import html
import json
import re

import httpx
import pytest

from service.app.factory import open_app
from service.web.app import create_app
from tests.fresh_databases import sqlite_at
from tests.storage.twin import FIRST, SECOND, batch, twin
from tests.web.conformance import check
from tests.web.markup import Markup
from tests.web.serving import Server, in_process_settings

HISTORY = "/api/v1/spacecraft/XTE/history"
WORST = "/api/v1/spacecraft/XTE/worst"
LIMITS = "/api/v1/spacecraft/XTE/limits"
QUICK = {"warning": {"high": 2.0}, "minimum_count": 3, "duration_s": 0}


@pytest.fixture(scope="module")
def client(tmp_path_factory, missions):
    database = sqlite_at(tmp_path_factory.mktemp("twin") / "acquire.db")
    app = create_app(open_app(in_process_settings(database), twin(missions)))
    with (
        Server(app) as address,
        httpx.Client(base_url=address, timeout=120, event_hooks={"response": [check]}) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def filled(client, sky, missions):
    """Twenty-four batches, of which the second tracker of the last ones is noisy; their answers."""
    body = {"settings": QUICK, "who": "J. Operator"}
    client.put(f"{LIMITS}/residual_ratio", json=body).raise_for_status()
    answers = []
    for k in range(24):
        noise = (1.0, 1.0) if k < 18 else (1.0, 9.0)
        text = batch(sky, twin(missions), f"b{k}", after_s=30.0 * k, noise_arcsec=noise)
        headers = {"Content-Type": "application/json"}
        answer = client.post("/api/v1/batches", content=text, headers=headers)
        answers.append(answer.raise_for_status().json())
    return answers


def test_a_history_of_a_tracker(client, filled):
    whole = client.get(HISTORY).raise_for_status().json()
    assert "tracker" not in whole
    means = {}
    for tracker in (FIRST, SECOND):
        shown = client.get(HISTORY, params={"tracker": tracker, "size": 1}).json()
        assert (shown["tracker"], shown["not_split"]) == (tracker, False)
        means[tracker] = shown["series"]["residual_ratio"]["mean"][0]
    assert means[SECOND] > 1.5 * means[FIRST]
    table = client.get(HISTORY, params={"tracker": SECOND, "format": "csv"}).raise_for_status()
    assert "a_priori_angle_deg" not in table.text.partition("\n")[0]
    assert table.text.count("\n") == 25


def test_the_worst_batches_of_a_tracker(client, filled):
    asked = {"tracker": SECOND, "by": "residual_ratio", "limit": 6}
    worst = client.get(WORST, params=asked).raise_for_status().json()
    assert worst["tracker"] == SECOND
    assert {each["batch"] for each in worst["items"]} <= {f"b{k}" for k in range(18, 24)}


@pytest.mark.parametrize(
    ("path", "asked", "field"),
    [
        (HISTORY, {"tracker": "none"}, "tracker"),
        (HISTORY, {"tracker": FIRST, "quantity": "batches_per_hour"}, "quantity"),
        (WORST, {"tracker": FIRST, "by": "a_priori_angle_deg"}, "by"),
        (LIMITS, {"tracker": "none"}, "tracker"),
        (f"{LIMITS}/silence_s", {"tracker": FIRST}, "tracker"),
    ],
)
def test_what_a_tracker_has_not_is_named(client, path, asked, field):
    answer = client.get(path, params=asked)
    assert answer.status_code == 422
    assert [each["field"] for each in answer.json()["errors"]] == [field]


def test_an_alarm_names_its_tracker_and_leads_to_its_trends(client, filled):
    alarms = client.get("/api/v1/alarms").raise_for_status().json()["items"]
    ratios = {each["tracker"]: each for each in alarms if each["quantity"] == "residual_ratio"}
    assert SECOND in ratios
    assert {None, FIRST, SECOND} >= set(ratios)
    page = client.get(f"/alarms/{ratios[SECOND]['id']}").raise_for_status().text
    assert f"residual over predicted, {SECOND}</h1>" in page
    assert 'data-chart="residual-ratio"' in page
    (trends,) = set(re.findall(r'href="(/spacecraft/XTE\?[^"]*tracker=[^"]*)"', page))
    assert client.get(html.unescape(trends)).status_code == 200
    assert f"residual over predicted, {SECOND}" in client.get("/alarms").text


def test_limits_of_a_tracker_over_http(client):
    body = {"settings": QUICK | {"warning": {"high": 7.0}}, "who": "J. Operator"}
    path, whose = f"{LIMITS}/residual_ratio", {"tracker": SECOND}
    answer = client.put(path, params=whose, json=body).raise_for_status().json()
    assert (answer["tracker"], answer["is_default"]) == (SECOND, False)
    shown = client.get(LIMITS, params=whose).raise_for_status().json()["items"]
    (ratio,) = (each for each in shown if each["quantity"] == "residual_ratio")
    assert ratio["settings"]["warning"]["high"] == 7.0
    assert client.get(path).json()["limit"]["tracker"] is None
    assert client.get(path).json()["limit"]["settings"]["warning"]["high"] != 7.0
    gone = client.delete(path, params=whose | {"who": "J. Operator"}).raise_for_status().json()
    assert gone["is_default"]


def test_the_page_of_limits_has_a_choice_of_tracker(client):
    body = {"settings": QUICK | {"warning": {"high": 7.0}}, "who": "J. Operator"}
    path, whose = f"{LIMITS}/residual_ratio", {"tracker": SECOND}
    client.put(path, params=whose, json=body).raise_for_status()
    shown = client.get("/spacecraft/XTE/limits", params=whose).raise_for_status().text
    Markup(shown)
    assert f"tracker={FIRST}" in shown
    assert 'data-limit="residual_ratio" data-spacecraft="XTE" data-tracker="' + SECOND in shown
    assert 'data-limit="silence_s"' not in shown
    assert 'inputmode="decimal" size="7" value="7"' in shown
    assert 'inputmode="decimal" size="7" value="7"' not in client.get("/spacecraft/XTE/limits").text
    assert client.get("/spacecraft/XTE/limits?tracker=none").status_code == 422
    client.delete(path, params=whose | {"who": "J. Operator"}).raise_for_status()


def test_the_page_of_a_batch_compares_trackers_and_names_the_one_that_disagrees(client, filled):
    outliers = {each["attitude"].get("outlier") for each in filled if each["attitude"]}
    assert SECOND in outliers
    for answer in filled:
        page = client.get(f"/batches/{answer['id']}").raise_for_status().text
        Markup(page)
        assert "Trackers side by side" in page
        named = answer["attitude"] and answer["attitude"].get("outlier")
        assert (f"{named} disagrees with the other trackers" in page) == bool(named)


def test_the_trends_page_has_a_choice_of_tracker(client, filled):
    page = client.get("/spacecraft/XTE").raise_for_status().text
    assert f"tracker={SECOND}" in page
    own = client.get("/spacecraft/XTE", params={"tracker": SECOND, "range": "day"})
    text = own.raise_for_status().text
    Markup(text)
    assert f"tracker={SECOND}" in text.partition('data-history="')[2].partition('"')[0]
    assert 'data-chart="residual"' in text
    assert 'data-chart="a-priori"' not in text
    charts = json.loads(
        text.partition("<template data-json>")[2]
        .partition("</template>")[0]
        .replace("&#34;", '"')
        .replace("&#39;", "'")
    )
    assert {each["tracker"] for each in charts["limits"]} == {SECOND}
