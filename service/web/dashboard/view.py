"""What the page shows, gathered from the operations: values and words, no markup.

A section is about one spacecraft of one run.  "Latest" means by batch time,
and a failed solve stands as what it is: no older attitude takes its place.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from service import __version__
from service.operations import Operations
from service.records.rollups import Bucket
from service.times import Utc, parse_utc
from service.web.dashboard.chart import Chart, chart_of, first_bucket, with_day_of_year

LIVE = "live"
ROWS = 10
ATTITUDES_READ = 500

MARKS = {"good": "●", "suspect": "▲", "none": "○"}
"""A state has its word and its shape; colour only helps."""


@dataclass(frozen=True)
class Row:
    """One batch."""

    id: str
    batch: str
    time: str
    observed: int
    unique: int
    ambiguous: int
    unmatched: int
    state: str
    reason: str
    sigma: str
    residual: str

    @property
    def mark(self) -> str:
        """The shape that goes with the state."""
        return MARKS[self.state]

    @property
    def has_attitude(self) -> bool:
        """Whether the batch gave an attitude."""
        return self.state != "none"


@dataclass(frozen=True)
class Section:
    """One spacecraft."""

    name: str
    chart: Chart
    rows: tuple[Row, ...]

    @property
    def latest(self) -> Row:
        """The newest batch."""
        return self.rows[0]


@dataclass(frozen=True)
class Run:
    """A run to choose."""

    name: str
    batches: int | None


@dataclass(frozen=True)
class View:
    """The whole page."""

    run: str
    bucket: Bucket
    runs: tuple[Run, ...]
    sections: tuple[Section, ...]
    as_of: str
    version: str = __version__

    @property
    def is_live(self) -> bool:
        """Whether these are live batches and not those of a named run."""
        return self.run == LIVE

    @property
    def other_runs(self) -> tuple[Run, ...]:
        """The runs that hold batches, other than the one shown."""
        return tuple(run for run in self.runs if run.batches and run.name != self.run)


def view_of(operations: Operations, run: str, bucket: Bucket, now: Utc) -> View:
    """The page of a run at the moment `now`."""
    listed = {each["run"]: each for each in operations.runs()}
    names = sorted({LIVE, run, *listed}, key=lambda name: (name != LIVE, name))
    spacecraft = listed.get(run, {}).get("spacecraft", ())
    return View(
        run=run,
        bucket=bucket,
        runs=tuple(Run(name, listed.get(name, {}).get("batches")) for name in names),
        sections=tuple(_section(operations, name, run, bucket) for name in sorted(spacecraft)),
        as_of=with_day_of_year(now),
    )


def _section(operations: Operations, name: str, run: str, bucket: Bucket) -> Section:
    items = operations.batches(
        spacecraft=name,
        run=run,
        start=None,
        end=None,
        outcome=None,
        status=None,
        limit=ROWS,
        cursor=None,
    ).items
    latest, earliest = parse_utc(items[0]["time"]), parse_utc(items[-1]["time"])
    attitudes = operations.attitudes(
        name, run=run, start=earliest, end=None, limit=ATTITUDES_READ, cursor=None
    ).items
    by_id = {each["id"]: each for each in attitudes}
    rates = operations.rates(
        name, run=run, start=first_bucket(latest, bucket), end=None, bucket=bucket
    )
    rows = tuple(_row(each, by_id.get(each["id"])) for each in items)
    return Section(name, chart_of(rates, latest, bucket), rows)


def _row(item: Mapping[str, Any], attitude: Mapping[str, Any] | None) -> Row:
    return Row(
        id=item["id"],
        batch=item["batch"],
        time=with_day_of_year(parse_utc(item["time"])),
        **item["counts"],
        state=item["status"] or "none",
        reason=(item["reason"] or "").replace("_", " "),
        sigma="–" if attitude is None else _sigma(attitude["covariance_arcsec2"]),
        residual="–" if attitude is None else _arcsec(attitude["residual_rms_arcsec"]),
    )


def _sigma(covariance_arcsec2: list[list[float]]) -> str:
    """One standard deviation about each body axis."""
    sigmas = (math.sqrt(max(covariance_arcsec2[k][k], 0.0)) for k in range(3))
    return ", ".join(_arcsec(sigma) for sigma in sigmas)


def _arcsec(value: float) -> str:
    decimals = 0 if value >= 99.95 else 1 if value >= 9.995 else 2
    return f"{value:.{decimals}f}″"
