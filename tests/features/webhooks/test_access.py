"""Whose events a webhook is sent, what is kept secret, and what a wrong request is told."""

import queue
import re
import time

import pytest
from sqlalchemy import select

from service import access as sessions
from service.features.webhooks.records import read_sender
from service.features.webhooks.tables import webhooks
from service.storage.recording.ids import Ulids
from service.storage.sql.tables import audit
from tests.features.webhooks.conftest import HERE, serving
from tests.waiting import wait_until
from tests.web.conformance import check
from tests.web.test_access import Guarded, shown

SETTINGS = {"name": "pager", "url": "https://receiver.example/"}


class Tokens(Guarded):
    """Tokens for a service that is open already."""

    def __init__(self, app):
        self.app, self._ids = app, Ulids()


def test_a_webhook_ends_with_its_token_and_goes_on_with_another(service, receiver):
    tokens = Tokens(service.app)
    headers = shown(tokens.token("first", "read", "operate"))
    settings = {"name": "mine", "url": receiver.url}
    wait_until(lambda: not service.app.access.is_open)
    made = service.client.post(HERE, json=settings, headers=headers).json()
    assert made["who"] == "first"
    service.note("seen")
    receiver.next()
    tokens.revoke("first")
    # Until then what was known of the token may still count.
    time.sleep(sessions.KNOWN_FOR_S)
    service.note("held")
    headers = shown(tokens.token("second", "read", "operate"))

    def state():
        return service.client.get(f"{HERE}/{made['id']}", headers=headers).json()

    assert state()["state"] == "paused"
    assert "'first' was revoked" in state()["reason"]
    with pytest.raises(queue.Empty):
        receiver.next(1.5)
    answer = service.client.put(f"{HERE}/{made['id']}", json=settings, headers=headers)
    assert answer.json()["who"] == "second"
    assert b"held" in receiver.next().body


def test_a_webhook_of_open_access_is_paused_by_the_first_token(service, receiver):
    hook = service.hook(receiver.url)
    headers = shown(Tokens(service.app).token("op", "read", "operate"))
    wait_until(lambda: not service.app.access.is_open)
    state = service.client.get(f"{HERE}/{hook['id']}", headers=headers).json()
    assert (state["state"], "without a token" in state["reason"]) == ("paused", True)


def test_a_token_that_may_not_read_or_is_bound_makes_none(service):
    tokens = Tokens(service.app)
    without_read = shown(tokens.token("op", "operate"))
    bound = shown(tokens.token("bound", "read", "operate", spacecraft=["XTE"]))
    wait_until(lambda: not service.app.access.is_open)
    for headers in (without_read, bound):
        answer = service.client.post(HERE, json=SETTINGS, headers=headers)
        assert answer.status_code == 403
    assert service.client.get(HERE, headers=bound).status_code == 403
    assert service.client.get(HERE, headers=without_read).json() == {"items": []}


def test_the_secret_is_shown_once_and_every_change_is_in_the_audit_list(service, receiver, caplog):
    caplog.set_level("DEBUG")
    hook = service.hook(receiver.url)
    here = f"{HERE}/{hook['id']}"
    rotated = service.ask(hook, "secret").json()["secret"]
    told = [
        service.client.get(HERE).text,
        service.client.get(here).text,
        service.client.put(here, json=SETTINGS).text,
        service.client.get("/webhooks").text,
        service.client.get("/metrics").text,
        service.ask(hook, "replay", since="1999-01-01T00:00:00Z").text,
        service.ask(hook, "retry").text,
        service.client.delete(here).text,
        service.client.get("/api/v1/audit").text,
        caplog.text,
    ]
    for secret in (hook["secret"], rotated):
        assert not [each for each in told if secret in each]
    with service.app.context.reading() as connection:
        actions = list(connection.scalars(select(audit.c.action).order_by(audit.c.id)))
        assert connection.execute(select(webhooks)).all() == []
    assert actions == [
        "add_webhook",
        "rotate_webhook_secret",
        "change_webhook",
        "replay_events",
        "retry_dead_letters",
        "delete_webhook",
    ]


@pytest.fixture(scope="module")
def empty_service(chosen_database):
    with serving(chosen_database()) as service:
        yield service


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"name": ""}, "name"),
        ({"name": "a\x00"}, "name"),
        ({"url": "https://10.0.0.1/"}, "url"),
        ({"url": "https://receiver.example/\x00"}, "url"),
        ({"url": None}, "url"),
        ({"kinds": []}, "kinds"),
        ({"kinds": ["batch"]}, "kinds[0]"),
        ({"severity": "bad"}, "severity"),
        ({"spacecraft": ["NOPE"]}, "spacecraft"),
        ({"run": "a b"}, "run"),
        ({"secret": "whsec_AAAA"}, "secret"),
    ],
)
def test_a_bad_field_is_named_and_nothing_is_stored(empty_service, change, field):
    answer = empty_service.client.post(HERE, json=SETTINGS | change)
    assert answer.status_code == 422, answer.text
    named = answer.json()["errors"][0]["field"]
    assert named.partition(".")[0].partition("[")[0] == field.partition("[")[0]
    assert empty_service.client.get(HERE).json() == {"items": []}


