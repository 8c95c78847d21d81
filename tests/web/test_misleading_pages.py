"""What the console says first is what holds now: the run, the worst alarm, the nearest batch."""

import json
import re
from dataclasses import replace
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
from msgspec import structs

from service.app.factory import open_app
from service.contract.spacecraft import WindowCounts
from service.features.definitive.part import Definitive
from service.observations.telemetry import read_lines
from service.storage.queries.fleet_rows import DayCounts, FleetRow, TrackerCounts
from service.storage.queries.results import answer_from_json
from service.times import parse_utc, shifted
from service.trends import quantities
from service.web.app import create_app
from service.web.console import formatting
from service.web.console.formatting import arcsec
from service.web.console.pages.batch import adoption
from tests.waiting import wait_until
from tests.web import fleet
from tests.web.console_pages import console_addresses
from tests.web.markup import Markup
from tests.web.serving import Server, in_process_settings


def text_of_part(html):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html))


def text_of(answer):
    Markup(answer.raise_for_status().text)
    return text_of_part(answer.text)


@pytest.fixture(scope="module")
def small_fleet(chosen_database, tmp_path_factory):
    """A service of eight spacecraft and its client."""
    missions = fleet.write_missions(tmp_path_factory.mktemp("fleet") / "missions", 8)
    app = open_app(in_process_settings(chosen_database(), missions=missions))
    fleet.fill(app, 8)
    with Server(create_app(app)) as url, httpx.Client(base_url=url, timeout=60) as client:
        yield app, client


# ---- the chosen run ------------------------------------------------------------------------------

OF_NO_RUN = ("/static/", "/api/", "/metrics", "/readyz", "#")


def test_no_link_of_any_page_changes_the_chosen_run(client, post, batch, full_run):
    """Save those whose text names the other run, and the list of runs."""
    for address in console_addresses():
        if address == "/runs":
            continue
        page = client.get(f"{address}?run={full_run}").text
        for href, text in re.findall(r'<a [^>]*href="([^"]*)"[^>]*>(.*?)</a>', page, re.DOTALL):
            if href.startswith(OF_NO_RUN):
                continue
            asked = parse_qs(urlsplit(href.replace("&amp;", "&")).query).get("run", ["live"])
            named = re.sub(r"<[^>]+>", "", text).strip()
            assert asked == [full_run] or asked == [named], (address, href, named)


def test_comparing_runs_waits_until_a_second_run_is_chosen(client, full_run):
    page = client.get("/compare").text
    assert 'data-run="live"' in page
    assert f"<option>{full_run}</option>" in page
    assert "runs-outcome" not in page


def cell_of(page, name, column):
    """The text of a column of a spacecraft's row in the overview."""
    row = re.search(rf'<tr[^>]*>(?:(?!</tr>).)*/{name}"(?:(?!</tr>).)*</tr>', page, re.DOTALL)
    return text_of_part(re.search(rf'class="c-{column}">(.*?)</td>', row[0], re.DOTALL)[1]).strip()


# ---- alarms --------------------------------------------------------------------------------------


def test_of_several_alarms_the_one_that_is_worst_now_stands_for_all(small_fleet):
    """An alarm that was critical once and is a warning now comes behind the critical ones."""
    app, client = small_fleet
    name = "SAT-000"
    was = {"quantity": "ambiguous_share", "severity": "critical", "current_severity": "warning"}
    fleet.put_alarm(app, name, [("raised", 1.0)], **was)
    for k, hour in enumerate((2.0, 3.0)):
        of = {"quantity": "suspect_share", "tracker": f"STARTRACKER_{k + 1}"}
        fleet.put_alarm(app, name, [("raised", hour)], **of)
    text = cell_of(client.get("/").text, name, "alarms")
    assert "critical batches with a suspect attitude, STARTRACKER_2" in text
    assert "+2" in text
    items = client.get("/api/v1/overview").json()["items"]
    (item,) = [each for each in items if each["name"] == name]
    shown = [(each["current_severity"], each["raised"]["time"][11:13]) for each in item["alarms"]]
    assert shown == [("critical", "03"), ("critical", "02"), ("warning", "01")]


