"""What is added to a registry from outside is found wherever the registry is used."""

import json
from typing import Annotated

import httpx
import pytest
from fastapi import Query as InQuery

from service.app.factory import open_app
from service.cli import main
from service.table_files.formats import TABLE_FORMATS, OutputFormat
from service.web.app import bare_app, create_app
from service.web.console.page import PAGES, ContextDep, PageQuery, console_page
from service.web.requests.access import POLICIES, Policy
from service.web.requests.problems import ProblemType
from tests.fresh_databases import sqlite_at
from tests.web.console_pages import console_addresses
from tests.web.serving import Server, in_process_settings

ROUTE = "/api/v1/spacecraft/XTE/history"
NDJSON = "application/x-ndjson"


def write_ndjson(table):
    for page in table.pages:
        rows = (dict(zip(table.names, row, strict=True)) for row in zip(*page, strict=True))
        yield "".join(json.dumps(row) + "\n" for row in rows).encode()


@pytest.fixture
def ndjson(monkeypatch):
    added = OutputFormat("NDJSON", NDJSON, write_ndjson)
    monkeypatch.setitem(TABLE_FORMATS, "ndjson", added)


@pytest.fixture
def passes_page():
    """A page of the console that nothing but its registration knows."""
    policies, pages = dict(POLICIES), dict(PAGES)

    @console_page("/passes", "Passes", Policy("read", "nothing"), position=35)
    def passes_page(query: Annotated[PageQuery, InQuery()], context: ContextDep):
        shown = {"kind": ProblemType(200, "Passes"), "problem": {"detail": "no pass is planned"}}
        return context.rendered("error.html.jinja", query.run, **shown)

    yield
    for registry, before in ((POLICIES, policies), (PAGES, pages)):
        registry.clear()
        registry.update(before)


# ---- output formats ------------------------------------------------------------------------------


def test_a_new_format_is_written_by_the_api(ndjson, address, client, full_run):
    asked = {"run": full_run, "quantity": "ambiguous_share"}
    lines = httpx.get(f"{address}{ROUTE}", params=asked | {"format": "ndjson"})
    assert lines.headers["Content-Type"] == NDJSON
    assert lines.headers["Content-Disposition"].endswith('-history.ndjson"')
    rows = [json.loads(each) for each in lines.text.splitlines()]
    assert len(rows) == 20
    plain = client.get(ROUTE, params=asked | {"strategy": "latest"}).json()
    assert [each["ambiguous_share"] for each in rows] == plain["series"]["ambiguous_share"]["value"]
    short = httpx.get(f"{address}{ROUTE}", params=asked | {"format": "ndjson", "size": 3})
    assert set(json.loads(short.text.splitlines()[0])) >= {"start", "ambiguous_share_mean"}


def test_a_new_format_is_described(ndjson):
    operation = bare_app().openapi()["paths"]["/api/v1/spacecraft/{name}/history"]["get"]
    (parameter,) = [each for each in operation["parameters"] if each["name"] == "format"]
    assert parameter["schema"]["enum"] == ["json", *TABLE_FORMATS]
    types = {each.media_type for each in TABLE_FORMATS.values()}
    assert set(operation["responses"]["200"]["content"]) == {"application/json", *types}
    assert NDJSON in types


def test_a_new_format_is_written_by_the_command(ndjson, app, full_run, capsys):
    where = ["--run", full_run, "--database", app.settings.database]
    assert main(["history", "--spacecraft", "XTE", *where, "--format", "ndjson"]) == 0
    rows = [json.loads(each) for each in capsys.readouterr().out.splitlines()]
    assert len(rows) == 20
    assert all("ambiguous_share" in each for each in rows)


def test_a_new_format_is_offered_by_the_page(ndjson, client, full_run):
    page = client.get("/spacecraft/XTE/files", params={"run": full_run}).text
    assert ">NDJSON</a>" in page
    assert "format=ndjson" in page


def test_an_unknown_format_is_refused_with_the_known_ones_named(client):
    answer = client.get(ROUTE, params={"format": "xml"})
    assert answer.status_code == 422
    (fault,) = answer.json()["errors"]
    assert fault == {
        "field": "format",
        "message": "must be 'json', 'csv', 'parquet' or 'fits'",
        "value": "'xml'",
    }


# ---- pages ---------------------------------------------------------------------------------------


def test_a_new_page_is_served_and_is_in_the_navigation_in_its_place(passes_page, tmp_path):
    app = open_app(in_process_settings(sqlite_at(tmp_path / "pages.db")))
    with Server(create_app(app)) as url, httpx.Client(base_url=url) as client:
        page = client.get("/passes")
        assert page.status_code == 200
        assert "no pass is planned" in page.text
        assert '<a href="/passes" aria-current="page">Passes</a>' in page.text
        names = [each.split("<")[0] for each in client.get("/").text.split("<li><a ")[1:]]
        titles = [each.split(">")[1] for each in names]
        assert titles[titles.index("Batches") + 1] == "Passes"
        assert client.get("/passes?runn=x").status_code == 422


def test_a_new_page_is_no_operation_of_the_api(passes_page):
    """Pages are for people: the description lists what programs call."""
    assert "/passes" not in bare_app().openapi()["paths"]
    assert "/passes" in [route.path for route in bare_app().state.routes]


def test_a_new_page_is_in_the_lists_that_tests_and_access_use(passes_page):
    assert "/passes" in console_addresses()
    assert POLICIES["passes_page"].scope == "read"