def test_an_unknown_webhook_is_not_found_and_answers_are_as_described(service, receiver):
    service.client.event_hooks = {"response": [check]}
    for id in ("x", "01JD0000000000000000000000"):
        here = f"{HERE}/{id}"
        assert service.client.get(here).status_code == 404
        assert service.client.put(here, json=SETTINGS).status_code == 404
        assert service.client.delete(here).status_code == 404
        assert service.client.get(f"{here}/deliveries").status_code == 404
        for what, body in (("test", {}), ("secret", {}), ("retry", {})):
            assert service.ask({"id": id}, what, **body).status_code == 404
        replayed = service.ask({"id": id}, "replay", since="1999-01-01T00:00:00Z")
        assert replayed.status_code == 404
    receiver.answer = lambda handler, _: handler.say(500)
    hook = service.hook(receiver.url)
    for number in range(5):
        service.note(f"n{number}")
    wait_until(lambda: service.read(hook)["waiting"] == 5 and service.read(hook)["last_fault"])
    first = service.client.get(f"{HERE}/{hook['id']}/deliveries", params={"limit": 3})
    rest = service.client.get(first.links["next"]["url"])
    numbers = [each["event"] for each in first.json()["items"] + rest.json()["items"]]
    assert numbers == sorted(numbers, reverse=True)
    assert len(numbers) == 5
    oldest = {"limit": 3, "order": "oldest"}
    first = service.client.get(f"{HERE}/{hook['id']}/deliveries", params=oldest)
    rest = service.client.get(first.links["next"]["url"])
    assert [e["event"] for e in first.json()["items"] + rest.json()["items"]] == numbers[::-1]
    bad = service.client.get(f"{HERE}/{hook['id']}/deliveries", params={"cursor": "x"})
    assert bad.json()["errors"][0]["field"] == "cursor"


def test_there_are_at_most_fifty(service):
    for number in range(50):
        url = f"https://receiver.example/{number}"
        service.hook(url, enabled=False)
    answer = service.client.post(HERE, json=SETTINGS)
    assert answer.status_code == 409
    assert "50 webhooks" in answer.json()["detail"]


def test_metrics_tell_what_waits_and_what_came_of_attempts(service, receiver):
    receiver.answer = lambda handler, _: handler.say(500)
    hook = service.hook(receiver.url, name="pager")
    service.note("x")
    wait_until(lambda: service.read(hook)["last_fault"])
    told = service.client.get("/metrics").text
    labels = f'{{name="pager",webhook="{hook["id"]}"}}'
    assert f"starid_webhook_waiting{labels} 1.0" in told
    assert f"starid_webhook_active{labels} 1.0" in told
    failed = labels.replace("webhook=", 'result="failed",webhook=')
    assert f"starid_webhook_attempts_total{failed} 1.0" in told


def test_a_paused_webhook_shows_how_long_events_wait_and_the_overview_says_it(service, receiver):
    receiver.answer = lambda handler, _: handler.say(410)
    hook = service.hook(receiver.url, name="pager")
    service.note("x")
    wait_until(lambda: service.read(hook)["state"] == "disabled")
    time.sleep(0.02)
    told = service.client.get("/metrics").text
    labels = f'{{name="pager",webhook="{hook["id"]}"}}'
    (oldest,) = re.findall(rf"starid_webhook_oldest_seconds{re.escape(labels)} (\S+)", told)
    assert float(oldest) > 0.0
    assert "pager is disabled, 1 events wait" in service.client.get("/").text


def test_a_second_rotation_keeps_what_the_first_promised(service, receiver):
    hook = service.hook(receiver.url, enabled=False)
    # Every field has a default: the body may be left out.
    first = service.client.post(f"{HERE}/{hook['id']}/secret")
    assert first.status_code == 200, first.text
    refused = service.ask(hook, "secret")
    assert refused.status_code == 409
    assert first.json()["previous_until"] in refused.json()["detail"]
    assert service.read(hook)["previous_until"] == first.json()["previous_until"]
    assert service.ask(hook, "secret", previous_hours=0).json()["previous_until"] is None
    assert service.client.post(f"{HERE}/{hook['id']}/retry").json() == {"queued": 0}


def test_what_can_never_be_sent_is_refused_when_it_is_asked(service, receiver):
    hook = service.hook(receiver.url, enabled=False)
    period = {"since": "1999-01-02T00:00:00Z", "until": "1999-01-01T00:00:00Z"}
    for what, body, said in (
        ("retry", {"events": [7]}, "must be dead letters"),
        ("replay", period, "must be after since"),
    ):
        answer = service.ask(hook, what, **body)
        assert (answer.status_code, said in answer.text) == (422, True), answer.text


def test_plain_http_to_a_name_in_no_allowed_network_is_refused_at_once(chosen_database):
    with serving(chosen_database(), allowed="10.20.0.0/16") as service:
        settings = {"name": "test", "url": "http://localhost:8080/hook"}
        answer = service.client.post(HERE, json=settings)
        assert answer.status_code == 422
        assert "ACQUIRE_WEBHOOK_NETWORKS" in answer.text


def test_a_service_without_webhooks_writes_nothing_of_them(chosen_database):
    with serving(chosen_database()) as service:
        service.note("x")
        with service.app.context.reading() as connection:
            assert read_sender(connection) == (None, 0)
