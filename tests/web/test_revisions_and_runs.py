"""Pages that compare: missions before and after a change, and two runs."""

import re

import httpx
import numpy as np
import pytest

from service.app.factory import open_app
from service.missions.mission import Mission
from service.times import parse_utc, shifted
from service.web.app import create_app
from tests.web.markup import Markup
from tests.web.serving import Server, in_process_settings
from tests.web.test_access import Guarded, shown


def text_of(answer):
    Markup(answer.raise_for_status().text)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", answer.text))


@pytest.fixture(scope="module")
def two_runs(chosen_database, drawn):
    """A service without live batches: the runs `votes` and `verified` have the same of XTE."""
    app = open_app(in_process_settings(chosen_database()))
    with Server(create_app(app)) as url, httpx.Client(base_url=url, timeout=60) as client:
        for each in drawn("XTE", 60, seed=4):
            for run, identifier in (("votes", "starid"), ("verified", "verified")):
                body = each | {"run": run, "options": {"identifier": identifier}}
                client.post("/api/v1/batches", json=body).raise_for_status()
        client.post("/api/v1/batches", json=drawn("SWAS", 1)[0] | {"run": "lonely"})
        yield client


def counts(client, run):
    found = client.get("/api/v1/batches", params={"run": run, "limit": 100}).json()["items"]
    return {each["batch"]: (each["counts"], each["status"]) for each in found}


def test_two_runs_are_compared_batch_by_batch(two_runs):
    page = text_of(two_runs.get("/compare?run=votes&other=verified&spacecraft=XTE"))
    assert "votes and verified, XTE" in page
    assert "60 batches that are in both" in page
    votes, verified = counts(two_runs, "votes"), counts(two_runs, "verified")
    assert sum(each[0]["ambiguous"] for each in votes.values()) > 0
    differ = [name for name in votes if votes[name] != verified[name]]
    html = two_runs.get("/compare?run=votes&other=verified&spacecraft=XTE").text
    shown_ones = re.findall(r'aria-label="[\d, ]+: (\S+) in votes"', html)
    assert sorted(shown_ones) == sorted(differ)
    for each in (votes, verified):
        unique = sum(found["unique"] for found, _ in each.values())
        assert f'data-name="unique">{unique} ' in html


COLUMNS = {
    "stars": "observed",
    "unique": "unique",
    "ambiguous": "ambiguous",
    "unmatched": "unmatched",
}
"""The counts of stars in the table of rates, as the interface names them."""


def listed(client, run, **period):
    """The batches of XTE in a run, from the lists of the interface."""
    asked = {"run": run, "spacecraft": "XTE", "limit": 100} | period
    return client.get("/api/v1/batches", params=asked).raise_for_status().json()["items"]


def rates_shown(page, run):
    """The numbers of a run's row of rates, by the name of the column."""
    (row,) = re.findall(
        rf'<tr><th scope="row"><strong>[AB]</strong> <a [^>]*>{run}</a>.*?</tr>', page
    )
    return dict(re.findall(r'data-name="([a-z ]+)">(\d+) ', row.replace("</td>", " </td>")))


@pytest.mark.parametrize("minutes", [None, (5, 20)])
def test_the_rates_of_two_runs_count_all_batches_of_the_period(two_runs, minutes):
    period = {}
    if minutes is not None:
        first = parse_utc(min(each["time"] for each in listed(two_runs, "votes")))
        start, end = (shifted(first, 60.0 * each).text for each in minutes)
        period = {"start": start, "end": end}
    asked = {"run": "votes", "other": "verified", "spacecraft": "XTE"} | period
    page = two_runs.get("/compare", params=asked).raise_for_status().text
    for run in ("votes", "verified"):
        batches = listed(two_runs, run, **period)
        assert len(batches) == (60 if minutes is None else 30)
        states = [each["status"] for each in batches]
        assert rates_shown(page, run) == {
            "batches": str(len(batches)),
            **{
                name: str(sum(each["counts"][part] for each in batches))
                for name, part in COLUMNS.items()
            },
            "good": str(states.count("good")),
            "suspect": str(states.count("suspect")),
            "no attitude": str(states.count(None)),
        }


def test_rates_of_any_period_are_drawn_in_a_bounded_number_of_points(chosen_database, drawn):
    """Here of 127 years, by one batch at each end."""
    app = open_app(in_process_settings(chosen_database()))
    early = drawn("XTE", 1, start="1972-01-05T00:00:00Z")
    late = drawn("XTE", 1, start="2099-06-01T00:00:00Z")
    with Server(create_app(app)) as url:
        for run in ("one", "two"):
            for number, each in enumerate(early + late):
                body = each | {"run": run, "batch": f"b{number}"}
                httpx.post(f"{url}/api/v1/batches", json=body, timeout=60).raise_for_status()
        rates = app.runs.rates("one", "two", "XTE", parse_utc("1972-01-01T00:00:00Z", "start"))
    assert rates.start.text == "1972-01-05T00:00:00.000Z"
    for each in rates.runs:
        assert each.totals["batches"] == 2
        assert all(700 < len(values) <= 733 for values in each.shares.values())
        assert all(np.isfinite(values).sum() == 2 for values in each.shares.values())