def test_of_equal_alarms_the_one_far_beyond_its_limit_stands_before_a_newer_one(small_fleet):
    """A tracker whose stars go wrong comes before a healthy one that they draw along."""
    app, _ = small_fleet
    for hour, tracker, value in ((2.0, "STARTRACKER_1", 8.0), (3.0, "STARTRACKER_2", 1.2)):
        worst = {f"{which}_value": value for which in ("latest", "worst")}
        fleet.put_alarm(app, "SAT-002", [("raised", hour)], tracker=tracker, bound=1.0, **worst)
    found = app.spacecraft.overview(spacecraft=["SAT-002"]).items
    (item,) = [each for each in found if each.name == "SAT-002"]
    assert [each.tracker for each in item.alarms][:2] == ["STARTRACKER_1", "STARTRACKER_2"]


def test_the_overview_of_a_run_without_limits_says_that_its_alarms_are_off(client, full_run):
    for is_on in (True, False):
        client.put(f"/api/v1/runs/{full_run}", json={"alarms": is_on}).raise_for_status()
        text = text_of(client.get("/", params={"run": full_run}))
        assert ("limits are not evaluated: alarms of this run are off" in text) is not is_on
        assert ("alarms out of limits:" in text) is is_on


def test_the_list_of_alarms_begins_with_the_worst_now(small_fleet):
    app, client = small_fleet
    value = {f"{which}_value": 99.0 for which in ("latest", "worst")}
    fleet.put_alarm(app, "SAT-003", [("raised", 0.5)], bound=1.0, severity="critical", **value)
    page = client.get("/alarms").raise_for_status().text
    shown = re.findall(r'href="/alarms/([0-9A-Z]{26})"', page)
    first, *_ = app.spacecraft.alarms("live")
    assert next(each for each in shown if each) == first.id


# ---- finding a batch by its time -----------------------------------------------------------------


@pytest.mark.parametrize(
    "typed",
    [
        "1999-03-01T12:00:00Z",
        "1999-03-01T12:00:00",
        "1999-03-01 12:00",
        "1999-060T12:00:00.000Z",
        "1999-060 12:00",
        " 1999-03-01 12:00:00 utc ",
        "1999-03-01 (060) 12:00:00",
        "1999-03-01 (060) 12:00",
        "1999/060/12:00:00",
        "1999.060.12.00.00",
        "1999:060:12:00:00.000",
        "060/12:00",
        "03-01 12:00",
        "12:00",
        "1 Mar 1999 12:00",
        "01-MAR-1999 12:00:00.000",
        "March 1, 1999 12:00 GMT",
        "1999 Mar 01 12:00",
        "19990301T120000Z",
        "1999-03-01T13:00+01:00",
    ],
)
def test_a_time_in_any_common_form_finds_the_batch(small_fleet, typed):
    _, client = small_fleet
    page = text_of(client.get("/batches", params={"find": typed, "spacecraft": "SAT-001"}))
    assert "A batch at 1999-03-01 (060) 12:00:00 UTC" in page


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("300/12:00", "1998-300T12:00:00Z"),
        ("12-01 05:00", "1998-12-01T05:00:00Z"),
        ("061/01:00", "1999-061T01:00:00Z"),
        ("09:40", "1999-03-01T09:40:00Z"),
        ("04:40", "1999-03-02T04:40:00Z"),
    ],
)
def test_a_time_without_its_year_or_day_is_the_last_such_time(typed, meant):
    """Asked of the record, the time is past: it is no later than the latest batch."""
    assert formatting.completed_utc(typed, parse_utc("1999-03-02T05:12:00Z")) == meant


