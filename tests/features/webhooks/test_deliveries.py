"""Events reach their receivers: signed, in order, again where it failed, and not for ever."""

import json
import threading
import time
from email.utils import formatdate

import pytest
from sqlalchemy import update
from standardwebhooks.webhooks import Webhook, WebhookVerificationError

from service.features.webhooks import sender
from service.features.webhooks.sender import retry_delay_s
from service.features.webhooks.tables import webhooks
from service.storage.recording import events
from tests.features.webhooks.conftest import HERE, receiving, serving
from tests.waiting import wait_until


def texts(receiver):
    return [json.loads(each.body)["data"]["text"] for each in receiver.requests]


def failing_for(*spacecraft, status=500, **headers):
    """An answer that refuses the events of some spacecraft, as long as they are in the list."""
    refused = list(spacecraft)

    def answer(handler, request):
        fails = json.loads(request.body).get("spacecraft") in refused
        handler.say(status if fails else 204, **(headers if fails else {}))

    answer.refused = refused
    return answer


def test_an_event_arrives_signed_as_the_standard_says(service, receiver):
    hook = service.hook(receiver.url)
    written = service.note("Wheel 2 unloaded")
    request = receiver.next()
    told = Webhook(hook["secret"]).verify(request.body, request.headers)
    assert told["type"] == "annotation"
    assert told["spacecraft"] == "XTE"
    assert told["data"]["id"] == written.id
    assert abs(int(request.headers["webhook-timestamp"]) - time.time()) < 60
    with pytest.raises(WebhookVerificationError):
        Webhook(hook["secret"]).verify(request.body + b" ", request.headers)
    wait_until(lambda: service.read(hook)["last_delivered"])
    assert service.read(hook)["waiting"] == 0


def test_after_a_rotation_both_secrets_sign_until_the_stated_time(service, receiver):
    hook = service.hook(receiver.url)
    rotated = service.ask(hook, "secret", previous_hours=1).json()
    assert rotated["secret"] != hook["secret"]
    assert rotated["previous_until"] > rotated["created"]
    service.note("both")
    request = receiver.next()
    for secret in (hook["secret"], rotated["secret"]):
        Webhook(secret).verify(request.body, request.headers)
    again = service.ask(hook, "secret", previous_hours=0).json()
    assert again["previous_until"] is None
    service.note("one")
    request = receiver.next()
    Webhook(again["secret"]).verify(request.body, request.headers)
    with pytest.raises(WebhookVerificationError):
        Webhook(rotated["secret"]).verify(request.body, request.headers)


def test_a_failure_holds_back_its_spacecraft_alone_and_order_is_kept(service, receiver, soon):
    receiver.answer = failing_for("XTE")
    hook = service.hook(receiver.url)
    for text in ("x1", "x2", "x3"):
        service.note(text)
    for text in ("s1", "s2"):
        service.note(text, "SWAS")
    wait_until(lambda: "s2" in texts(receiver) and texts(receiver).count("x1") > 1)
    assert "x2" not in texts(receiver)
    state = service.read(hook)
    assert state["last_fault"] == "status 500" or state["failing_since"] is None
    receiver.answer.refused.clear()
    wait_until(lambda: "x3" in texts(receiver))
    assert list(dict.fromkeys(each for each in texts(receiver) if each[0] == "x")) == [
        "x1",
        "x2",
        "x3",
    ]
    ids = {
        request.headers["webhook-id"]
        for request, text in zip(receiver.requests, texts(receiver), strict=True)
        if text == "x1"
    }
    assert len(ids) == 1


def test_pauses_double_to_an_hour_with_up_to_a_fifth_more():
    assert [retry_delay_s(n, 0.0) for n in (1, 2, 3, 10, 11, 50)] == [5, 10, 20, 2560, 3600, 3600]
    assert retry_delay_s(1, 1.0) == 6.0


@pytest.mark.parametrize("as_date", [False, True])
def test_retry_after_is_heeded_for_the_whole_webhook(service, receiver, soon, as_date):
    date_s = int(time.time()) + 3
    asked = formatdate(date_s, usegmt=True) if as_date else "2"
    refuse, asked_s = failing_for("XTE", status=429, Retry_After=asked), []

    def answer(handler, request):
        asked_s.append(time.time())
        refuse(handler, request)

    receiver.answer = answer
    hook = service.hook(receiver.url)
    service.note("first")
    wait_until(lambda: service.read(hook)["last_status"] == 429)
    service.note("other", "SWAS")
    wait_until(lambda: len(asked_s) > 1)
    assert asked_s[1] > (date_s if as_date else asked_s[0] + 2) - 0.05


