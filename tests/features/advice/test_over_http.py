"""Advice over HTTP and as a page."""

import html
import re
from urllib.parse import parse_qs

import httpx
import pytest

from tests.web.markup import Markup

API = "/api/v1"


def test_it_tells_what_the_batches_of_a_run_say(client, full_run):
    query = {"run": full_run, "sample": 10, "tolerance": "separation_deg=0.01"}
    advice = client.get(f"{API}/spacecraft/XTE/advice", params=query).json()
    assert (advice["batches_in_range"], advice["batches_sampled"]) == (20, 10)
    assert [each["symbol"] for each in advice["tolerances"]] == [
        "SEPTOL",
        "XMTOL",
        "TMAGMX",
        "CAPMAX",
    ]
    tried = {(each["name"], each["identifier"]) for each in advice["tried"]}
    assert ("present settings", "verified") in tried
    assert ("separation_deg = 0.01, asked for", "starid") in tried


def test_a_band_has_its_own_tolerances(client, full_run):
    advice = client.get(f"{API}/spacecraft/SOHO/advice", params={"run": full_run}).json()
    symbols = [each["symbol"] for each in advice["tolerances"]]
    assert symbols == ["SEPTOL", "XMTOL", "TMAGMX", "BANMAX", "BANTOL1", "BANTOL2"]


def test_without_batches_nothing_is_advised(client):
    advice = client.get(f"{API}/spacecraft/SWAS/advice", params={"run": "nobody"}).json()
    assert (advice["first"], advice["changes"]) == (None, [])


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ({"tolerance": "septol=1"}, "tolerance.septol"),
        ({"tolerance": "separation_deg=NaN"}, "tolerance.separation_deg"),
        ({"tolerance": "separation_deg"}, "tolerance"),
        ({"sample": 0}, "sample"),
        ({"sample": 2001}, "sample"),
        ({"start": "1999-01-02T00:00:00Z", "end": "1999-01-01T00:00:00Z"}, "query"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_what_cannot_be_asked_is_refused_by_its_name(client, query, field):
    answer = client.get(f"{API}/spacecraft/XTE/advice", params=query)
    assert answer.status_code == 422
    assert field in [each["field"] for each in answer.json()["errors"]]


def test_an_unknown_spacecraft_is_not_found(client):
    assert client.get(f"{API}/spacecraft/NOPE/advice").status_code == 404
    assert client.get("/advice/NOPE").status_code == 404


def test_the_page_says_it_in_words_and_is_whole(address, full_run):
    answer = httpx.get(f"{address}/advice/XTE", params={"run": full_run, "sample": 20}, timeout=60)
    assert answer.status_code == 200
    tags = [tag for tag, _ in Markup(answer.text).elements]
    assert tags.count("section") == 3
    assert "20 of 20 batches processed again" in answer.text
    assert ">zone.radius_deg</abbr>" in answer.text
    assert "default-src 'none'" in answer.headers["content-security-policy"]


def test_the_page_of_nothing_says_so(address):
    answer = httpx.get(f"{address}/advice/SOHO", params={"run": "nobody"})
    assert "There are no batches in this period" in answer.text


def advice_link(text):
    """The query of the page's link to the advice for XTE."""
    (link,) = set(re.findall(r'href="/advice/XTE\?([^"#]*)', text))
    return parse_qs(html.unescape(link))


def test_the_link_to_the_advice_asks_for_the_period_that_holds_the_run(address, full_run):
    text = httpx.get(f"{address}/spacecraft/XTE", params={"run": full_run}).text
    link = advice_link(text)
    assert link["run"] == [full_run]
    answer = httpx.get(f"{address}/advice/XTE", params=link, timeout=60)
    assert "20 of 20 batches processed again" in answer.text


def test_the_link_asks_for_the_stretch_that_the_page_of_a_spacecraft_shows(address, full_run):
    stretch = {"start": "1999-03-01T00:00:00.000Z", "end": "1999-03-01T00:02:00.000Z"}
    text = httpx.get(f"{address}/spacecraft/XTE", params=stretch | {"run": full_run}).text
    link = advice_link(text)
    assert {name: link[name][0] for name in stretch} == stretch


def test_the_page_has_a_form_for_the_range_the_sample_and_what_to_try(address, full_run):
    """Its fields hold what was asked for, and sent as they are they ask for the same again."""
    asked = {
        "run": full_run,
        "start": "1999-060T00:00:00Z",
        "end": "1999-060T00:02:00Z",
        "sample": "3",
        "tolerance": "separation_deg=0.01",
    }
    text = httpx.get(f"{address}/advice/XTE", params=asked, timeout=60).text
    fields = {
        attributes["name"]: attributes.get("value", "")
        for tag, attributes in Markup(text).elements
        if tag == "input" and attributes.get("name")
    }
    assert fields == asked | {
        "start": "1999-03-01T00:00:00Z",
        "end": "1999-03-01T00:02:00Z",
    }
    again = httpx.get(f"{address}/advice/XTE", params=fields, timeout=60)
    assert again.status_code == 200
    assert "3 of " in again.text
    assert "separation_deg = 0.01, asked for" in again.text
    (link,) = re.findall(r'href="(/api/v1/spacecraft/XTE/advice\?[^"]*)"', text)
    advice = httpx.get(f"{address}{html.unescape(link)}", timeout=60).json()
    assert advice["batches_sampled"] == 3
    assert advice["last"] < "1999-03-01T00:02:00.000Z"


def test_fields_of_the_form_that_are_left_empty_ask_for_nothing(address, full_run):
    asked = {"run": full_run, "start": "", "end": "", "sample": "5", "tolerance": ""}
    answer = httpx.get(f"{address}/advice/XTE", params=asked, timeout=60)
    assert answer.status_code == 200
    assert "5 of 20 batches processed again" in answer.text


def test_no_line_is_boxed_that_a_sentence_takes_back(client, full_run):
    """SOHO is identified by verified stars, for which no tolerance matters."""
    advice = client.get(f"{API}/spacecraft/SOHO/advice", params={"run": full_run}).json()
    changed = {each["line"].partition(" = ")[0] for each in advice["changes"]}
    assert not changed & {each["tolerance"] for each in advice["tolerances"]}
    assert {each["action"] for each in advice["tolerances"]} <= {"keep", "wait"}