def test_a_time_finds_the_nearest_batch_of_every_spacecraft_if_none_is_chosen(small_fleet):
    _, client = small_fleet
    page = client.get("/batches", params={"find": "1999-03-01 12:00"})
    assert "8 batches at 1999-03-01 (060) 12:00:00 UTC" in text_of(page)
    rows = re.findall(
        r'<th scope="row"><time datetime="([^"]*)".*?/spacecraft/([^?"]*)', page.text, re.S
    )
    assert sorted(rows, key=lambda each: each[1]) == [
        ("1999-03-01T12:00:00.000Z", name) for name in fleet.names(8)
    ]
    page = client.get("/batches", params={"find": "1999-03-01 12:10"})
    assert "the nearest is 10 min earlier" in text_of(page)
    assert {name for name in fleet.names(8) if f"/spacecraft/{name}" in page.text} == {
        *fleet.names(8)
    }


def test_a_time_without_a_batch_finds_the_nearest_and_says_how_far_it_is(small_fleet):
    _, client = small_fleet
    before_all = shifted(fleet.END, -2 * 86_400.0).text
    for typed, said in (
        ("1999-03-01 12:10", "10 min earlier"),
        ("1999-03-01 12:20", "10 min later"),
        ("1999-03-05", "3 d earlier"),
        (before_all, "1 d later"),
    ):
        page = text_of(client.get("/batches", params={"find": typed, "spacecraft": "SAT-001"}))
        assert f"the nearest is {said}" in page, page
    assert parse_utc(before_all).tai_ns < fleet.END.tai_ns


def test_each_time_that_the_overview_writes_finds_its_batch(small_fleet):
    """Also those without a year."""
    _, client = small_fleet
    times = re.findall(r"<time [^>]*>([^<]*)</time>", client.get("/").text)
    assert {len(each) for each in times} >= {len("1999-03-01 (060) 12:00"), len("03-01 12:00")}
    for typed in set(times):
        found = text_of(client.get("/batches", params={"find": typed}))
        assert re.search(
            r"(A batch|\d batches) at 1999|the nearest is .* (earlier|later)", found
        ), typed


@pytest.mark.parametrize("typed", ["2026-330-0179", "060", "12-1", "a 12:00", "1999-02-30 12:00"])
def test_an_id_that_looks_like_a_time_is_an_id(small_fleet, typed):
    page = text_of(small_fleet[1].get("/batches", params={"find": typed}))
    assert "No run has a batch with this id, and it is no time in UTC" in page


def test_what_the_example_in_a_field_shows_is_read_as_it_stands(client, full_run):
    """Every time in a placeholder of the filters, without any script."""
    for address in ("/batches", "/annotations", "/compare"):
        page = client.get(address, params={"run": full_run}).text
        pattern = r'name="(start|end|find)"[^>]*placeholder="([^"]*\d)"'
        for name, example in re.findall(pattern, page):
            for typed in example.split(" or "):
                answer = client.get(address, params={"run": full_run, name: typed})
                assert answer.status_code == 200, (address, name, typed)


# ---- the state of a spacecraft -------------------------------------------------------------------


def test_a_state_names_the_worst_of_attitude_tracker_alarms_and_freshness():
    """A latest batch with a good attitude alone makes no spacecraft good."""
    counts = {"observed": 10, "unique": 5, "ambiguous": 0, "unmatched": 5}
    hour = WindowCounts(start="", end="", batches=60, solved=60, suspect=59, **counts)
    row = FleetRow(
        name="X",
        description="",
        retired=False,
        state="good",
        alarms=(),
        trackers=(TrackerCounts("A", 5, 5), TrackerCounts("B", 5, 5)),
        age_s=0.0,
        received_age_s=60.0,
    )
    blind = (TrackerCounts("A", 5, 5), TrackerCounts("B", 5, 0))
    for changed, words in (
        ({}, []),
        ({"trackers": blind}, ["B 0 of 5"]),
        ({"last_hour": hour}, ["suspect in 59 of 60 of the last hour"]),
        ({"received_age_s": 7200.0}, ["silent"]),
        ({"state": "no_attitude"}, ["no attitude"]),
        (
            {"trackers": blind, "last_hour": hour, "received_age_s": 7200.0},
            ["silent", "B 0 of 5", "suspect in 59 of 60 of the last hour"],
        ),
    ):
        assert [each.words for each in replace(row, **changed).faults] == words


