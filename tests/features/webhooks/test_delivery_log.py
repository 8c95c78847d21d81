"""The log says once that a webhook fails, gives events up, stops, or goes on."""

import logging
from dataclasses import replace

import pytest

from service.features.webhooks.messages import DeliveryLog
from service.features.webhooks.records import Registered

HOOK = Registered(
    id="01JD0000000000000000000001",
    name="pager",
    url="https://receiver.invalid/secret",
    kinds=None,
    spacecraft=None,
    severity=None,
    run=None,
    secret="whsec_x",
    previous_secret=None,
    previous_until=None,
    position=0,
    held_until=None,
    state="active",
    reason=None,
)


@pytest.fixture
def told(caplog):
    with caplog.at_level(logging.INFO):
        yield caplog


def test_failures_are_counted_and_told_once(told):
    log = DeliveryLog()
    log.listed([HOOK])
    assert log.counts["01JD0000000000000000000001", "pager", "dead"] == 0
    for _ in range(300):
        log.failed(HOOK, 7, "status 500", is_dead=False)
    for event in (7, 8):
        log.failed(HOOK, event, "status 500", is_dead=True)
    log.delivered(HOOK, 0)
    log.delivered(HOOK, 3)
    log.delivered(HOOK, 1)
    assert told.messages == [
        "webhook pager: event 7 was not delivered: status 500",
        "webhook pager: event 7 is a dead letter: status 500",
        "webhook pager: delivers again after 302 failed attempts; dead letters: 2",
    ]
    assert dict(log.counts) == {
        (HOOK.id, "pager", "delivered"): 4,
        (HOOK.id, "pager", "failed"): 300,
        (HOOK.id, "pager", "dead"): 2,
    }


def test_a_webhook_that_is_paused_or_disabled_is_told_of_once_with_the_reason(told):
    log = DeliveryLog()
    gone = replace(HOOK, state="disabled", reason="the receiver answered 410 Gone")
    for each in (HOOK, gone, gone, HOOK):
        log.listed([each])
    assert told.messages == [
        "webhook pager: disabled: the receiver answered 410 Gone",
        "webhook pager: active again",
    ]
    assert "secret" not in told.text