def test_410_disables_a_webhook_until_it_is_changed(service, receiver, soon):
    receiver.answer = failing_for("XTE", status=410)
    hook = service.hook(receiver.url)
    service.note("gone")
    state = wait_until(lambda: (r := service.read(hook))["state"] == "disabled" and r)
    assert "410" in state["reason"]
    service.note("later")
    time.sleep(0.5)
    assert texts(receiver) == ["gone"]
    receiver.answer.refused.clear()
    settings = {"name": "test", "url": receiver.url}
    changed = service.client.put(f"{HERE}/{hook['id']}", json=settings).json()
    assert (changed["state"], changed["reason"]) == ("active", None)
    wait_until(lambda: texts(receiver) == ["gone", "gone", "later"])


def test_after_a_day_an_event_is_a_dead_letter_and_is_sent_again_on_request(
    service, receiver, soon, monkeypatch
):
    monkeypatch.setattr(sender, "DEAD_AFTER_S", 0.5)
    receiver.answer = failing_for("XTE")
    hook = service.hook(receiver.url)
    service.note("dead")
    service.note("alive", "SWAS")
    wait_until(lambda: service.read(hook)["dead"] == 1)
    address = f"{HERE}/{hook['id']}/deliveries"
    (letter,) = service.client.get(address, params={"state": "dead"}).json()["items"]
    assert letter["spacecraft"] == "XTE"
    assert letter["last_fault"] == "status 500"
    assert letter["attempts"] >= 1
    labels = f'{{name="test",webhook="{hook["id"]}"}}'
    assert f"starid_webhook_dead_letters{labels} 1.0" in service.client.get("/metrics").text
    receiver.answer.refused.clear()
    assert service.ask(hook, "retry", events=[letter["event"] + 1]).status_code == 422
    assert service.ask(hook, "retry", events=[letter["event"]]).json() == {"queued": 1}
    wait_until(lambda: service.read(hook)["dead"] == 0 and service.read(hook)["waiting"] == 0)
    sent = [each.headers["webhook-id"] for each in receiver.requests]
    assert sent.count(letter["message_id"]) == letter["attempts"] + 1


def test_what_waits_is_sent_after_a_restart_once_it_is_due(chosen_database, receiver, soon):
    database = chosen_database()
    receiver.answer = failing_for("XTE")
    with serving(database) as service:
        hook = service.hook(receiver.url)
        service.note("before")
        wait_until(lambda: service.read(hook)["last_fault"])
    receiver.answer.refused.clear()
    begun = len(receiver.requests)
    with serving(database) as service:
        wait_until(lambda: len(receiver.requests) > begun)
        service.note("after")
        wait_until(lambda: texts(receiver)[-1] == "after")
        assert service.read(hook)["waiting"] == 0
    assert texts(receiver)[begun:] == ["before", "after"]


def test_a_period_is_sent_again_with_the_same_ids(service, receiver):
    hook = service.hook(receiver.url, kinds=["annotation"])
    for text in ("a", "b"):
        service.note(text)
    wait_until(lambda: len(receiver.requests) == 2)
    wait_until(lambda: service.read(hook)["waiting"] == 0)
    first = [each.headers["webhook-id"] for each in receiver.requests]
    bodies = [each.body for each in receiver.requests]
    replayed = service.ask(hook, "replay", since=hook["created"])
    assert replayed.json() == {"queued": 2}
    wait_until(lambda: len(receiver.requests) == 4)
    assert [each.headers["webhook-id"] for each in receiver.requests[2:]] == first
    assert [each.body for each in receiver.requests[2:]] == bodies
    none = service.ask(hook, "replay", since="1999-01-01T00:00:00Z", until="1999-01-02T00:00:00Z")
    assert none.json() == {"queued": 0}


def test_filters_choose_by_kind_spacecraft_run_and_severity(service, receiver):
    def add(kind, data, **about):
        service.app.context.change(lambda c: events.add_event(c, kind, data, **about))

    wanted = {"kinds": ["alarm"], "spacecraft": ["XTE"], "severity": "warning"}
    service.hook(receiver.url, **wanted)
    live = {"run": "live", "spacecraft": "XTE"}
    add("batches", {"severity": "critical"}, **live)
    add("alarm", {"severity": "watch", "n": 1}, **live)
    add("alarm", {"severity": "critical", "n": 2}, run="live", spacecraft="SWAS")
    add("alarm", {"severity": "critical", "n": 3}, run="pass-7", spacecraft="XTE")
    add("alarm", {"severity": "warning", "n": 4}, **live)
    add("alarm", {"severity": "critical", "n": 5}, **live)
    wait_until(lambda: len(receiver.requests) == 2)
    assert [json.loads(each.body)["data"]["n"] for each in receiver.requests] == [4, 5]


def test_a_receiver_that_hangs_or_drips_holds_up_no_other_and_no_request(
    service, receiver, monkeypatch
):
    monkeypatch.setattr("service.features.webhooks.posts.TOTAL_S", 1.0)
    release = threading.Event()

    def hang(handler, request):
        release.wait(30)

    def drip(handler, request):
        handler.send_response(200)
        handler.end_headers()
        while not release.wait(0.1):
            handler.wfile.write(b"x")

    with receiving() as hanging, receiving() as dripping:
        hanging.answer, dripping.answer = hang, drip
        hooks = [service.hook(each.url) for each in (hanging, dripping)]
        service.hook(receiver.url)
        for spacecraft in ("XTE", "SWAS", "SOHO"):
            service.note("held", spacecraft)
        for _ in range(3):
            receiver.next()
        # Both hold their requests still.
        assert service.client.get("/livez").status_code == 200
        for hook in hooks:
            fault = wait_until(lambda hook=hook: service.read(hook)["last_fault"])
            assert fault == "no complete answer within 1 s"
        release.set()


