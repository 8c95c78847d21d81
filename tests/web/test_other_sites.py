"""What pages of other sites can have a browser ask for, while nobody needs a token."""

import httpx
import pytest

from tests.web.test_bodies import raw

LINK = {
    "Sec-Fetch-Site": "cross-site",
    "Sec-Fetch-Mode": "navigate",
    "Sec-Fetch-Dest": "document",
    "Sec-Fetch-User": "?1",
}
IMAGE = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"}
SCRIPT = {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "cors", "Sec-Fetch-Dest": "empty"}
FRAME = LINK | {"Sec-Fetch-Dest": "iframe"}
MOVED_BY_SCRIPT = {name: value for name, value in LINK.items() if name != "Sec-Fetch-User"}
OLD_BROWSER = {"Origin": "https://elsewhere.example"}
SANDBOX = {"Origin": "null"}
OTHERS = (IMAGE, SCRIPT, FRAME, MOVED_BY_SCRIPT, OLD_BROWSER, SANDBOX)


@pytest.fixture(scope="module")
def costly(client, full_run):
    """Addresses whose answers have to be worked out."""
    latest = client.get(f"/api/v1/batches?run={full_run}&spacecraft=XTE&limit=1").json()
    pages = (
        f"/batches/{latest['items'][0]['id']}?identifier=starid",
        f"/compare?spacecraft=XTE&run={full_run}",
        f"/advice/XTE?run={full_run}",
    )
    data = (
        f"/api/v1/spacecraft/XTE/advice?run={full_run}",
        f"/api/v1/spacecraft/XTE/history?run={full_run}&format=csv",
        f"/api/v1/batches?run={full_run}",
        "/api/v1/overview",
        "/metrics",
    )
    return pages, data


def statuses(client, addresses, headers):
    return {each: client.get(each, headers=headers).status_code for each in addresses}


def stream_begun(address, headers):
    """The status alone: the stream has no end."""
    with httpx.stream("GET", f"{address}/api/v1/events", headers=headers) as answer:
        return answer.status_code


@pytest.mark.parametrize("headers", OTHERS, ids=range(len(OTHERS)))
def test_a_page_of_another_site_has_nothing_worked_out(client, address, costly, headers):
    pages, data = costly
    asked = (*pages, *data, "/", "/alarms")
    assert statuses(client, asked, headers) == dict.fromkeys(asked, 403)
    assert stream_begun(address, headers) == 403
    changed = client.post("/api/v1/alarms/01JD0000000000000000000000/acknowledge", headers=headers)
    assert changed.status_code == 403


def test_a_link_elsewhere_leads_to_every_page_but_not_to_data(client, costly):
    pages, data = costly
    reached = (*pages, "/", "/alarms", "/batches", "/runs", "/about")
    assert statuses(client, reached, LINK) == dict.fromkeys(reached, 200)
    assert statuses(client, data, LINK) == dict.fromkeys(data, 403)


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Sec-Fetch-Site": "none", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"},
        {"Sec-Fetch-Site": "same-origin", "Sec-Fetch-Mode": "cors", "Sec-Fetch-Dest": "empty"},
    ],
    ids=["a program", "an address typed in", "a page of the service"],
)
def test_everybody_else_is_answered(client, address, costly, headers):
    pages, data = costly
    asked = (*pages, *data)
    assert statuses(client, asked, headers) == dict.fromkeys(asked, 200)
    assert stream_begun(address, headers) == 200


def test_a_page_of_the_service_in_an_old_browser_is_answered(client, address):
    own = {"Origin": address}
    assert statuses(client, ["/", "/api/v1/overview"], own) == {"/": 200, "/api/v1/overview": 200}


@pytest.mark.parametrize("headers", OTHERS, ids=range(len(OTHERS)))
def test_probes_are_answered_whoever_asks(client, headers):
    assert statuses(client, ["/livez", "/readyz"], headers) == {"/livez": 200, "/readyz": 200}


def test_without_a_host_http_1_0_is_answered(address):
    answer = raw(address, b"GET /api/v1/overview HTTP/1.0\r\nCookie: acquire_session=acq_x\r\n\r\n")
    assert answer.startswith(b"HTTP/1.1 200")
