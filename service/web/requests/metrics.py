"""Prometheus metrics of the service, in a registry of each app."""

import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

from prometheus_client import (
    CollectorRegistry,
    Counter,
    GCCollector,
    Histogram,
    Info,
    PlatformCollector,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from starlette.types import Scope

from service import __version__
from service.app.factory import App
from service.contract.spacecraft import ZoneCache
from service.feature import feature_modules
from service.ingest.queue import OUTCOMES, Backlog, RecordedCounts
from service.observations.schema import LIVE
from service.storage.progress import Lag
from service.storage.upkeep.expiries import Expiries
from service.times import recorded_utc, unix_seconds

log = logging.getLogger(__name__)

WAIT_S = 1.0
"""Time limit in seconds of all reads for a scrape, which is due within two seconds."""
RESULTS = ("attitude", "no_attitude")
_METHODS = ("GET", "POST", "DELETE", "PUT", "PATCH", "OPTIONS")
_SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)


class _TimedReads:
    """Reads values in parallel threads with a deadline.

    An unfinished read is not repeated: threads would pile up while the database hangs.
    """

    def __init__(self, **asked: Callable[[], Any]) -> None:
        self._asked = asked
        self._threads = ThreadPoolExecutor(len(asked), "metrics")
        self._lock = threading.Lock()
        self._answers: dict[str, Future[Any]] = {}

    def __call__(self) -> dict[str, Any]:
        """Values that arrived within `WAIT_S`, by name."""
        with self._lock:
            for name, ask in self._asked.items():
                before = self._answers.get(name)
                if before is None or before.done():
                    self._answers[name] = self._threads.submit(ask)
            answers = dict(self._answers)
        wait(answers.values(), WAIT_S)
        found = {}
        for name, answer in answers.items():
            if not answer.done():
                log.warning("%s: no answer within %g s", name, WAIT_S)
            elif (error := answer.exception()) is not None:
                # A missing gauge is noticed; zero would look healthy.
                log.warning("%s cannot be counted: %s", name, error)
            else:
                found[name] = answer.result()
        return found

    def close(self) -> None:
        """Stop the threads without waiting for one that a hanging database blocks."""
        self._threads.shutdown(wait=False, cancel_futures=True)


class _GaugeCollector(Collector):
    """Prometheus collector of gauges that are read when the metrics are scraped."""

    def __init__(self, app: App) -> None:
        self._app = app
        self._features = feature_modules("metrics", app.settings.features_off)
        self._reads = _TimedReads(
            zones=app.zones.state,
            processes=app.replays.processes,
            backlog=app.submissions.backlog,
            lag=app.store.progress.lag,
            expiries=app.expiries.dates,
            **{name: read for each in self._features for name, read in each.reads(app).items()},
        )
        self.close = self._reads.close

    def collect(self) -> Iterator[Metric]:
        found = self._reads()
        if "zones" in found:
            yield from _of_zones(found["zones"])
        if "processes" in found:
            yield GaugeMetricFamily(
                "starid_replay_processes",
                "Processes that are ready to compute replays, each with a cache of its own.",
                value=found["processes"],
            )
        if "backlog" in found:
            yield from _of_backlog(found["backlog"], found.get("lag"))
        if "expiries" in found:
            yield from _of_expiries(found["expiries"])
        yield GaugeMetricFamily(
            "starid_projecting",
            "1 where this one of the services that share a database projects what all record.",
            value=float(self._app.single_projector.is_projecting),
        )
        for feature in self._features:
            yield from feature.collect(self._app, found)


def _of_zones(cache: ZoneCache) -> Iterator[Metric]:
    yield CounterMetricFamily(
        "starid_zone_cache_hits",
        "Zones and run catalogs found in the cache; replays have others.",
        value=cache.hits,
    )
    yield CounterMetricFamily(
        "starid_zone_cache_misses", "Zones and run catalogs built.", value=cache.misses
    )
    yield CounterMetricFamily(
        "starid_zone_build_seconds", "Time spent building them.", value=cache.build_us / 1e6
    )
    yield GaugeMetricFamily(
        "starid_zone_cache_bytes", "Memory that the cache holds.", value=cache.bytes
    )