def test_a_period_that_only_one_run_has_shows_no_rates(two_runs):
    asked = {"run": "votes", "other": "verified", "spacecraft": "XTE"}
    page = text_of(two_runs.get("/compare", params=asked | {"start": "2031-01-01T00:00:00Z"}))
    assert "All batches of both runs" not in page
    assert "in votes in this period. Batches are the same if they have the same name." in page
    refused = two_runs.get("/compare", params=asked | {"start": "yesterday"})
    assert refused.status_code == 422
    assert "start" in refused.text


def test_a_run_without_a_partner_says_so(two_runs):
    page = text_of(two_runs.get("/compare?run=lonely&other=votes&spacecraft=XTE"))
    assert "No batches in both runs" in page
    assert two_runs.get("/compare?run=votes&other=none&spacecraft=NOPE").status_code == 404


def test_options_are_compared_as_before(two_runs):
    page = text_of(two_runs.get("/compare?run=votes&spacecraft=XTE&sample=5&b.identifier=verified"))
    assert "5 of 60 batches of XTE" in page
    assert "60 batches that are in both" not in page


def test_a_bound_token_compares_the_runs_of_its_spacecraft(chosen_database, drawn):
    service = Guarded(chosen_database())
    everything = shown(service.token("all", "read", "submit"))
    bound = shown(service.token("swas", "read", spacecraft=["SWAS"]))
    with Server(create_app(service.app)) as url, httpx.Client(base_url=url, timeout=60) as client:
        for name in ("XTE", "SWAS"):
            for run in ("one", "two"):
                body = drawn(name, 1)[0] | {"run": run}
                client.post("/api/v1/batches", json=body, headers=everything).raise_for_status()
        asked = "/compare?run=one&other=two"
        assert ", SWAS" in text_of(client.get(asked, headers=bound))
        asked += "&spacecraft=XTE"
        assert client.get(asked, headers=bound).status_code == 403
        assert client.get(asked, headers=everything).status_code == 200


def test_a_mission_shows_what_changed_between_its_revisions(chosen_database, missions, drawn):
    settings = in_process_settings(chosen_database())
    changed = missions["XTE"].model_dump(mode="json")
    changed["tolerances"]["separation_deg"] = 0.0132
    changed["tests"]["match_groups"] = True
    changed["trackers"][0]["sigma_arcsec"] = 4.5
    first, second = drawn("XTE", 2)
    for mission, batch in ((None, first), (Mission.model_validate(changed), second)):
        with Server(create_app(open_app(settings, mission))) as url:
            httpx.post(f"{url}/api/v1/batches", json=batch, timeout=60).raise_for_status()
            answer = httpx.get(f"{url}/missions")
    Markup(answer.text)
    table = answer.text.partition('class="cards differences"')[2].partition("</table>")[0]
    rows = re.findall(r"<code>([\w.]+)</code></th>.*?<del>(.*?)</del>.*?<ins>(.*?)</ins>", table)
    assert rows == [
        ("tests.match_groups", "off", "on"),
        ("tolerances.separation_deg", "0.0066", "0.0132"),
        ("trackers.STARTRACKER_1.sigma_arcsec", "2.1213203", "4.5"),
    ]
    assert "× 2<" in table


def test_without_a_partner_options_are_offered_for_a_spacecraft_with_batches(two_runs):
    assert "<option selected>SWAS" in two_runs.get("/compare?run=lonely").text


def test_what_was_recorded_wrongly_is_forgotten_by_name_and_can_be_recorded_anew(
    client, post, batch, run
):
    """Nothing is removed before it is confirmed; the audit list says what was asked."""
    wrong, kept = batch | {"run": run}, batch | {"run": run, "batch": "kept"}
    for each in (wrong, kept):
        post(each).raise_for_status()
    right = wrong | {"body_rates_deg_per_s": [0.0, 0.0, 0.001]}
    assert post(right).status_code == 409
    address = f"/api/v1/runs/{run}/forget"
    asked = {"spacecraft": "XTE", "batches": [batch["batch"]]}
    counts = {"batches": 1, "archived_batches": 0, "gyro_blocks": 0, "graded_days": 0}
    told = client.post(address, json=asked).raise_for_status().json()
    assert told == {"run": run, "spacecraft": "XTE"} | counts
    assert post(wrong).headers["Replayed"] == "true"
    assert client.post(address, json=asked | {"confirm": True}).json() == told
    assert client.post(address, json=asked).status_code == 404
    assert post(right).status_code == 201
    listed = client.get("/api/v1/batches", params={"run": run}).json()["items"]
    assert {each["batch"] for each in listed} == {batch["batch"], "kept"}
    entries = client.get("/api/v1/audit?limit=4").json()["items"]
    (entry,) = [
        each for each in entries if '"confirm":true' in (each["body"] or "").replace(" ", "")
    ]
    assert (entry["action"], entry["about"], entry["status"]) == ("forget_run", address, 200)
    whole = client.post(address, json={"confirm": True}).raise_for_status().json()
    assert whole["batches"] == 2
    assert run not in {each["run"] for each in client.get("/api/v1/runs").json()["items"]}
