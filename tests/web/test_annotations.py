"""Annotations over HTTP: what people write, who may, and what the records keep of it."""

import re

import httpx
import pytest

from service.app.factory import open_app
from service.web.app import create_app
from tests.web.markup import Markup
from tests.web.serving import Server, in_process_settings
from tests.web.test_access import Guarded, shown

HERE = "/api/v1/annotations"
START, END = "1999-03-01T00:00:00.000Z", "1999-03-01T00:20:00.000Z"
NOTE = {"spacecraft": "XTE", "start": START, "text": "Wheel 2 unloaded", "who": "J. Operator"}


@pytest.fixture(scope="module", autouse=True)
def none_of_other_files(client):
    """The server is shared: other files may have written notes there."""
    for left in client.get(HERE).json()["items"]:
        client.delete(f"{HERE}/{left['id']}?who=jb").raise_for_status()


@pytest.fixture
def note(client):
    answer = client.post(HERE, json=NOTE)
    assert answer.status_code == 201
    yield answer.json()
    client.delete(f"{HERE}/{answer.json()['id']}?who=jb")


def texts(client, **query):
    return [each["text"] for each in client.get(HERE, params=query).json()["items"]]


def test_a_note_is_listed_as_it_was_written_and_signed(client, note):
    (found,) = client.get(HERE, params={"spacecraft": "XTE"}).json()["items"]
    assert found == note
    told = {name: found[name] for name in NOTE}
    assert told == NOTE
    assert found["end"] is None


def test_a_time_may_have_the_day_of_the_year_or_be_a_leap_second(client):
    for asked, stored in (
        ("1999-060T12:00:00Z", "1999-03-01T12:00:00.000Z"),
        ("1998-12-31T23:59:60.5Z", "1998-12-31T23:59:60.500Z"),
    ):
        written = client.post(HERE, json=NOTE | {"start": asked}).json()
        assert written["start"] == stored
        client.delete(f"{HERE}/{written['id']}?who=jb").raise_for_status()


def test_a_period_shows_the_notes_that_touch_it_its_end_excluded(client):
    ids = [
        client.post(HERE, json=NOTE | each).json()["id"]
        for each in (
            {"text": "whole", "end": END},
            {"text": "first"},
            {"text": "last", "start": END},
            {"text": "before", "start": "1999-02-28T00:00:00Z"},
        )
    ]
    try:
        middle = {"start": "1999-060T00:10:00Z", "end": "1999-060T00:15:00Z"}
        assert texts(client, spacecraft="XTE", **middle) == ["whole"]
        assert texts(client, spacecraft="XTE", start=START, end=END) == ["first", "whole"]
        assert texts(client, spacecraft="XTE", start=END) == ["last", "whole"]
        page = client.get(HERE, params={"spacecraft": "XTE", "limit": 3})
        rest = client.get(page.links["next"]["url"])
        assert [each["id"] for each in page.json()["items"] + rest.json()["items"]] == ids[::-1]
    finally:
        for id in ids:
            client.delete(f"{HERE}/{id}?who=jb").raise_for_status()