def test_overview_page_title_and_api_agree_on_the_state_of_a_spacecraft(small_fleet):
    """A good latest batch beside an open critical alarm is no good spacecraft."""
    app, client = small_fleet
    good = next(each for each in fleet.names(8) if each not in fleet.troubled(8))
    fleet.put_alarm(app, good, [("raised", 23.0)], severity="critical", current_severity="critical")
    rows = client.get("/api/v1/overview").json()["items"]
    listed = client.get("/api/v1/spacecraft").json()["items"]
    overview = client.get("/").text
    words = {}
    for row, state in zip(rows, listed, strict=True):
        name = row["name"]
        own = client.get(f"/api/v1/spacecraft/{name}").json()
        each = [[fault["words"] for fault in of["faults"]] for of in (row, state, own)]
        assert each[0] == each[1] == each[2]
        words[name] = each[0] or [row["state"].replace("_", " ")]
        page = client.get(f"/spacecraft/{name}")
        assert re.search(rf"<title>◆ \(\d+\) {name}: {words[name][0]} · ", page.text)
        if row["latest_batch"]:
            assert words[name][0] in cell_of(overview, name, "worst")
    assert words[good] == ["critical alarm"]
    shown = text_of(client.get(f"/spacecraft/{good}"))
    assert "● good" not in shown[: shown.index("Latest batch")]


def test_the_alarm_of_the_shown_tracker_comes_first_and_says_how_many_more(small_fleet):
    app, client = small_fleet
    name = fleet.names(8)[-1]
    for tracker, severity in (("STARTRACKER_1", "warning"), ("STARTRACKER_2", "critical")):
        of = {"quantity": "suspect_share", "severity": severity, "current_severity": severity}
        fleet.put_alarm(app, name, [("raised", 20.0)], tracker=tracker, **of)
    for asked, first in (({}, "critical"), ({"tracker": "STARTRACKER_1"}, "warning")):
        page = client.get(f"/spacecraft/{name}", params=asked).text
        state = text_of_part(re.search(r'<p id="state".*?</p>', page, re.DOTALL)[0])
        tracker = asked.get("tracker", "STARTRACKER_2")
        assert re.search(rf"{first} batches with a suspect attitude, {tracker} \+\d more", state)
        assert "critical" in state


def test_a_rate_says_how_far_it_is_from_yesterdays_and_on_how_many_stars():
    """Against counts by hand: 3 of 100 stars after 10 of 200."""
    days = DayCounts(100, 3, 200, 10)
    assert days.points == pytest.approx(-2.0)
    assert DayCounts(100, 3, 0, 0).points is None
    assert DayCounts(0, 0, 200, 10).points is None


def test_the_change_since_yesterday_counts_the_hours_of_both_days(small_fleet):
    """As the rates of the API have them, hour by hour."""
    app, client = small_fleet
    hour = "{}T01:00:00Z"
    for name in ("SAT-000", "SAT-005"):
        (row,) = app.spacecraft.fleet([name], "live", "day").rows
        counted = []
        for day, next_day in (("1999-03-01", "1999-03-02"), ("1999-02-28", "1999-03-01")):
            asked = {"start": hour.format(day), "end": hour.format(next_day)}
            rates = client.get(f"/api/v1/spacecraft/{name}/rates", params=asked).json()["items"]
            counted += [sum(each[part] for each in rates) for part in ("observed", "ambiguous")]
        assert counted[0] > counted[2] > 0
        assert row.days == DayCounts(*counted)
        assert f"in {counted[0]}</small>" in client.get("/").text


# ---- files that are sent -------------------------------------------------------------------------


def ended(client, answer):
    place = answer.raise_for_status().headers["Location"]
    wait_until(lambda: client.get(place).json()["state"] not in ("running", "waiting"), 60.0)
    return client.get(place).json()


def send(client, run, body, kind):
    return client.post(
        "/api/v1/replays", params={"run": run}, content=body, headers={"Content-Type": kind}
    )


