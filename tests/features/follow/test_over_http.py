"""Only an answer of the service settles a message that is sent over HTTP."""

import asyncio
import json

import httpx
import pytest
from acquire_client import AsyncClient
from acquire_client import errors as answers

from service.features.follow.follower import Answer, NotNow, Refused
from service.features.follow.over_http import OverHttp


def answered_with(status, kind, content, message=b"{}"):
    async def submit():
        async with AsyncClient("http://service", give_up_after_s=0.1) as client:
            response = httpx.Response(status, headers={"Content-Type": kind}, content=content)
            transport = httpx.MockTransport(lambda request: response)
            client._http = httpx.AsyncClient(transport=transport, base_url=client.url)
            return await OverHttp(client)(message)

    return asyncio.run(submit())


def problem(status, kind="about:blank"):
    named = {"type": kind, "title": "x", "status": status, "detail": "of it", "instance": "/"}
    return json.dumps(named)


HTML, JSON, PROBLEM = "text/html; charset=utf-8", "application/json", "application/problem+json"


@pytest.mark.parametrize(
    ("status", "kind", "content"),
    [
        *((status, HTML, "<form>Sign in</form>") for status in (200, 201, 204, 302, 400)),
        (202, JSON, "{}"),
        *((status, HTML, "<h1>Sorry</h1>") for status in (403, 404, 405, 407, 413, 502, 526)),
        (404, JSON, '{"message": "no route"}'),
    ],
)
def test_a_message_waits_where_something_else_than_the_service_answers(status, kind, content):
    with pytest.raises(NotNow):
        answered_with(status, kind, content)


@pytest.mark.parametrize("content", ["<h1>Sorry</h1>", problem(421, "/problems/not-this-host")])
def test_a_wrong_name_of_the_service_ends_the_follower(content):
    with pytest.raises(answers.Forbidden):
        answered_with(421, PROBLEM, content)


@pytest.mark.parametrize(
    ("status", "kind", "has_failed"),
    [
        (403, "/problems/not-allowed", False),
        (404, "about:blank", False),
        (413, "about:blank", False),
        (422, "/problems/bad-input", False),
        (500, "about:blank", True),
    ],
)
def test_a_problem_of_the_service_refuses_the_message(status, kind, has_failed):
    with pytest.raises(Refused) as refused:
        answered_with(status, PROBLEM, problem(status, kind))
    assert refused.value.has_failed == has_failed
    assert refused.value.problem["status"] == status


@pytest.mark.parametrize("status", [200, 201])
def test_json_of_the_service_is_a_recorded_message(status):
    assert answered_with(status, JSON, b"{}") == Answer(b"{}", is_repeated=False)
