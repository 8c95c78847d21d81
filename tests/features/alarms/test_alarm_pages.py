"""The pages of alarms: usual cause, related alarms, the named clock, the count on every page."""

import html
import re
from pathlib import Path

import httpx
import pytest

from service.app.factory import open_app
from service.features.alarms.part import Alarms
from service.trends.limits import LimitSettings
from service.trends.quantities import QUANTITIES, limited_names
from service.web.app import create_app
from service.web.console.formatting import with_day_of_year
from tests.fresh_databases import sqlite_at
from tests.storage import twin
from tests.web import fleet
from tests.web.serving import Server, in_process_settings

MEAN_OF_3 = {"minimum_count": 3, "duration_s": 0}
SIZE = 12
OPERATORS = Path(__file__).parents[3] / "docs" / "operators.md"


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
    guide = OPERATORS.read_text(encoding="utf-8")
    for known in map(QUANTITIES.get, limited_names()):
        assert f"| {known.label} | {known.cause.cause} | {known.cause.remedy} |" in guide


def test_the_page_of_an_alarm_says_why_and_what_to_do(fleet_client):
    alarm = alarm_of(fleet_client, "unmatched_share")
    text = text_of(fleet_client.get(f"/alarms/{alarm['id']}"))
    assert QUANTITIES["unmatched_share"].cause.cause in text
    assert QUANTITIES["unmatched_share"].cause.remedy in text
    assert "bound of" in text
    # The fifth of the six has the same quantity, and the others have other ones.
    others = set(fleet.troubled(SIZE)) - {alarm["spacecraft"]}
    related = text[text.index("may have the same cause") : text.index("telemetry time")]
    assert [name for name in sorted(others) if name in related] == [
        each for each in (fleet.troubled(SIZE)[0], fleet.troubled(SIZE)[4]) if each in others
    ]


def test_every_page_counts_the_open_alarms_in_header_and_title(fleet_client):
    for page in ("/", "/alarms", f"/spacecraft/{fleet.troubled(SIZE)[0]}"):
        answer = fleet_client.get(page)
        assert f"<title>◆ ({fleet.IN_TROUBLE}) " in answer.text, page
        assert f"{fleet.IN_TROUBLE} alarms open" in text_of(answer)
    assert "<title>◆" not in fleet_client.get("/", params={"run": "nobody"}).text


def test_telemetry_time_and_wall_clock_are_named(fleet_client):
    text = text_of(fleet_client.get("/alarms"))
    assert "last out of limits, telemetry UTC" in text
    alarm = alarm_of(fleet_client, "suspect_share")
    signed = {"who": "J. Operator", "comment": "seen"}
    address = f"/api/v1/alarms/{alarm['id']}"
    done = fleet_client.post(f"{address}/acknowledge", json=signed).json()
    moment = with_day_of_year(done["acknowledged"]["at"])
    page = text_of(fleet_client.get(f"/alarms/{alarm['id']}"))
    assert f"{moment} UTC, wall clock: acknowledged by J. Operator: seen" in page
    listed = text_of(fleet_client.get("/alarms")).replace(" ,", ",")
    assert f"by J. Operator {moment[:-3]}, wall clock" in listed


def test_alarms_are_filtered_sorted_and_grouped(fleet_client):
    def rows(**asked):
        page = fleet_client.get("/alarms", params=asked)
        assert page.status_code == 200, page.text
        return re.findall(r'data-name="spacecraft"><a href="/spacecraft/([\w-]+)"', page.text)

    assert set(rows()) == set(fleet.troubled(SIZE))
    assert rows(sort="spacecraft") == sorted(fleet.troubled(SIZE))
    assert rows(sort="spacecraft", descending="true") == sorted(fleet.troubled(SIZE))[::-1]
    found = fleet_client.get("/api/v1/alarms").json()["items"]
    critical = {each["spacecraft"] for each in found if each["severity"] == "critical"}
    assert set(rows(severity="critical")) == critical
    assert rows(state="returned") == []
    one = fleet.troubled(SIZE)[0]
    assert rows(spacecraft=one) == [one]
    text = text_of(fleet_client.get("/alarms", params={"group": "quantity"}))
    assert "unmatched stars: 2 alarms of 2 spacecraft" in text
    text = text_of(fleet_client.get("/alarms", params={"group": "time"}))
    assert "Left limits at 1999-03-01 (060) 20:00 UTC: 6 alarms of 6 spacecraft" in text


