"""Pages of runs and replays, and of comparisons between runs or sets of options."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from fastapi import Depends
from pydantic import ValidationError
from starlette.requests import Request
from starlette.responses import Response

from service.app.runs import MOST_COMPARED
from service.contract.runs import Comparison, RefusedLine, Replay, RunComparison
from service.errors import BadBatch
from service.observations.schema import Key, OptionsIn, RunName
from service.times import DAY_S, recorded_utc, unix_seconds
from service.vectors import Vector
from service.web.api.batches import COMPARISON_S, SampleSize
from service.web.console import options
from service.web.console.charts.sparkline import SparklineDrawing, common_top, sparkline
from service.web.console.page import ContextDep, FromQuery, PageQuery, PeriodQuery, console_page
from service.web.requests.access import READ, Policy

SAMPLE = 2_000
"""Number of batches in a comparison of two sets of options, which takes about a second."""
SIDES = ("a", "b")
SHARES = ("ambiguous", "unmatched")
SPARK_SIZE = 360, 36
"""Size in pixels of a sparkline: a year has a point per day."""


class CompareQuery(PeriodQuery):
    """Query that selects batches; options of the sides have the prefixes `a.` and `b.`.

    With `other` the run is compared with that run, in the period or in all that both have.
    """

    other: RunName | Literal[""] = ""
    spacecraft: Key | None = None
    sample: SampleSize = SAMPLE


@dataclass(frozen=True)
class DrawnTrends:
    """Sparklines of two sides, on a common scale."""

    cell_s: int
    top: float
    """Share at the top of the sparklines."""
    sparks: list[SparklineDrawing]

    @property
    def cells(self) -> str:
        """Period of one point of a sparkline, in words."""
        days = self.cell_s // DAY_S
        return {0: "hours", 1: "days"}.get(days, f"periods of {days} days")


async def _query(request: Request) -> CompareQuery:
    plain = {k: v for k, v in request.query_params.items() if not k.startswith(("a.", "b."))}
    try:
        return CompareQuery.model_validate(plain)
    except ValidationError as error:
        raise BadBatch(options.faults_of_form(error)) from None


@console_page("/compare", "Compare runs", Policy("read", "nothing"), position=40)
def compare_page(
    request: Request, query: Annotated[CompareQuery, Depends(_query)], context: ContextDep
) -> Response:
    """Page that compares the shown run with another one, or two sets of options on request."""
    start, end = query.bounds.values()
    name = query.spacecraft or context.filled_spacecraft(query.run)
    runs = rates = None
    if query.other:
        context.caller.require(name)
        pair = query.run, query.other, name
        runs = context.app.runs.compare_latest(*pair, start, end)
        rates = context.app.runs.rates(*pair, start, end)
    asked = {side: options.asked_options(request.query_params, f"{side}.") for side in SIDES}
    result = None
    if query.spacecraft is not None and not query.other:
        context.caller.require(query.spacecraft)
        a, b = (OptionsIn.model_validate(asked[side]) for side in SIDES)
        result = context.app.comparisons.of_options(
            query.spacecraft,
            run=query.run,
            start=start,
            end=end,
            sample=query.sample,
            a=a,
            b=b,
            limit_s=COMPARISON_S,
        )
    mission = context.app.context.known.get(name)
    return context.rendered(
        "compare.html.jinja",
        query.run,
        query=query,
        name=name,
        runs=runs,
        rates=rates,
        rate_trends=rates and _drawn(rates.cell_s, [each.shares for each in rates.runs]),
        most_compared=MOST_COMPARED,
        spacecraft=context.spacecraft,
        forms={side: options.fields_of(asked[side], None, f"{side}.", mission) for side in SIDES},
        result=result,
        trends=result and _drawn(result.cell_s, _shares(result)),
        sides=SIDES,
        moved=_moved(runs and runs[0], result),
    )


def _drawn(cell_s: int, sides: Sequence[Mapping[str, Vector]]) -> DrawnTrends:
    """Sparklines of both sides, from shares of the stars in cells of time."""
    every = np.concatenate([values for shares in sides for values in shares.values()])
    top = common_top(float(np.nanmax(every, initial=0.0)))
    return DrawnTrends(cell_s, top, [sparkline(shares, top, *SPARK_SIZE) for shares in sides])


def _shares(result: Comparison) -> list[dict[str, Vector]]:
    """Shares of the stars on each side in every cell of the period; NaN without a star."""
    moments_s = unix_seconds([recorded_utc(cell.start).tai_ns for cell in result.trend])
    place = ((moments_s - moments_s[:1]) // result.cell_s).astype(int)
    sides = []
    for side in SIDES:
        counts = [getattr(cell, side) for cell in result.trend]
        observed = np.array([each.observed or np.nan for each in counts])
        shares = {name: np.full(place.max(initial=-1) + 1, np.nan) for name in SHARES}
        for name, values in shares.items():
            values[place] = np.array([getattr(each, name) for each in counts]) / observed
        sides.append(shares)
    return sides


def _moved(runs: RunComparison | None, result: Comparison | None) -> list[tuple[int, str, str]]:
    """Numbers of stars whose outcome or name differs, with both outcomes."""
    if runs is not None:
        moved = (each for each in runs.stars.transitions if each.is_change)
        return [(each.stars, each.before, each.after) for each in moved]
    if result is None:
        return []
    found = [(each.stars, each.from_, each.to) for each in result.transitions]
    changed = [each for each in found if each[1] != each[2]]
    return [each for each in (*changed, (result.renamed, "unique", "unique")) if each[0]]


@console_page("/runs", "Runs", Policy("read", "nothing"), position=50)
def runs_page(query: FromQuery[PageQuery], context: ContextDep) -> Response:
    """Page of all runs, and of replays with their progress.

    A token that is bound to spacecraft sees their runs, and the replays into these runs.
    """
    bound = context.caller.spacecraft is not None
    replays = context.app.replays.all(context.caller.spacecraft)
    return context.rendered(
        "runs.html.jinja",
        query.run,
        runs=context.app.runs.all(context.caller.spacecraft),
        panels=context.panels("runs_page"),
        replays=replays,
        later=_later(replays),
        kinds={
            suffix: each.media_types[0]
            for each in context.app.replays.formats.values()
            for suffix in each.suffixes
        },
        bound=bound,
    )


@console_page("/replays/{id}", "Replay", READ, section="/runs")
def replay_page(id: str, query: FromQuery[PageQuery], context: ContextDep) -> Response:
    """Page of one replay: its progress, and each fault of lines with its count."""
    replay = context.app.replays.get(id)
    later = _later(context.app.replays.all(context.caller.spacecraft))
    alike: dict[str, list[RefusedLine]] = {}
    for each in replay.errors:
        # Numbers differ from line to line: of messages alike in words the first is shown.
        alike.setdefault(_NUMBER.sub("0", each.problem.detail), []).append(each)
    faults = [(each[0].line, len(each), each[0].problem.detail) for each in alike.values()]
    return context.rendered(
        "replay.html.jinja", query.run, replay=replay, faults=faults, later=later
    )


def _later(replays: Sequence[Replay]) -> dict[str, Replay]:
    """The next replay of the same file into the same run, by the id of the one before."""
    newest: dict[tuple[str, str], Replay] = {}
    later = {}
    for each in replays:
        key = each.run, each.name
        if key in newest:
            later[each.id] = newest[key]
        newest[key] = each
    return later


_NUMBER = re.compile(r"[-+\d.]*\d")
