"""Counts attempts by webhook, and logs where deliveries begin to fail, recover or stop.

One line for each change: what fails for a day is tried hundreds of times.
"""

import logging
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from service.storage.webhooks.registered import Registered

Result = Literal["delivered", "failed", "dead"]
RESULTS: tuple[Result, ...] = ("delivered", "failed", "dead")

log = logging.getLogger(__name__)


@dataclass
class _Failing:
    """The attempts since the last one that succeeded."""

    failed: int = 0
    dead: int = 0


class DeliveryLog:
    """What became of the attempts to deliver, since the start."""

    def __init__(self) -> None:
        self.counts: Counter[tuple[str, str, Result]] = Counter()
        """Attempts by the webhook's id and name and by their result."""
        self._failing: dict[str, _Failing] = {}
        self._states: dict[str, str] = {}

    def listed(self, webhooks: Iterable[Registered]) -> None:
        """Note the webhooks that there are, and log where the state of one has changed."""
        for webhook in webhooks:
            for result in RESULTS:
                self.counts[webhook.id, webhook.name, result] += 0
            before = self._states.get(webhook.id, "active")
            if webhook.state != before:
                if webhook.state == "active":
                    log.info("webhook %s: active again", webhook.name)
                else:
                    log.warning("webhook %s: %s: %s", webhook.name, webhook.state, webhook.reason)
            self._states[webhook.id] = webhook.state

    def delivered(self, webhook: Registered, events: int) -> None:
        """Count deliveries; after failures, log that they go on."""
        if not events:
            return
        self.counts[webhook.id, webhook.name, "delivered"] += events
        failing = self._failing.pop(webhook.id, None)
        if failing is not None:
            log.info(
                "webhook %s: delivers again after %d failed attempts; dead letters: %d",
                webhook.name,
                failing.failed + failing.dead,
                failing.dead,
            )

    def failed(self, webhook: Registered, event: int, fault: str | None, is_dead: bool) -> None:
        """Count a failed attempt; log the first one, and the first dead letter."""
        self.counts[webhook.id, webhook.name, "dead" if is_dead else "failed"] += 1
        failing = self._failing.get(webhook.id)
        if failing is None:
            failing = self._failing[webhook.id] = _Failing()
            log.warning("webhook %s: event %d was not delivered: %s", webhook.name, event, fault)
        if is_dead:
            failing.dead += 1
            if failing.dead == 1:
                log.error("webhook %s: event %d is a dead letter: %s", webhook.name, event, fault)
        else:
            failing.failed += 1