def test_wherever_an_alarm_is_shown_it_has_its_severity_of_now(tmp_path):
    """Three alarms that were critical: one is a warning now, one is back in limits."""
    app = open_app(in_process_settings(sqlite_at(tmp_path / "acquire.db")))
    for name, current, in_limits in (
        ("XTE", "critical", False),
        ("SWAS", "warning", False),
        ("SOHO", None, True),
    ):
        columns = {"severity": "critical", "current_severity": current}
        fleet.put_alarm(app, name, [("raised", 0), ("left_again", 1)], in_limits, **columns)
    with Server(create_app(app)) as address, httpx.Client(base_url=address) as client:
        found = {each["spacecraft"]: each for each in client.get("/api/v1/alarms").json()["items"]}
        assert {each["severity"] for each in found.values()} == {"critical"}
        text = text_of(client.get(f"/alarms/{found['XTE']['id']}"))
        related = text[text.index("may have the same cause") : text.index("Times out of limits")]
        assert re.search("warning SWAS", related.replace("▲", ""))
        assert "● back in limits SOHO" in related
        assert "critical" not in related
        for name, now in (("SWAS", "warning"), ("SOHO", "● back in limits")):
            strip = text_of(client.get(f"/alarms/{found[name]['id']}")).replace("▲ ", "")
            assert f"now {now}" in strip
            assert "worst so far ◆ critical" in strip
        # One that is back in limits is found by what it was.
        listed = client.get("/alarms", params={"severity": "critical"}).text
        shown = re.findall(r'data-name="spacecraft"><a href="/spacecraft/([\w-]+)"', listed)
        assert set(shown) == {"XTE", "SOHO"}


def test_an_alarm_that_went_out_again_shows_the_last_time_and_how_often(tmp_path):
    app = open_app(in_process_settings(sqlite_at(tmp_path / "acquire.db")))
    fleet.put_alarm(
        app,
        "XTE",
        [("raised", 0), ("returned", 1), ("left_again", 40), ("returned", 42)],
        in_limits=True,
    )
    with Server(create_app(app)) as address, httpx.Client(base_url=address) as client:
        text = text_of(client.get("/alarms")).replace("\u202f", " ")
        assert "1999-03-02 (061) 16:00 to 1999-03-02 (061) 18:00 2 3 h" in text
        (alarm,) = client.get("/api/v1/alarms").json()["items"]
        page = text_of(client.get(f"/alarms/{alarm['id']}")).replace("\u202f", " ")
        assert "Out of limits 2 times, 3 h in all" in page
        # It waits for an operator, but nothing is out of limits now.
        overview = client.get("/").text
        assert "<title>Overview" in overview
        assert "1 alarms returned" in text_of(client.get("/alarms"))


def limit(**bounds):
    return LimitSettings.model_validate(bounds | MEAN_OF_3)


def links(page, which, text="worst batch of these"):
    """Ids of the batches that a row of the page links with a text."""
    row = re.search(rf'<tr><th scope="row">{which}</th>.*?</tr>', page)[0]
    return re.findall(rf'href="/batches/(\w+)[^"]*">{text}</a>', row)


