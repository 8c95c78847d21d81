"""The pages of runs and replays, and the one that compares runs or sets of options."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from fastapi import Depends
from pydantic import Field, ValidationError
from starlette.requests import Request
from starlette.responses import Response

from service.app.runs import MOST_COMPARED
from service.errors import BadBatch
from service.observations.schema import Key, OptionsIn, RunName
from service.storage.models.runs import Comparison, RatesOfRuns
from service.times import DAY_S, parse_utc, utc_now
from service.web.api.batches import COMPARISON_S
from service.web.console import options
from service.web.console.charts.sparkline import SparklineDrawing, common_top, sparkline
from service.web.console.page import ContextDep, FromQuery, PageContext, PageQuery, console_page
from service.web.requests.access import READ, Policy

SAMPLE = 100
SIDES = ("a", "b")
SPARK_SIZE = 360, 36
"""Pixels: a year has a point a day."""


class CompareQuery(PageQuery):
    """Which batches; the options of the sides are parameters with the prefixes `a.` and `b.`.

    With `other` the run is compared with that run, in the period or in all that both have.
    """

    other: RunName | None = None
    spacecraft: Key | None = None
    start: Annotated[str, Field(max_length=40)] = ""
    end: Annotated[str, Field(max_length=40)] = ""
    sample: Annotated[int, Field(ge=1, le=500)] = SAMPLE


@dataclass(frozen=True)
class DrawnRates:
    """The rates of two runs, and a sparkline of each."""

    rates: RatesOfRuns
    top: float
    """The share that the top of a sparkline stands for."""
    sparks: list[SparklineDrawing]

    @property
    def cells(self) -> str:
        """The unit that a point of a sparkline counts, in words."""
        days = self.rates.cell_s // DAY_S
        return {0: "hours", 1: "days"}.get(days, f"periods of {days} days")


async def _query(request: Request) -> CompareQuery:
    plain = {k: v for k, v in request.query_params.items() if not k.startswith(("a.", "b."))}
    try:
        return CompareQuery.model_validate(plain)
    except ValidationError as error:
        raise BadBatch(options.faults_of_form(error)) from None


@console_page("/compare", "Compare", Policy("read", "nothing"), position=40)
def compare_page(
    request: Request, query: Annotated[CompareQuery, Depends(_query)], context: ContextDep
) -> Response:
    """A comparison of two runs, first of two that have data; or one of options, once asked for."""
    pair = _pair(request, query, context)
    start, end = (
        parse_utc(text, name) if text.strip() else None
        for name, text in (("start", query.start), ("end", query.end))
    )
    runs = rates = None
    if pair is not None and (query.other is not None or query.spacecraft is None):
        runs = context.app.runs.compare_latest(*pair, start, end)
        rates = _drawn(context.app.runs.rates(*pair, start, end))
    asked = {side: options.asked_options(request.query_params, f"{side}.") for side in SIDES}
    result = None
    if query.spacecraft is not None and query.other is None:
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
    run = pair[0] if pair and runs else query.run
    name = query.spacecraft or (pair[2] if pair else context.filled_spacecraft(run))
    mission = context.app.context.known.get(name)
    return context.rendered(
        "compare.html.jinja",
        run,
        query=query,
        name=name,
        other=pair[1] if pair else None,
        runs=runs,
        rates=rates,
        most_compared=MOST_COMPARED,
        spacecraft=context.spacecraft,
        forms={side: options.fields_of(asked[side], None, f"{side}.", mission) for side in SIDES},
        now={} if mission is None else options.settings_of_mission(mission),
        result=result,
        sides=SIDES,
        matrix=_matrix(result),
    )


def _pair(
    request: Request, query: CompareQuery, context: PageContext
) -> tuple[str, str, str] | None:
    """The run and the run that it is compared with, and the spacecraft; None without such two."""
    run = query.run if "run" in request.query_params else None
    found = context.app.runs.comparable(context.spacecraft, run)
    if query.other is None:
        return found
    name = query.spacecraft or (found[2] if found else context.filled_spacecraft(query.run))
    context.caller.require(name)
    return query.run, query.other, name


def _drawn(rates: RatesOfRuns | None) -> DrawnRates | None:
    """The rates with a sparkline for each run, all to one scale; None without any."""
    if rates is None:
        return None
    every = np.concatenate([values for each in rates.runs for values in each.shares.values()])
    top = common_top(float(np.nanmax(every, initial=0.0)))
    return DrawnRates(rates, top, [sparkline(each.shares, top, *SPARK_SIZE) for each in rates.runs])


def _matrix(result: Comparison | None) -> dict[tuple[str, str], int]:
    """How many stars went from which outcome to which."""
    if result is None:
        return {}
    return {(each.from_, each.to): each.stars for each in result.transitions}


@console_page("/runs", "Runs", Policy("read", "nothing"), position=50)
def runs_page(query: FromQuery[PageQuery], context: ContextDep) -> Response:
    """Every run, and the replays and reprocessings with their progress.

    A token that is bound to spacecraft sees the runs of these, and the replays into these runs.
    """
    bound = context.caller.spacecraft is not None
    return context.rendered(
        "runs.html.jinja",
        query.run,
        runs=context.app.runs.all(context.caller.spacecraft),
        reprocessings=[] if bound else context.app.runs.reprocessings(),
        replays=context.app.replays.all(context.caller.spacecraft),
        bound=bound,
        now=utc_now(),
    )


@console_page("/replays/{id}", "Replay", READ, section="/runs")
def replay_page(id: str, query: FromQuery[PageQuery], context: ContextDep) -> Response:
    """One replay: how far it is, and every line that was refused."""
    return context.rendered("replay.html.jinja", query.run, replay=context.app.replays.get(id))
