"""Prometheus metric for the number of alarms of live batches that are not cleared."""

import collections
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any

from prometheus_client.core import GaugeMetricFamily, Metric

from service.app.factory import App
from service.contract.alarms import Alarm
from service.features.alarms.part import Alarms
from service.trends.limits import Severity

ALARM_STATES = ("open", "acknowledged", "shelved")


def reads(app: App) -> Mapping[str, Callable[[], Any]]:
    """Function that reads the active alarms from the database for the metrics, by its name."""
    return {"alarms": app.part(Alarms).active}


def collect(app: App, found: Mapping[str, Any]) -> Iterator[Metric]:
    """Metric with the number of active alarms by spacecraft, severity and state."""
    if "alarms" in found:
        yield _of_alarms(app, found["alarms"])


def _of_alarms(app: App, active: Sequence[Alarm]) -> Metric:
    family = GaugeMetricFamily(
        "starid_alarms",
        "Alarms of live batches that are not cleared.",
        labels=("spacecraft", "severity", "state"),
    )
    found = collections.Counter[tuple[str, str, str]](
        (each.spacecraft, each.severity, each.state) for each in active
    )
    severities = [each.word for each in Severity]
    for labels in product(app.missions, severities, ALARM_STATES):
        family.add_metric(labels, found[labels])
    return family
