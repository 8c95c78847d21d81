"""Counters for Prometheus, in a registry of the app's own: no state is shared between apps."""

import logging
from collections import Counter as Counted
from collections.abc import Iterator
from itertools import product

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from starlette.types import Scope

from service.alarms.limits import Severity
from service.operations import LIVE, Operations, Recorded

log = logging.getLogger(__name__)

OUTCOMES = ("unique", "ambiguous", "unmatched")
ALARM_STATES = ("open", "acknowledged", "shelved")
_METHODS = ("GET", "POST", "DELETE", "PUT", "PATCH", "OPTIONS")
_SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)


class _Zones(Collector):
    """The cache of zones and run catalogs, and who computes replays beside it, read when asked."""

    def __init__(self, operations: Operations) -> None:
        self._operations = operations

    def collect(self) -> Iterator[Metric]:
        shelf = self._operations.zones()
        yield CounterMetricFamily(
            "starid_zone_cache_hits",
            "Zones and run catalogs found in the cache; replays have others.",
            value=shelf["hits"],
        )
        yield CounterMetricFamily(
            "starid_zone_cache_misses",
            "Zones and run catalogs built.",
            value=shelf["misses"],
        )
        yield CounterMetricFamily(
            "starid_zone_build_seconds",
            "Time spent building them.",
            value=shelf["build_us"] / 1e6,
        )
        yield GaugeMetricFamily(
            "starid_zone_cache_bytes",
            "Memory that the cache holds.",
            value=shelf["bytes"],
        )
        yield GaugeMetricFamily(
            "starid_replay_processes",
            "Processes that are ready to compute replays, each with a cache of its own.",
            value=self._operations.replay_processes(),
        )


class _Alarms(Collector):
    """The live alarms that are not cleared, read when asked."""

    def __init__(self, operations: Operations) -> None:
        self._operations = operations

    def collect(self) -> Iterator[Metric]:
        family = GaugeMetricFamily(
            "starid_alarms",
            "Alarms of live batches that are not cleared.",
            labels=("spacecraft", "severity", "state"),
        )
        try:
            found = Counted(
                (each["spacecraft"], each["severity"], each["state"])
                for each in self._operations.active_alarms()
            )
        except Exception as error:
            # A gauge that is missing is seen; zero would say that all is well.
            log.warning("alarms cannot be counted: %s", error)
            return
        severities = [each.word for each in Severity]
        for labels in product(self._operations.missions, severities, ALARM_STATES):
            family.add_metric(labels, found[labels])
        yield family


class Metrics:
    """What is counted, and its text form."""

    def __init__(self, operations: Operations) -> None:
        self.registry = CollectorRegistry()
        self._stars = Counter(
            "starid_stars",
            "Observed stars of live batches by outcome.",
            ("spacecraft", "outcome"),
            registry=self.registry,
        )
        self._batches = Counter(
            "starid_batches",
            "Recorded batches: live or of a named run, with an attitude or without.",
            ("spacecraft", "run", "result"),
            registry=self.registry,
        )
        self._repeats = Counter(
            "starid_batches_repeated",
            "Submissions that were answered with what is recorded already.",
            registry=self.registry,
        )
        self._requests = Histogram(
            "starid_request_seconds",
            "Time from a request's first byte to its answer's last.",
            ("method", "route", "status"),
            buckets=_SECONDS,
            registry=self.registry,
        )
        # Looked up by its own labels, the histogram would check them each time.
        self._by_labels: dict[tuple[str, str, int], Histogram] = {}
        self.registry.register(_Zones(operations))
        self.registry.register(_Alarms(operations))
        operations.observers.append(self.count_batch)
        for name in operations.missions:
            # A counter that is there from the start has a first increase.
            for outcome in OUTCOMES:
                self._stars.labels(name, outcome)

    def count_batch(self, recorded: Recorded) -> None:
        """Count one newly recorded batch."""
        spacecraft, live = recorded.spacecraft, recorded.run == LIVE
        result = "attitude" if recorded.has_attitude else "no_attitude"
        self._batches.labels(spacecraft, LIVE if live else "named", result).inc()
        if live:
            for outcome in OUTCOMES:
                self._stars.labels(spacecraft, outcome).inc(recorded.counts[outcome])

    def count_repeat(self) -> None:
        """Count one submission that was recorded before."""
        self._repeats.inc()

    def count_request(self, scope: Scope, status: int, seconds: float) -> None:
        """Count one request under its route's template, so that ids make no new series."""
        if getattr(scope.get("route"), "name", None) == "events":
            return  # a stream lasts as long as somebody listens
        method = scope["method"] if scope["method"] in _METHODS else "other"
        route = getattr(scope.get("route"), "path", "none")
        labels = method, route, status
        histogram = self._by_labels.get(labels)
        if histogram is None:
            histogram = self._by_labels[labels] = self._requests.labels(method, route, str(status))
        histogram.observe(seconds)

    def text(self) -> bytes:
        """The exposition text."""
        return generate_latest(self.registry)