CSV = (
    "spacecraft,batch,time,tracker,h_deg,v_deg,magnitude,q1,q2,q3,qc\n"
    "XTE,c-1,1999-03-01T00:00:00Z,STARTRACKER_1,0.5,0.25,5.1,0,0,0,1\n"
    "XTE,c-1,1999-03-01T00:00:00Z,STARTRACKER_1,-0.5,0.75,5.6,0,0,0,1\n"
    "XTE,c-2,1999-03-01T00:01:00Z,STARTRACKER_1,0.1,0.2,5.1,0,0,0,1\n"
)


def test_a_csv_file_is_replayed_as_the_command_replays_it(client, run, tmp_path):
    file = tmp_path / "pass.csv"
    file.write_text(CSV)
    expected = [json.loads(each.body) for each in read_lines(file)]
    assert len(expected) == 2
    # Each kind of line end and coding that the command reads.
    with_returns = CSV.replace("\n", "\r").encode()
    for k, body in enumerate((CSV.encode(), with_returns, CSV.encode("utf-16"))):
        replay = ended(client, send(client, f"{run}-{k}", body, "text/csv"))
        assert (replay["state"], replay["counts"]["new"]) == ("done", 2), replay
        found = client.get("/api/v1/batches", params={"run": f"{run}-{k}"}).json()["items"]
        assert {each["batch"] for each in found} == {each["batch"] for each in expected}


def test_lines_of_json_are_replayed_in_each_coding_that_the_command_reads(client, run, batch):
    lines = "".join(json.dumps(batch | {"batch": f"b{k}"}) + "\n" for k in range(2))
    for k, body in enumerate(map(lines.encode, ("utf-8-sig", "utf-16", "utf-8"))):
        replay = ended(client, send(client, f"{run}-{k}", body, "application/x-ndjson"))
        assert (replay["state"], replay["counts"]["new"]) == ("done", 2), replay
        assert replay["lines"]["total"] in (None, 2)


def test_a_csv_file_that_is_sent_as_lines_is_refused_at_once(client, run):
    answer = send(client, run, CSV.encode(), "application/x-ndjson")
    assert answer.status_code == 422
    assert "looks like CSV" in answer.json()["detail"]


def test_a_file_of_which_nothing_is_recorded_is_never_done(client, run, batch):
    """Equal faults are one row of its page."""
    lines = [json.dumps(batch | {"batch": f"b{k}", "time": "yesterday"}) for k in range(301)]
    replay = ended(client, send(client, run, "\n".join(lines).encode(), "application/x-ndjson"))
    assert (replay["state"], replay["lines"]["refused"]) == ("failed", 301)
    page = client.get(f"/replays/{replay['id']}").text
    assert page.count("<tr>") == 2
    assert re.search(r'<th scope="row" class="number">1</th><td class="number">301</td>', page)


# ---- adopting ------------------------------------------------------------------------------------


