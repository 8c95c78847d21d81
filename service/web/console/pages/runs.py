"""The pages of runs and replays."""

from typing import Annotated

from fastapi import Query as InQuery
from starlette.responses import Response

from service.times import utc_now
from service.web.console.page_context import ContextDep, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import READ, Policy


@console_page("/runs", "Runs", Policy("read", "nothing"), position=50)
def runs_page(query: Annotated[PageQuery, InQuery()], context: ContextDep) -> Response:
    """Every run, and the replays and reprocessings with their progress.

    A token that is bound to spacecraft sees the runs of these, and the replays into these runs.
    """
    bound = context.caller.spacecraft is not None
    return rendered(
        "runs.html.jinja",
        context.layout(query.run),
        runs=context.app.runs.all(context.caller.spacecraft),
        reprocessings=[] if bound else context.app.runs.reprocessings(),
        replays=context.app.replays.all(context.caller.spacecraft),
        bound=bound,
        now=utc_now(),
    )


@console_page("/replays/{id}", "Replay", READ, section="/runs")
def replay_page(id: str, query: Annotated[PageQuery, InQuery()], context: ContextDep) -> Response:
    """One replay: how far it is, and every line that was refused."""
    return rendered(
        "replay.html.jinja",
        context.layout(query.run),
        replay=context.app.replays.get(id),
    )
