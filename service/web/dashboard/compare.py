"""The page that compares two sets of options over one stretch of recorded batches."""

from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import APIRouter, Depends
from pydantic import Field, ValidationError
from starlette.requests import Request
from starlette.responses import Response

from service.errors import BadBatch, Fault, shown_value
from service.observe.wire import Key, OptionsIn
from service.times import parse_utc
from service.web.dashboard.options import asked_options, fields_of, settings_of_mission
from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import AtDesk, RunQuery
from service.web.routes.compare import WORK_S

router = APIRouter(include_in_schema=False, route_class=PageRoute)

SAMPLE = 100
SIDES = ("a", "b")


class CompareQuery(RunQuery):
    """Which batches; the options of either side stand beside it as `a.` and `b.`."""

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


@router.get("/compare")
def compare_page(
    request: Request, query: Annotated[CompareQuery, Depends(_query)], desk: AtDesk
) -> Response:
    """The form, and where a spacecraft was chosen what the two sides come to."""
    asked = {side: asked_options(request.query_params, f"{side}.") for side in SIDES}
    result = None
    if query.spacecraft is not None:
        desk.caller.require(query.spacecraft)
        a, b = (OptionsIn.model_validate(asked[side]) for side in SIDES)
        result = desk.operations.compare(
            query.spacecraft,
            run=query.run,
            start=parse_utc(query.start, "start") if query.start.strip() else None,
            end=parse_utc(query.end, "end") if query.end.strip() else None,
            sample=query.sample,
            a=a,
            b=b,
            limit_s=WORK_S,
        )
    mission = desk.operations.missions.get(query.spacecraft or desk.spacecraft[0])
    return rendered(
        "compare.html.jinja",
        desk.shell(query.run, "/compare"),
        query=query,
        spacecraft=desk.spacecraft,
        forms={side: fields_of(asked[side], None, f"{side}.") for side in SIDES},
        now={} if mission is None else settings_of_mission(mission),
        result=result,
        sides=SIDES,
        matrix=_matrix(result),
    )


def _matrix(result: Mapping[str, Any] | None) -> dict[tuple[str, str], int]:
    """How many stars went from which outcome to which."""
    if result is None:
        return {}
    return {(each["from"], each["to"]): each["stars"] for each in result["transitions"]}