def test_an_adopted_result_says_who_adopted_it_and_why(client, post, batch, run):
    first = post(batch | {"run": run}).json()
    signed = {"who": "A. Nyberg", "comment": "é, “why”"}
    asked = {"options": {"solver": "triad"}, "adopt": True, **signed}
    adopted = client.post(f"/api/v1/batches/{first['id']}/what-if", json=asked).json()
    record = client.get(f"/api/v1/batches/{adopted['id']}").json()
    assert (record["signature"]["who"], record["signature"]["comment"]) == ("A. Nyberg", "é, “why”")
    page = text_of(client.get(f"/batches/{adopted['id']}"))
    assert re.search(r"made from this result by A\. Nyberg , .* UTC, wall clock: é, “why”", page)
    former = client.get(f"/api/v1/batches/{first['id']}").json()
    assert former["replaced_by"] == {"result": adopted["id"], "signature": record["signature"]}
    assert "replaced_by" not in record
    page = client.get(f"/batches/{first['id']}")
    assert f'href="/batches/{adopted["id"]}?run={run}">an adopted one</a>' in page.text
    assert re.search(r"adopted by A\. Nyberg , .* UTC, wall clock: é, “why”", text_of(page))
    # Lists mark it, and one of adopted results alone has it.
    for asked in ({}, {"adopted": "true"}):
        listed = client.get("/batches", params={"run": run} | asked).text
        assert "adopted by A. Nyberg: é, “why”" in text_of_part(listed)
    assert '<input type="checkbox" name="adopted" value="true" checked>' in listed
    # It stands among the changes of its time, where no one can delete it.
    trends = client.get("/spacecraft/XTE", params={"run": run})
    assert f"What-if of batch {batch['batch']} adopted by A. Nyberg: é, “why”" in text_of(trends)
    assert "data-delete" not in trends.text.partition("What changed")[2]
    listed = client.get("/audit", params={"about": first["id"]})
    assert f'href="/batches/{adopted["id"]}"' in listed.text
    assert "adopt what if" in text_of(listed)
    assert "token local" not in text_of(listed)
    for asked, is_listed in (
        ({"person": "A. Nyberg"}, True),
        ({"action": "what_if", "about": first["id"]}, True),
        ({"person": "local"}, True),
        ({"person": "B. Nyberg"}, False),
        ({"action": "acknowledge"}, False),
    ):
        items = client.get("/api/v1/audit", params=asked).json()["items"]
        found = [each for each in items if first["id"] in each["about"]]
        assert [(each["person"], each["reason"]) for each in found] == [
            ("A. Nyberg", "é, “why”")
        ] * is_listed
        listed = client.get("/audit", params=asked).text
        assert (f"/api/v1/batches/{first['id']}/what-if" in listed) is is_listed


def test_adopting_fewer_stars_or_a_worse_status_is_warned_of_with_both_before(post, batch, run):
    """Also where the former result is put back."""
    answer = answer_from_json(post(batch | {"run": run}).content)
    counts = structs.replace(answer.counts, unique=3, ambiguous=2)
    suspect = structs.replace(answer.attitude, status="suspect")
    worse = structs.replace(answer, counts=counts, attitude=suspect)
    assert adoption(answer, worse)[:2] == [
        "▲ Fewer stars are identified: 5 to 3 of 5.",
        "▲ The attitude is worse: good to suspect.",
    ]
    assert not any(each.startswith("▲") for each in adoption(worse, answer))


def test_putting_a_worse_result_back_is_warned_of(client, post, batch, run):
    ambiguous = {"tolerances": {"separation_deg": 0.0}, "identifier": "starid"}
    first = post(batch | {"run": run, "options": ambiguous}).json()
    asked = {"options": {"identifier": "verified"}, "adopt": True, "who": "jb"}
    adopted = client.post(f"/api/v1/batches/{first['id']}/what-if", json=asked).json()
    assert adopted["counts"]["unique"] > first["counts"]["unique"]
    page = client.get(f"/batches/{adopted['id']}").text
    (told,) = re.findall(r'data-changes="([^"]*)"', page)
    stars = adopted["counts"]["unique"], first["counts"]["unique"]
    assert f"▲ Fewer stars are identified: {stars[0]} to {stars[1]} of" in told


def test_adopting_a_worse_fit_is_warned_of_with_both_figures(post, batch, run):
    answer = answer_from_json(post(batch | {"run": run}).content)
    attitude = answer.attitude
    assert attitude is not None
    for new, is_warned in ((attitude.residual_rms_arcsec, False), (29.0, True), (2991.0, True)):
        after = structs.replace(answer, attitude=structs.replace(attitude, residual_rms_arcsec=new))
        told = [each for each in adoption(answer, after) if each.startswith("▲")]
        assert bool(told) is is_warned
        if is_warned:
            was = arcsec(attitude.residual_rms_arcsec)
            assert told == [
                f"▲ The attitude fits its stars worse: residual rms {was} to {arcsec(new)}."
            ]
    assert adoption(answer, structs.replace(answer, attitude=None))[0].startswith("▲")


# ---- definitive attitude without a gyro ----------------------------------------------------------