def test_of_a_long_answer_no_more_than_64_kib_are_read(service, receiver):
    sent = []

    def pour(handler, request):
        handler.send_response(200)
        handler.end_headers()
        try:
            while len(sent) < 4000:
                handler.wfile.write(b"x" * 65536)
                sent.append(65536)
        except OSError:
            pass

    receiver.answer = pour
    hook = service.hook(receiver.url)
    service.note("long")
    wait_until(lambda: service.read(hook)["last_delivered"])
    # What the kernel's buffers took besides is no more than some megabytes.
    assert sum(sent) < 32 << 20


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_of_two_services_on_one_database_one_delivers(database, receiver):
    with serving(database) as one, serving(database) as other:
        one.hook(receiver.url)
        for n in range(20):
            (one, other)[n % 2].note(f"n{n}")
        wait_until(lambda: len(receiver.requests) >= 20)
        time.sleep(0.5)
    assert texts(receiver) == [f"n{n}" for n in range(20)]


def test_a_webhook_that_another_process_moved_on_goes_on_from_there(service, receiver):
    service.hook(receiver.url)
    service.note("n0")
    receiver.next()
    moved = update(webhooks).values(position=webhooks.c.position + 1)
    service.app.store.writer.change(lambda writing: writing.execute(moved).rowcount)
    service.note("n1")
    service.note("n2")
    wait_until(lambda: texts(receiver)[-1:] == ["n2"])
    assert texts(receiver) == ["n0", "n2"]


def test_a_webhook_that_is_enabled_delivers_at_once(service, receiver, monkeypatch):
    monkeypatch.setattr(sender, "POLL_S", 60.0)
    hook = service.hook(receiver.url, enabled=False)
    service.note("n0")
    time.sleep(0.5)
    assert not receiver.requests
    service.client.put(f"{HERE}/{hook['id']}", json={"name": "t", "url": receiver.url})
    wait_until(lambda: texts(receiver) == ["n0"])


def test_events_that_were_deleted_before_their_turn_are_counted(service, receiver, monkeypatch):
    hook = service.hook(receiver.url, enabled=False)
    monkeypatch.setattr(events, "KEPT", 10)
    monkeypatch.setattr(events, "PRUNED_EVERY", 5)
    for n in range(40):
        service.note(f"n{n}")
    service.client.put(f"{HERE}/{hook['id']}", json={"name": "t", "url": receiver.url})
    wait_until(lambda: texts(receiver)[-1:] == ["n39"])
    assert service.read(hook)["missed"] + len(receiver.requests) == 40


def test_a_test_event_is_sent_at_once_and_its_outcome_told(service, receiver):
    hook = service.hook(receiver.url)
    told = service.ask(hook, "test").json()
    assert told["delivered"] is True
    assert told["status"] == 204
    request = receiver.next()
    assert request.headers["webhook-id"] == told["message_id"]
    assert Webhook(hook["secret"]).verify(request.body, request.headers)["type"] == "test"
    receiver.answer = lambda handler, request: handler.say(503)
    assert service.ask(hook, "test").json()["fault"] == "status 503"


def test_a_status_of_2xx_alone_delivers(service, receiver):
    hook = service.hook(receiver.url)
    redirected = "redirects are not followed"
    for status, fault in [(200, None), (299, None), (300, redirected), (399, redirected)]:
        receiver.answer = lambda handler, request, status=status: handler.say(status)
        outcome = service.ask(hook, "test").json()
        assert (outcome["status"], outcome["delivered"]) == (status, fault is None)
        assert outcome["fault"] == (fault and f"status {status}: {fault}")
    receiver.answer = lambda handler, request: handler.say(400)
    assert service.ask(hook, "test").json()["fault"] == "status 400"


def test_a_backlog_is_bounded_and_the_rest_comes_later(service, receiver, monkeypatch, soon):
    monkeypatch.setattr(sender, "MAX_WAITING", 5)
    monkeypatch.setattr(sender, "READ_AT_ONCE", 5)
    receiver.answer = failing_for("XTE")
    hook = service.hook(receiver.url)
    for n in range(20):
        service.note(f"n{n}")
    wait_until(lambda: service.read(hook)["last_fault"])
    assert service.read(hook)["waiting"] <= 10
    receiver.answer.refused.clear()
    wait_until(lambda: texts(receiver)[-1] == "n19")
    assert list(dict.fromkeys(texts(receiver))) == [f"n{n}" for n in range(20)]
