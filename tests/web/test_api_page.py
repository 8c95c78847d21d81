"""The API's description for people: everything of the document, from the service alone."""

import re

import pytest

from tests.web.conformance import reference
from tests.web.markup import Markup


@pytest.fixture(scope="module")
def page(client):
    return client.get("/docs").text


@pytest.fixture(scope="module")
def shapes(client):
    return client.get("/docs/shapes").text


def test_it_has_every_operation_and_every_shape(page, shapes):
    ids = set(Markup(page).ids())
    for path, methods in reference()["paths"].items():
        for operation in methods.values():
            assert operation["operationId"] in ids
        assert f"<code>{path}</code>" in page
    assert set(reference()["components"]["schemas"]) <= set(Markup(shapes).ids())


def test_every_link_within_it_leads_somewhere(page, shapes):
    assert set(re.findall(r'href="#([^"]+)"', page)) <= set(Markup(page).ids())
    linked = set(re.findall(r'href="/docs/shapes#([^"]+)"', page + shapes))
    assert linked
    assert linked <= set(Markup(shapes).ids())


def test_it_loads_nothing_from_another_place(page, shapes):
    loaded = [
        attributes.get("src") or attributes.get("href")
        for tag, attributes in Markup(page).elements + Markup(shapes).elements
        if tag in ("script", "link", "img")
    ]
    assert loaded
    assert all(each.startswith("/static/") for each in loaded)


def test_an_operation_shows_its_scope_parameters_command_and_answers(page):
    text = page[page.index('id="get_latest"') :]
    text = text[: text.index("</details>")]
    assert "Needs the scope read." in text
    assert "curl -s http://127.0.0.1:8000/api/v1/spacecraft/XTE/latest" in text
    assert "<code>run</code>" in text
    assert '<a href="/docs/shapes#Record">Record</a>' in text
    assert '"spacecraft": "SOHO"' in text