@pytest.mark.parametrize(
    ("quantity", "settings", "fault"),
    [
        ("residual_ratio", limit(warning={"high": 0.5}), {"noise_arcsec": (1.0, 9.0)}),
        ("magnitude_offset_mag", limit(warning={"low": -0.01}), {"offset_mag": -0.2}),
        ("unmatched_share", limit(warning={"high": 0.01}), {"noise_arcsec": (0.0, 200.0)}),
    ],
)
@pytest.mark.parametrize("tracker", [None, twin.SECOND])
def test_a_mean_says_of_how_many_and_links_the_batch_that_caused_it(
    opened, sky, missions, quantity, settings, fault, tracker
):
    """The one bad batch is older than the batch with which the mean left its limits."""
    mission = twin.twin(missions)
    app = opened(mission)
    limits = app.part(Alarms).limits
    limits.set("XTE", quantity, settings, who="jb")
    ids = {}

    def send(k, **wanted):
        answer = app.submissions.submit(
            twin.submission(sky, mission, f"b{k}", after_s=30.0 * k, **wanted)
        )
        ids[k] = answer.id

    send(0)
    send(2, **fault)
    send(4)
    with Server(create_app(app)) as address, httpx.Client(base_url=address) as client:

        def page():
            found = client.get("/api/v1/alarms").json()["items"]
            (id,) = (
                each["id"]
                for each in found
                if (each["quantity"], each["tracker"]) == (quantity, tracker)
            )
            return client.get(f"/alarms/{id}").text

        (raised,) = links(page(), "raised", "batch")
        assert raised == ids[4]
        # A late batch takes the place of the oldest.
        send(3)
        now = page()
        for which in ("raised", "worst", "latest"):
            assert links(now, which) == [ids[2]]
        assert now.count("mean of 3 batches") == 3
        assert f'href="/batches/{ids[2]}">worst batch</a>' in now
        # The comparison with the day before names causes.
        link = html.unescape(re.search(r'href="([^"]*)">Compare with the day before</a>', now)[1])
        assert link.endswith("#why-title")
        assert '<h2 id="why-title">Compared with the day before</h2>' in client.get(link).text
        # The mean that it was is not known any more: what there is stays linked.
        changed = settings.model_copy(update={"minimum_count": 4})
        limits.set("XTE", quantity, changed, who="jb")
        now = page()
        assert "mean of" not in now
        assert [links(now, which) for which in ("raised", "worst", "latest")] == [[], [], []]
        assert links(now, "raised", "batch") == [raised]


def test_the_list_shows_the_bound_of_the_severity_of_now(tmp_path):
    app = open_app(in_process_settings(sqlite_at(tmp_path / "acquire.db")))
    for name, now in (("XTE", "critical"), ("SWAS", "warning"), ("SOHO", "watch")):
        columns = {"severity": "critical", "current_severity": now, "bound": 0.5}
        fleet.put_alarm(app, name, [("raised", 0)], **columns)
    with Server(create_app(app)) as address, httpx.Client(base_url=address) as client:
        listed = client.get("/alarms").text
        bounds = re.findall(
            r'data-name="spacecraft"><a href="/spacecraft/([\w-]+)".*?data-name="bound">(\d+)',
            listed,
            re.DOTALL,
        )
        assert dict(bounds) == {"XTE": "50", "SWAS": "25", "SOHO": "15"}
        found = client.get("/api/v1/alarms").json()["items"]
        (eased,) = (each["id"] for each in found if each["spacecraft"] == "SOHO")
        text = text_of(client.get(f"/alarms/{eased}")).replace("\u202f", " ")
        assert (
            "worst severity so far, is 50.0 %; that of watch, the severity now, is 15.0 %" in text
        )


def test_another_alarm_is_related_for_a_stated_reason_alone(tmp_path):
    app = open_app(in_process_settings(sqlite_at(tmp_path / "acquire.db")))
    second = {"tracker": "STARTRACKER_2"}
    fleet.put_alarm(app, "XTE", [("raised", 0)], **second)
    fleet.put_alarm(app, "XTE", [("raised", 0.25)], quantity="suspect_share")
    fleet.put_alarm(app, "XTE", [("raised", 9)], quantity="ambiguous_share", **second)
    fleet.put_alarm(app, "XTE", [("raised", 9)], quantity="silence_s")
    fleet.put_alarm(app, "SWAS", [("raised", 0)])
    fleet.put_alarm(app, "SOHO", [("raised", 0.25)])
    with Server(create_app(app)) as address, httpx.Client(base_url=address) as client:
        found = client.get("/api/v1/alarms", params={"spacecraft": "XTE"}).json()["items"]
        (id,) = (each["id"] for each in found if each["quantity"] == "unmatched_share")
        page = client.get(f"/alarms/{id}").text
        related = page[page.index('id="related"') : page.index('id="times-out"')]
        rows = [text_of(httpx.Response(200, text=row)) for row in related.split("<li>")[1:]]
        assert len(rows) == 3
        reasons = (
            "same spacecraft, raised 15 min apart",
            "same tracker",
            "same quantity, same time",
        )
        for reason in reasons:
            assert any(reason in row.replace("\u202f", " ") for row in rows), rows
        assert "SOHO" not in related