def test_a_note_about_all_is_one_of_each_spacecraft(client):
    written = client.post(HERE, json=NOTE | {"spacecraft": None, "text": "solar flare"}).json()
    assert texts(client, spacecraft="SOHO") == ["solar flare"]
    assert texts(client) == ["solar flare"]
    client.delete(f"{HERE}/{written['id']}?who=jb").raise_for_status()
    assert texts(client) == []


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"text": "   "}, "text"),
        ({"text": "a\x00b"}, "text"),
        ({"text": "x" * 2001}, "text"),
        ({"start": "noon"}, "start"),
        ({"start": None}, "start"),
        ({"end": "1999-13-01T00:00:00Z"}, "end"),
        ({"end": START}, "body"),
        ({"spacecraft": "NOPE"}, "spacecraft"),
        ({"who": None}, "who"),
        ({"who": ""}, "who"),
        ({"who": "J.\x00"}, "who"),
        ({"spacecraft": "X\x00"}, "spacecraft"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_a_bad_field_is_named_and_nothing_is_stored(client, change, field):
    answer = client.post(HERE, json=NOTE | change)
    assert answer.status_code == 422, answer.text
    assert [each["field"] for each in answer.json()["errors"]] == [field]
    assert texts(client) == []


def test_a_note_that_is_deleted_is_gone_and_the_audit_list_keeps_its_text(client, note):
    here = f"{HERE}/{note['id']}"
    assert client.delete(here).json()["errors"][0]["field"] == "who"
    signed = "who=mk&comment=wrong+pass"
    assert client.delete(f"{here}?{signed}").json() == note
    assert client.delete(f"{here}?who=mk").status_code == 404
    assert client.delete(f"{HERE}/x?who=mk").status_code == 404
    assert texts(client) == []
    entries = client.get("/api/v1/audit").json()["items"]
    (deleted,) = [e for e in entries if here in e["about"] and e["status"] == 200]
    assert deleted["action"] == "delete_annotation"
    assert deleted["about"] == f"{here}?{signed}"
    assert "Wheel 2 unloaded" in deleted["body"]
    # The person of the entry deleted the note, which another person wrote.
    assert (deleted["person"], deleted["reason"]) == ("mk", "wrong pass")


def test_what_is_written_and_deleted_is_told_to_streams(client, address, note):
    client.delete(f"{HERE}/{note['id']}?who=jb").raise_for_status()
    query = {"spacecraft": "XTE", "last_event_id": 0}
    with httpx.stream("GET", f"{address}/api/v1/events", params=query, timeout=10) as answer:
        told = []
        for line in answer.iter_lines():
            if note["id"] in line:
                told.append('"deleted":true' in line)
            if len(told) == 2:
                break
    assert told == [False, True]


def test_a_note_survives_a_restart_and_is_text_on_the_page(chosen_database, drawn):
    settings = in_process_settings(chosen_database())
    with Server(create_app(open_app(settings))) as url:
        httpx.post(f"{url}/api/v1/batches", json=drawn("XTE", 1)[0]).raise_for_status()
        evil = "<script>alert(1)</script> & <b>bold</b>"
        asked = NOTE | {"text": evil, "who": "<i>jb</i>", "end": END}
        httpx.post(f"{url}{HERE}", json=asked).raise_for_status()
    with Server(create_app(open_app(settings))) as url:
        page = httpx.get(f"{url}/spacecraft/XTE", params={"start": START, "end": END}).text
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; &lt;b&gt;bold" in page
    assert "<script>alert" not in page
    assert "<i>jb" not in page


def test_a_page_lists_the_notes_of_every_spacecraft_by_spacecraft_and_period(client):
    ids = [
        client.post(HERE, json=NOTE | each).json()["id"]
        for each in (
            {"text": "<b>old</b> note", "end": END},
            {"text": "of SWAS", "spacecraft": "SWAS", "start": END},
            {"text": "of all", "spacecraft": None, "start": END},
        )
    ]

    def listed(**query):
        page = client.get("/annotations", params=query).raise_for_status().text
        Markup(page)
        return re.findall(r'<td class="text" data-name="text">(.*?)</td>', page)

    try:
        old, swas, every = "&lt;b&gt;old&lt;/b&gt; note", "of SWAS", "of all"
        assert listed() == [every, swas, old]
        assert listed(spacecraft="XTE") == [every, old]
        assert listed(start=END) == [every, swas, old]
        assert listed(end=END) == [old]
        assert listed(start="1999-060T00:21:00Z", end="") == []
        assert client.get("/annotations?start=noon").status_code == 422
        page = client.get("/annotations").text
        around = "start=1999-02-28T23%3A30%3A00.000Z&amp;end=1999-03-01T00%3A50%3A00.000Z"
        assert f'href="/spacecraft/XTE?{around}"' in page
    finally:
        for id in ids:
            client.delete(f"{HERE}/{id}?who=jb").raise_for_status()
    assert "No annotations yet" in client.get("/annotations").text


def test_a_token_signs_with_its_name_and_one_bound_to_spacecraft_writes_about_these(
    chosen_database,
):
    service = Guarded(chosen_database())
    operator = shown(service.token("J. Operator", "read", "operate"))
    bound = shown(service.token("swas", "read", "operate", spacecraft=["SWAS"]))
    reader = shown(service.token("reader", "read"))
    with (
        Server(create_app(service.app)) as url,
        httpx.Client(base_url=url, timeout=60) as client,
    ):
        written = client.post(HERE, json=NOTE | {"who": "somebody else"}, headers=operator)
        assert written.json()["who"] == "J. Operator"
        of_all = client.post(HERE, json=NOTE | {"spacecraft": None}, headers=operator).json()
        assert client.post(HERE, json=NOTE, headers=reader).status_code == 403
        assert client.post(HERE, json=NOTE, headers=bound).status_code == 403
        assert client.post(HERE, json=NOTE | {"spacecraft": None}, headers=bound).status_code == 403
        own = client.post(HERE, json=NOTE | {"spacecraft": "SWAS"}, headers=bound)
        assert own.status_code == 201
        assert client.get(HERE, headers=bound).status_code == 403
        listed = client.get(HERE, params={"spacecraft": "SWAS"}, headers=bound).json()["items"]
        assert [each["id"] for each in listed] == [own.json()["id"], of_all["id"]]
        page = client.get("/annotations", headers=bound).text
        assert page.count('data-name="text"') == 2
        assert client.get("/annotations?spacecraft=XTE", headers=bound).status_code == 403
        for note, status in ((written.json(), 404), (of_all, 403), (own.json(), 200)):
            answer = client.delete(f"{HERE}/{note['id']}", headers=bound)
            assert answer.status_code == status
