"""Prometheus metrics of webhooks: queue lengths and delivery attempts."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from service.app.factory import App
from service.features.webhooks.messages import Result
from service.features.webhooks.part import Webhooks
from service.features.webhooks.records import Webhook
from service.times import recorded_utc, utc_now


def reads(app: App) -> Mapping[str, Callable[[], Any]]:
    """Function that reads the webhooks from the database for the metrics, by its name."""
    return {"webhooks": app.part(Webhooks).all}


def collect(app: App, found: Mapping[str, Any]) -> Iterator[Metric]:
    """Metrics of webhooks, if the database answered, and of attempts since the start."""
    if "webhooks" in found:
        yield from _of_webhooks(found["webhooks"])
    yield _of_attempts(app.part(Webhooks).sender.log.counts)


def _of_webhooks(webhooks: Sequence[Webhook]) -> Iterator[Metric]:
    """Metrics of each webhook: queue length, age of the queue, and if it is active."""
    labels = ("webhook", "name")
    active = GaugeMetricFamily(
        "starid_webhook_active",
        "1 where events are sent, 0 where not, though nobody paused it.",
        labels=labels,
    )
    waiting = GaugeMetricFamily(
        "starid_webhook_waiting", "Events that are queued for a webhook.", labels=labels
    )
    oldest = GaugeMetricFamily(
        "starid_webhook_oldest_seconds", "The age of the oldest of them.", labels=labels
    )
    dead = GaugeMetricFamily(
        "starid_webhook_dead_letters", "Events that were not delivered within a day.", labels=labels
    )
    now = utc_now()
    for each in webhooks:
        names = (each.id, each.name)
        age_s = (
            0.0 if each.oldest is None else (now.tai_ns - recorded_utc(each.oldest).tai_ns) / 1e9
        )
        if each.enabled:
            active.add_metric(names, float(each.state == "active"))
        waiting.add_metric(names, each.waiting)
        oldest.add_metric(names, max(age_s, 0.0))
        dead.add_metric(names, each.dead)
    yield from (active, waiting, oldest, dead)


def _of_attempts(counts: Mapping[tuple[str, str, Result], int]) -> Metric:
    family = CounterMetricFamily(
        "starid_webhook_attempts",
        "Attempts to deliver an event to a webhook; of dead ones it was the last.",
        labels=("webhook", "name", "result"),
    )
    for labels, count in sorted(counts.items()):
        family.add_metric(labels, count)
    return family