def _of_backlog(backlog: Backlog, lag: Lag | None) -> Iterator[Metric]:
    posts, writes = backlog.posts, backlog.writes
    yield CounterMetricFamily(
        "starid_writes_failed",
        "Batches and changes that could not be written, or not be looked up before that.",
        value=writes.failed,
    )
    yield GaugeMetricFamily(
        "starid_last_write_succeeded",
        "1 where the last write succeeded, 0 where it failed.",
        value=float(writes.succeeded),
    )
    depth = GaugeMetricFamily(
        "starid_queue_depth",
        "Posted batches that are not answered yet, records that wait to be written, and results "
        "that trends and alarms do not have yet.",
        labels=("queue",),
    )
    age = GaugeMetricFamily(
        "starid_queue_oldest_seconds", "The age of the oldest of them.", labels=("queue",)
    )
    depth.add_metric(("posts",), posts.queued)
    depth.add_metric(("writes",), writes.queued)
    age.add_metric(("posts",), posts.oldest_s)
    age.add_metric(("writes",), writes.oldest_s)
    if lag is not None:
        depth.add_metric(("projections",), lag.results)
        age.add_metric(("projections",), lag.seconds)
    yield depth
    yield age


def _of_expiries(dates: Expiries) -> Iterator[Metric]:
    yield GaugeMetricFamily(
        "starid_leap_seconds_end_timestamp_seconds",
        "Until when the table of leap seconds is certain.",
        value=_unix_s(dates.leap_seconds),
    )
    made = GaugeMetricFamily(
        "starid_token_created_timestamp_seconds", "When a token was made.", labels=("token",)
    )
    ends = GaugeMetricFamily(
        "starid_token_end_timestamp_seconds", "When a token in force expires.", labels=("token",)
    )
    for each in dates.tokens:
        made.add_metric((each.name,), _unix_s(each.created))
        ends.add_metric((each.name,), _unix_s(each.expires))
    yield from (made, ends)


def _unix_s(moment: str) -> float:
    return float(unix_seconds(recorded_utc(moment).tai_ns))


class Metrics:
    """Counters of requests, batches and stars, and their text for Prometheus."""

    def __init__(self, app: App) -> None:
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
        # `Histogram.labels` checks its labels on every call.
        self._by_labels: dict[tuple[str, str, int], Histogram] = {}
        # Memory, processor time, open files, the interpreter and its collections of garbage.
        for collector in (ProcessCollector, PlatformCollector, GCCollector):
            collector(registry=self.registry)
        build = Info("starid_build", "The version of the service.", registry=self.registry)
        build.info({"version": __version__})
        gauges = _GaugeCollector(app)
        self.close = gauges.close
        """Function that ends the threads which read gauges, to be called after the last scrape."""
        self.registry.register(gauges)
        self._counts, self._counted = app.submissions.counts, RecordedCounts()
        self._counting = threading.Lock()
        for name in app.missions:
            # A counter that exists from the start shows its first increase.
            for outcome in OUTCOMES:
                self._stars.labels(name, outcome)
            for result in RESULTS:
                self._batches.labels(name, LIVE, result)

    def _count_recorded(self) -> None:
        """Update the counters from the counts of the submission service."""
        with self._counting:
            now, before = self._counts.copy(), self._counted
            for (spacecraft, is_live, has_attitude), count in now.batches.items():
                result = RESULTS[0] if has_attitude else RESULTS[1]
                run = LIVE if is_live else "named"
                more = count - before.batches[spacecraft, is_live, has_attitude]
                self._batches.labels(spacecraft, run, result).inc(more)
            for (spacecraft, is_live, outcome), count in now.stars.items():
                if is_live:
                    more = count - before.stars[spacecraft, is_live, outcome]
                    self._stars.labels(spacecraft, outcome).inc(more)
            self._counted = now

    def count_repeat(self) -> None:
        """Count one repeated submission."""
        self._repeats.inc()

    def count_request(self, scope: Scope, status: int, seconds: float) -> None:
        """Count one request under the path template of its route; ids make no new series."""
        if getattr(scope.get("route"), "name", None) == "events":
            return  # the duration of a stream says nothing
        method = scope["method"] if scope["method"] in _METHODS else "other"
        route = getattr(scope.get("route"), "path", "none")
        labels = method, route, status
        histogram = self._by_labels.get(labels)
        if histogram is None:
            histogram = self._by_labels[labels] = self._requests.labels(method, route, str(status))
        histogram.observe(seconds)

    def text(self) -> bytes:
        """Text of all metrics in the Prometheus format."""
        self._count_recorded()
        return generate_latest(self.registry)
