"""Comparison of two answers without the parts that may differ.

`Plain` writes an answer without the parts that may differ between two equal runs; `differences`
then compares two such forms value by value.
"""

import csv
import hashlib
import io
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

DURATIONS = frozenset({"timings_us", "us_per_batch", "build_us", "received_age_s"})
"""Names of fields with durations; everything in an object of such a name is left out."""
STAMPS = frozenset(
    {
        "at",
        "cleared_at",
        "created",
        "finished",
        "moment",
        "now",
        "received",
        "returned_at",
        "since",
        "started",
        "until",
    }
)
"""Names of fields with times of the service's own clock; times of batches are compared."""
CURSORS = frozenset({"next_cursor"})
PROBLEM_TYPE = "application/problem+json"
HEADERS = ("content-type", "replayed", "thinned", "location", "link", "allow", "retry-after")
"""Names of the compared headers; a server may send any others."""
PRESENT_ONLY = frozenset({"link", "retry-after"})
"""Headers with a cursor or a number of seconds, compared by presence only."""
_ULID = re.compile(r"(?<![0-9A-Za-z])[0-7][0-9A-HJKMNP-TV-Z]{25}(?![0-9A-Za-z])")
_METRIC = re.compile(r"^([a-zA-Z_:][\w:]*)(?:\{(.*)\})? (\S+)$", re.MULTILINE)
_LABEL = re.compile(r'(\w+)="')
COUNTED_METRICS = ("starid_stars_total", "starid_batches_total")
"""Counters of answers, compared by value; other metrics by their names and labels."""


@dataclass
class Names:
    """Names that replace the ids of one server, by the request whose answer first had the id.

    Two servers with the same requests give the same names.  So a reference to a wrong record is
    found although the ids themselves differ.
    """

    known: dict[str, str] = field(default_factory=dict)

    def named(self, text: str, request: str) -> str:
        """Replace each id in a text by its name."""

        def name(found: re.Match[str]) -> str:
            new = f"<id {len(self.known)} of {request}>"
            if found[0] not in self.known:
                new = f"<id of {request}{self._next(request)}>"
            return self.known.setdefault(found[0], new)

        return _ULID.sub(name, text)

    def _next(self, request: str) -> str:
        count = sum(each.startswith(f"<id of {request}") for each in self.known.values())
        return f", {count + 1}" if count else ""


@dataclass(frozen=True)
class Received:
    """Answer received from a server."""

    status: int
    headers: Mapping[str, str]
    body: bytes


@dataclass(frozen=True)
class Plain:
    """Writes answers without the parts that may differ; `names` belongs to one server.

    `cached_counts`: whether the answers are compared for zones from the cache.  That depends on the
    order of the requests, and so differs if they overlap.
    """

    names: Names

    def answer(self, received: Received, request: str, cached_counts: bool = True) -> Any:
        """Comparable form of status, headers and body."""
        headers = {
            name: "<present>" if name in PRESENT_ONLY else self.names.named(value, request)
            for name in HEADERS
            if (value := received.headers.get(name)) is not None
        }
        body = self._body(received, request, cached_counts)
        return {"status": received.status, "headers": headers, "body": body}

    def _body(self, received: Received, request: str, cached_counts: bool) -> Any:
        kind = received.headers.get("content-type", "").partition(";")[0]
        if kind in ("application/json", PROBLEM_TYPE):
            content = json.loads(received.body)
            if kind == PROBLEM_TYPE:
                return problem(content)
            return self.value(content, request, cached_counts)
        if kind == "text/csv":
            rows = list(csv.DictReader(io.StringIO(received.body.decode())))
            return self.value(rows, request, cached_counts)
        if kind == "text/html":
            return "<a page>"
        if kind == "text/plain":
            return metrics(received.body.decode())
        return f"sha256 {hashlib.sha256(received.body).hexdigest()}" if received.body else None

    def value(self, value: Any, request: str, cached_counts: bool = True, key: str = "") -> Any:
        """Comparable form of a JSON value; `key` is the name of its field."""
        if key in DURATIONS:
            return _durations(value)
        if key in STAMPS and isinstance(value, str):
            return "<stamp>" if value else value
        if key in CURSORS and value is not None:
            return "<cursor>"
        if key == "mean" or key.endswith("_mean"):
            return _rounded(value)
        if key == "cached" and isinstance(value, bool) and not cached_counts:
            return "<cached>"
        if key == "warnings" and isinstance(value, list):
            return [str(each).partition(":")[0] for each in value]
        if key == "problem" and isinstance(value, dict):
            return problem(value)
        if key == "provenance" and isinstance(value, dict) and "version" in value:
            value = value | {"version": "<version>"}
        if isinstance(value, dict):
            return {
                name: self.value(each, request, cached_counts, name) for name, each in value.items()
            }
        if isinstance(value, list):
            return [self.value(each, request, cached_counts) for each in value]
        return self.names.named(value, request) if isinstance(value, str) else value


def problem(content: Mapping[str, Any]) -> dict[str, Any]:
    """Compared parts of a problem answer: status, type, and names of the faulty fields."""
    return {
        **{name: content[name] for name in ("status", "type") if name in content},
        "fields": [each.get("field") for each in content.get("errors", [])],
    }


def metrics(text: str) -> Any:
    """Names and labels of metrics, with the values of answer counters; other text unchanged."""
    found = _METRIC.findall(text)
    if not found:
        return text.strip()
    shown = {}
    for name, labels, value in found:
        if name in COUNTED_METRICS:
            shown[f"{name}{{{labels}}}"] = value
        else:
            shown[f"{name}{{{','.join(sorted(_LABEL.findall(labels)))}}}"] = "<value>"
    return shown


MEAN_DIGITS = 10


def _rounded(value: Any) -> Any:
    """Rounded means: sums of overlapping batches differ in order, and so in last digits."""
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    if isinstance(value, str) and value:
        return f"{float(value):.{MEAN_DIGITS}g}"
    return float(f"{value:.{MEAN_DIGITS}g}") if isinstance(value, float) else value


def _durations(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _durations(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_durations(each) for each in value]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return "<duration>" if is_number else value


MISSING = "<missing>"


@dataclass(frozen=True)
class Difference:
    """Difference of two answers: a path such as `body.counts.unique`, and both values."""

    path: str
    base: Any
    here: Any

    @property
    def is_addition(self) -> bool:
        """True if the base has no value at the path."""
        return self.base is MISSING


def differences(base: Any, here: Any, path: str = "") -> Iterator[Difference]:
    """All differences of two values; an int and a float of the same value differ."""
    if isinstance(base, dict) and isinstance(here, dict):
        for name in [*base, *(each for each in here if each not in base)]:
            yield from differences(
                base.get(name, MISSING), here.get(name, MISSING), f"{path}.{name}" if path else name
            )
    elif _is_list(base) and _is_list(here):
        if len(base) != len(here):
            yield Difference(f"{path}.length", len(base), len(here))
        for place, (one, other) in enumerate(zip(base, here, strict=False)):
            yield from differences(one, other, f"{path}.{place}")
    elif type(base) is not type(here) or base != here:
        yield Difference(path, base, here)


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)