def test_without_gyro_data_the_pages_say_what_is_missing_and_link_no_file_that_is_not_there(
    chosen_database, drawn
):
    app = open_app(in_process_settings(chosen_database()))
    with Server(create_app(app)) as url, httpx.Client(base_url=url, timeout=60) as client:
        for each in drawn("XTE", 12, cadence_s=3600.0):
            client.post("/api/v1/batches", json=each).raise_for_status()
        before = text_of(client.get("/spacecraft/XTE/grades"))
        assert before.count("There are no gyro data in this period") == 1
        app.part(Definitive).days.smooth("XTE")
        after = client.get("/spacecraft/XTE/grades").text
        assert after.count("There are no gyro data in this period") == 1
        files = client.get("/spacecraft/XTE/files").text
        assert "▲ None is good." in files
        assert files.count("There are no gyro data in this period") == 1
        assert "Make them" not in files
        for page in (after, files):
            links = re.findall(r'href="(/api/v1/spacecraft/XTE/attitude[^"]*)"', page)
            for link in links:
                assert client.get(link.replace("&amp;", "&")).status_code == 200, link
        assert "grade=raw" in files


# ---- figures and words ---------------------------------------------------------------------------


def test_no_page_shows_a_bare_code_or_a_time_of_a_thousandth(client, full_run):
    for address in console_addresses():
        page = client.get(f"{address}?run={full_run}").text
        assert not re.findall(r'value="[^"]*\.001Z"', page), address
        shown = re.sub(r"<(template|code|pre).*?</\1>|<[^>]+>", " ", page, flags=re.DOTALL)
        assert not re.findall(r"none so far|\bno_match\b|lost_in_space_refused", shown), address


@pytest.mark.parametrize("page", ["/advice/XTE", "/advice/SOHO", "/missions", "/compare", "batch"])
def test_the_symbols_of_the_paper_stand_in_tooltips_alone(client, full_run, page):
    if page == "batch":
        asked = {"run": full_run, "spacecraft": "XTE", "limit": 1}
        (found,) = client.get("/api/v1/batches", params=asked).json()["items"]
        page = f"/batches/{found['id']}"
    answer = client.get(f"{page}?run={full_run}")
    assert " in Fink &amp; Shoup (1994)" in answer.text
    assert not re.findall(
        r"\b(?:[CN]CAP|WBAND|NTOT|HMAX|SEPTOL|XMTOL|TMAGMX|CAPMAX|BANMAX|BANTOL\d|TASTE|k_g)\b",
        text_of(answer),
    )


@pytest.mark.parametrize("text", ["lost_in_space_refused: no_match", "same_star_twice", "a: b c"])
def test_a_warning_is_a_sentence_beside_its_code(text):
    said, code = formatting.warning(text)
    assert code == text.partition(":")[0]
    assert "_" not in said


def test_a_share_of_rejected_attitudes_is_written_in_percent_with_its_unit():
    name = quantities.REJECTED
    assert formatting.quantity(0.005, name) == "0.50\u202f%"
    assert (formatting.unit_of(name), formatting.entered(0.005, name)) == ("%", "0.5")


def test_advice_without_batches_draws_no_table(client):
    page = client.get("/advice/SOHO?run=nothing").text
    assert "There are no batches in this period" in page
    assert "With other settings" not in page


def test_the_link_to_a_period_names_its_ends(client, full_run):
    """Whoever follows it sees the same period, whenever that is."""
    for path in ("", "/period", "/grades", "/files"):
        page = client.get(f"/spacecraft/XTE{path}?run={full_run}&range=day").text
        link = re.search(r'id="period-link" hidden>([^<]*)<', page)[1].replace("&amp;", "&")
        asked = parse_qs(urlsplit(link).query)
        assert link.startswith(f"{client.base_url}/spacecraft/XTE{path}?")
        assert {"start", "end"} <= set(asked)
        assert "range" not in asked
        again = client.get(link).text
        assert asked["start"][0].removesuffix(".000Z") in again
