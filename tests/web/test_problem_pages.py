"""The type of every problem leads to a page that explains it."""

import re
from pathlib import Path

import pytest

from service.web.requests.problems import types_with_pages
from tests.web.test_console import text_of

GUIDE = Path(__file__).parents[2] / "docs" / "api.md"


@pytest.mark.parametrize("kind", types_with_pages().values(), ids=types_with_pages())
def test_each_type_is_the_address_of_its_explanation(client, kind):
    page = client.get(kind.type)
    assert page.status_code == 200
    shown = text_of(page)
    for text in (kind.title, kind.type, str(kind.status), kind.meaning, kind.remedy):
        assert text in shown


def test_a_problem_that_was_answered_leads_there(client, post, batch):
    problem = post(batch | {"time": "noon"})
    leads_to = problem.request.url.join(problem.json()["type"])
    assert problem.json()["title"] in text_of(client.get(leads_to))


def test_a_page_that_fails_says_so_on_a_page(app, client, monkeypatch):
    def fail(*_):
        raise RuntimeError("no such luck")

    monkeypatch.setattr(app.service, "about", fail)
    page = client.get("/about")
    assert (page.status_code, page.headers["content-type"][:9]) == (500, "text/html")
    assert "The service has failed; its log contains the cause." in text_of(page)
    assert "no such luck" not in page.text


def test_all_are_listed_and_each_links_to_its_own(client):
    page = client.get("/problems").text
    assert re.findall(r'href="(/problems/[\w-]+)"', page) == [
        kind.type for kind in types_with_pages().values()
    ]


def test_an_unknown_problem_is_not_found(client):
    page = client.get("/problems/no-such")
    assert page.status_code == 404
    assert "there are not-json" in text_of(page)


def test_the_guide_has_every_type_with_its_status():
    rows = re.findall(r"^\| (\d+) \| `(/problems/[\w-]+)` \|", GUIDE.read_text("utf-8"), re.M)
    assert set(rows) == {(str(kind.status), kind.type) for kind in types_with_pages().values()}


def test_an_unknown_address_is_a_page_for_browsers_and_a_problem_for_programs(client):
    page = client.get("/nope", headers={"Accept": "text/html,*/*"})
    assert page.status_code == 404
    assert page.headers["Content-Type"].startswith("text/html")
    assert "There is no page at /nope." in text_of(page)
    for path, accept in (("/nope", "*/*"), ("/api/v1/nope", "text/html")):
        problem = client.get(path, headers={"Accept": accept})
        assert problem.status_code == 404
        assert problem.headers["Content-Type"] == "application/problem+json"
