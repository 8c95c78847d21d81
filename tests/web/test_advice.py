"""Advice over HTTP and as a page."""

import httpx
import pytest

from tests.web.markup import Markup

API = "/api/v1"


def test_it_tells_what_the_batches_of_a_run_say(client, full_run):
    query = {"run": full_run, "sample": 10, "tolerance": "separation_deg=0.01"}
    advice = client.get(f"{API}/spacecraft/XTE/advice", params=query).json()
    assert (advice["batches_in_range"], advice["batches_sampled"]) == (20, 10)
    assert [each["symbol"] for each in advice["tolerances"]] == ["SEPTOL", "XMTOL", "CAPMAX"]
    tried = {(each["name"], each["identifier"]) for each in advice["tried"]}
    assert ("present settings", "verified") in tried
    assert ("separation_deg = 0.01, asked for", "starid") in tried


def test_a_band_has_its_own_tolerances(client, full_run):
    advice = client.get(f"{API}/spacecraft/SOHO/advice", params={"run": full_run}).json()
    symbols = [each["symbol"] for each in advice["tolerances"]]
    assert symbols == ["SEPTOL", "XMTOL", "BANMAX", "BANTOL1", "BANTOL2"]


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
    assert tags.count("section") == 1
    assert "20 of 20 batches run again" in answer.text
    assert "SEPTOL (separation_deg)" in answer.text
    assert "default-src 'none'" in answer.headers["content-security-policy"]


def test_the_page_of_nothing_says_so(address):
    answer = httpx.get(f"{address}/advice/SOHO", params={"run": "nobody"})
    assert "There are no batches to advise from" in answer.text


def test_the_front_page_leads_there(address, full_run):
    text = httpx.get(f"{address}/", params={"run": full_run}).text
    assert f'href="/advice/XTE?run={full_run}"' in text
