"""The pages of alarms: usual cause, related alarms, the named clock, the count on every page."""

import re
from pathlib import Path

import httpx
import pytest

from service.alarms.causes import CAUSES
from service.alarms.quantities import QUANTITIES, limited_names
from service.app.factory import open_app
from service.web.app import create_app
from service.web.console.charts.alarm_trend import HEIGHT, alarm_trend
from tests.fresh_databases import sqlite_at
from tests.web import fleet
from tests.web.serving import Server, in_process_settings

SIZE = 12
OPERATORS = Path(__file__).parents[2] / "docs" / "operators.md"


@pytest.fixture(scope="module")
def fleet_client(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fleet")
    missions = fleet.write_missions(folder / "missions", SIZE)
    app = open_app(in_process_settings(sqlite_at(folder / "acquire.db"), missions=missions))
    fleet.fill(app, SIZE)
    with Server(create_app(app)) as address, httpx.Client(base_url=address) as client:
        yield client


def alarm_of(client, quantity):
    found = client.get("/api/v1/alarms").json()["items"]
    return next(each for each in found if each["quantity"] == quantity)


def text_of(page):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page.text))


def test_every_limit_as_shipped_has_a_cause_and_the_guide_has_the_same():
    assert set(CAUSES) == set(limited_names())
    guide = OPERATORS.read_text(encoding="utf-8")
    for name, known in CAUSES.items():
        assert f"| {QUANTITIES[name].label} | {known.cause} | {known.remedy} |" in guide


def test_the_page_of_an_alarm_says_why_and_what_to_do(fleet_client):
    alarm = alarm_of(fleet_client, "unmatched_share")
    text = text_of(fleet_client.get(f"/alarms/{alarm['id']}"))
    assert CAUSES["unmatched_share"].cause in text
    assert CAUSES["unmatched_share"].remedy in text
    assert "bound of" in text
    # The fifth of the six has the same quantity, and the others have other ones.
    others = set(fleet.troubled(SIZE)) - {alarm["spacecraft"]}
    related = text[text.index("may have the same cause") : text.index("telemetry time")]
    assert [name for name in sorted(others) if name in related] == [
        each for each in (fleet.troubled(SIZE)[0], fleet.troubled(SIZE)[4]) if each in others
    ]


def test_every_page_counts_the_open_alarms_in_header_and_title(fleet_client):
    for page in ("/", "/alarms", "/zones", f"/spacecraft/{fleet.troubled(SIZE)[0]}"):
        answer = fleet_client.get(page)
        assert f"<title>({fleet.IN_TROUBLE}) " in answer.text, page
        assert f"{fleet.IN_TROUBLE} alarms open" in text_of(answer)
    assert "<title>(" not in fleet_client.get("/", params={"run": "nobody"}).text


def test_times_of_alarms_are_of_one_named_clock(fleet_client):
    for clock in ("telemetry", "receipt"):
        text = text_of(fleet_client.get("/alarms", params={"clock": clock}))
        assert f"raised, {clock} UTC" in text
        assert f"raised by {clock} time" in text
    assert fleet_client.get("/alarms", params={"clock": "sundial"}).status_code == 422


def test_the_small_trend_joins_what_is_regular_and_leaves_gaps():
    drawn = alarm_trend(
        [0.0, 600.0, 1200.0, 6000.0, 6600.0],
        [0.1, 0.2, 0.3, 0.4, None],
        start_s=0.0,
        end_s=7200.0,
        step_s=60.0,
        bound=0.25,
        raised_s=1200.0,
    )
    assert drawn.path.count("M") == 2
    assert drawn.path.count("L") == 2
    assert 0 < drawn.bound_y < HEIGHT
    empty = {"start_s": 0.0, "end_s": 1.0, "step_s": 1.0, "bound": 1.0, "raised_s": 0.0}
    assert alarm_trend([0.0], [None], **empty) is None
