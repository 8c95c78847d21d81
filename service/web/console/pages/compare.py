"""The page that compares two sets of options over the same recorded batches."""

from typing import Annotated

from fastapi import Depends
from pydantic import Field, ValidationError
from starlette.requests import Request
from starlette.responses import Response

from service.errors import BadBatch, Fault, shown_value
from service.observations.schema import Key, OptionsIn
from service.storage.models.compare import Comparison
from service.times import parse_utc
from service.web.api.compare import WORK_S
from service.web.console.options import asked_options, fields_of, settings_of_mission
from service.web.console.page_context import ContextDep, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import Policy

SAMPLE = 100
SIDES = ("a", "b")


class CompareQuery(PageQuery):
    """Which batches; the options of the sides are parameters with the prefixes `a.` and `b.`."""

    spacecraft: Key | None = None
    start: Annotated[str, Field(max_length=40)] = ""
    end: Annotated[str, Field(max_length=40)] = ""
    sample: Annotated[int, Field(ge=1, le=500)] = SAMPLE


async def _query(request: Request) -> CompareQuery:
    plain = {k: v for k, v in request.query_params.items() if not k.startswith(("a.", "b."))}
    try:
        return CompareQuery.model_validate(plain)
    except ValidationError as error:
        raise BadBatch(
            Fault(".".join(map(str, each["loc"]))[:80], each["msg"], shown_value(each["input"]))
            for each in error.errors()
        ) from None


@console_page("/compare", "Compare", Policy("read", "nothing"), position=40)
def compare_page(
    request: Request, query: Annotated[CompareQuery, Depends(_query)], context: ContextDep
) -> Response:
    """The form, and once a spacecraft is chosen the comparison."""
    asked = {side: asked_options(request.query_params, f"{side}.") for side in SIDES}
    result = None
    if query.spacecraft is not None:
        context.caller.require(query.spacecraft)
        a, b = (OptionsIn.model_validate(asked[side]) for side in SIDES)
        result = context.app.comparisons.of_options(
            query.spacecraft,
            run=query.run,
            start=parse_utc(query.start, "start") if query.start.strip() else None,
            end=parse_utc(query.end, "end") if query.end.strip() else None,
            sample=query.sample,
            a=a,
            b=b,
            limit_s=WORK_S,
        )
    mission = context.app.missions.get(query.spacecraft or context.spacecraft[0])
    return rendered(
        "compare.html.jinja",
        context.layout(query.run),
        query=query,
        spacecraft=context.spacecraft,
        forms={side: fields_of(asked[side], None, f"{side}.") for side in SIDES},
        now={} if mission is None else settings_of_mission(mission),
        result=result,
        sides=SIDES,
        matrix=_matrix(result),
    )


def _matrix(result: Comparison | None) -> dict[tuple[str, str], int]:
    """How many stars went from which outcome to which."""
    if result is None:
        return {}
    return {(each.from_, each.to): each.stars for each in result.transitions}
