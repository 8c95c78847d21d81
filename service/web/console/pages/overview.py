"""First page: the state of every spacecraft in a row, the worst first."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from starlette.responses import Response

from service.storage.queries.fleet import PERIODS_S, Fleet, FleetCells, Period, last_day
from service.storage.queries.fleet_rows import MARKED_SHARE, RANKS, FleetRow
from service.trends.limits import Severity
from service.trends.measures import BatchShare, StarShare
from service.trends.quantities import QUANTITIES, OneOf
from service.vectors import Matrix
from service.web.console import page
from service.web.console.charts.sparkline import SparklineDrawing, common_top, packed, sparkline
from service.web.requests.access import Policy

Order = Literal["worst", "name", "behind", "ambiguous", "unmatched", "alarms"]
Shown = Literal["all", "trouble", "alarm", "stale", "no_attitude", "no_batches"]
SHOWN: dict[Shown, str] = {
    "all": "all",
    "trouble": "in trouble",
    "alarm": "with an alarm",
    "stale": "silent or behind",
    "no_attitude": "no attitude",
    "no_batches": "no batches",
}
UNFOLDED = 20
"""Number of rows that are shown by default."""
SPARK_QUANTITIES = ("ambiguous_share", "unmatched_share")


def share_names() -> tuple[str, ...]:
    """Names of the quantities that the heat map can show: shares."""
    return tuple(name for name, each in QUANTITIES.items() if each.is_share)


class OverviewQuery(page.SortedQuery):
    """Query that selects the rows, their order, and the period."""

    period: Period = "day"
    sort: Order = "worst"
    q: Annotated[str, Field(max_length=64)] = ""
    show: Shown = "all"
    heat: Annotated[str, OneOf(share_names)] | None = None
    all: bool = False
    """True if every row is shown; otherwise the first ones of spacecraft with data."""


@dataclass(frozen=True)
class OverviewLine:
    """Row of one spacecraft; `place` is the index of its cells."""

    item: FleetRow
    place: int
    spark: SparklineDrawing | None

    def share(self, outcome: str) -> float:
        """Share of an outcome in the last hour; -1 without observed stars."""
        counts = self.item.last_hour
        if counts is None or not counts.observed:
            return -1.0
        return float(getattr(counts, outcome)) / counts.observed

    def is_marked(self, outcome: str) -> bool:
        """True if the share of an outcome needs attention."""
        return self.share(outcome) > MARKED_SHARE


@dataclass(frozen=True)
class Notice:
    """Problem that a feature reports, and the page with details."""

    text: str
    path: str
    title: str


@page.console_page("/", "Overview", Policy("read", "nothing"), position=10)
def overview_page(query: page.FromQuery[OverviewQuery], context: page.ContextDep) -> Response:
    """Page with state, attitude, shares, alarms and age of every spacecraft in a run."""
    fleet = context.app.spacecraft.fleet(
        context.spacecraft, query.run, query.period, context.caller.spacecraft
    )
    shares = {} if fleet.cells is None else _shares(fleet.cells)
    top = common_top(
        max((_greatest(shares[name]) for name in SPARK_QUANTITIES if shares), default=0)
    )
    every = [_line(fleet, place, shares, top) for place in range(len(fleet.rows))]
    found = _sorted([line for line in every if _is_shown(line, query)], query)
    sent = [line for line in found if line.item.latest_batch] or found
    lines = found if query.all or query.q or query.show != "all" else sent[:UNFOLDED]
    folded = [line for line in found if line not in lines]
    return context.rendered(
        "overview.html.jinja",
        query.run,
        query=query,
        fleet=fleet,
        lines=lines,
        folded=len(folded),
        folded_words=_words_of(folded),
        any_batch=fleet.as_of is not None and any(line.item.latest_batch for line in every),
        every=every,
        top=top,
        day=last_day(fleet.as_of) if fleet.as_of else None,
        periods=list(PERIODS_S),
        shown=SHOWN,
        heat=_heat(fleet, found, shares, query.period),
        notices=context.panels("overview_page"),
    )


def _words_of(lines: list[OverviewLine]) -> str:
    """Text with the numbers of rows with faults, without faults, and without any batch."""
    silent = [line for line in lines if not line.item.latest_batch]
    trouble = [line for line in lines if line.item.faults and line.item.latest_batch]
    parts = (
        (len(trouble), "in trouble"),
        (len(lines) - len(trouble) - len(silent), "without trouble"),
        (len(silent), "that never sent a batch"),
    )
    return ", ".join(f"{count} {words}" for count, words in parts if count)


def _shares(cells: FleetCells) -> dict[str, Matrix]:
    """Shares with a history, by spacecraft and cell; NaN without a batch."""
    found = {}
    for quantity in QUANTITIES.values():
        match quantity.source:
            case StarShare(part):
                whole = cells.counts["observed"]
            case BatchShare(part):
                whole = cells.counts["batches"]
            case _:
                continue
        with np.errstate(divide="ignore", invalid="ignore"):
            found[quantity.name] = np.where(whole > 0, part(cells.counts) / whole, np.nan)
    return found


def _greatest(shares: Matrix) -> float:
    return float(np.nanmax(shares)) if np.isfinite(shares).any() else 0.0


def _line(fleet: Fleet, place: int, shares: dict[str, Matrix], top: float) -> OverviewLine:
    item = fleet.rows[place]
    if not shares or item.latest_batch is None:
        return OverviewLine(item, place, None)
    drawn = {name: shares[name][place] for name in SPARK_QUANTITIES}
    return OverviewLine(item, place, sparkline(drawn, top))


def _is_shown(line: OverviewLine, query: OverviewQuery) -> bool:
    wanted, item = query.q.strip().casefold(), line.item
    if wanted and wanted not in f"{item.name} {item.description}".casefold():
        return False
    match query.show:
        case "all":
            return True
        case "trouble":
            return bool(item.faults)
        case "alarm":
            return any(each.state != "shelved" for each in item.alarms)
        case "stale":
            return any(each.part == "freshness" for each in item.faults)
        case state:
            return state in (item.state, *(each.state for each in item.faults))


def _sorted(lines: list[OverviewLine], query: OverviewQuery) -> list[OverviewLine]:
    """Rows in the requested order: the worst or the greatest first, names from A on."""
    ordered = sorted(lines, key=lambda line: line.item.name)
    if query.sort == "name":
        return ordered[::-1] if query.descending else ordered
    keys: dict[Order, Any] = {
        "worst": _badness,
        "behind": lambda line: (line.item.age_s or 0.0, line.item.received_age_s or 0.0),
        "alarms": lambda line: (_severity(line), len(line.item.alarms)),
    }
    key = keys.get(query.sort) or (lambda line: line.share(query.sort))
    ordered.sort(key=key, reverse=query.descending is not False)
    # What has no batch has no place in an order of values.
    return sorted(ordered, key=lambda line: line.item.latest_batch is None)


def _badness(line: OverviewLine) -> tuple[Any, ...]:
    """Sort key: the ranks of the faults from the worst on, then the share of ambiguous stars."""
    ranks = [RANKS[each.state] for each in line.item.faults]
    return ranks, line.share("ambiguous"), line.share("unmatched"), len(line.item.alarms_returned)


def _severity(line: OverviewLine) -> int:
    """Greatest severity of the present alarms; 0 without any."""
    words = [each.current_severity or each.severity for each in line.item.alarms_now]
    return max((int(Severity[word.upper()]) for word in words), default=0)


def _heat(
    fleet: Fleet, lines: list[OverviewLine], shares: dict[str, Matrix], period: Period
) -> dict[str, Any] | None:
    """Heat map with the rows of the table, and all shares as quantities."""
    shown = [line for line in lines if line.item.latest_batch]
    if fleet.cells is None or not shown:
        return None
    places = [line.place for line in shown]
    return {
        "start": fleet.cells.start_s,
        "width": fleet.cells.width_s,
        "columns": fleet.cells.columns,
        "period": period,
        "names": [line.item.name for line in shown],
        "quantities": [
            {"name": name, "label": QUANTITIES[name].label, "cells": packed(values[places])}
            for name, values in shares.items()
        ],
    }
