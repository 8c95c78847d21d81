"""Route of the API that gives advice on mission settings."""

from typing import Annotated, Any

from fastapi import Depends
from pydantic import Field
from starlette.responses import Response

from service.features.advice.part import ADVICE_SAMPLE, AdviceService
from service.features.advice.records import Advice
from service.observations.schema import tolerances_from_text
from service.web.openapi import ApiRouter, Example, Returns
from service.web.requests.access import AppDep, Policy, json_response
from service.web.requests.query_parameters import FromQuery, PeriodQuery, SpacecraftPath

router = ApiRouter("spacecraft")
ROUTERS = (router,)


async def _advice(app: AppDep) -> AdviceService:
    return app.part(AdviceService)


AdviceDep = Annotated[AdviceService, Depends(_advice)]

MAX_SAMPLE = 2_000
ADVICE_LIMIT_S = 20.0
"""Time limit of an answer in seconds; a sample that takes longer is cut short and marked."""


class AdviceQuery(PeriodQuery):
    """Query for advice: the batches to process again, their greatest number, tolerances to try."""

    sample: Annotated[
        int, Field(ge=1, le=MAX_SAMPLE, description="Maximum number of batches to process again.")
    ] = ADVICE_SAMPLE
    tolerance: Annotated[
        list[Annotated[str, Field(max_length=80)]],
        Field(
            default_factory=list,
            max_length=8,
            description="Further tolerances to try, all together: `separation_deg=0.01`.",
        ),
    ]

    def asked(self) -> dict[str, Any]:
        """Parameters of a query for advice, converted to arguments of the advice service."""
        asked = super().asked()
        return asked | {"tolerances": tolerances_from_text(asked.pop("tolerance"), "tolerance")}


@Example("of_two_batches", "tolerance=separation_deg=0.01")
@Example("tolerance", "tolerance=septol=1")
@router.serves(
    "GET /spacecraft/{name}/advice",
    Policy("read", "path"),
    Returns("The advice.", Advice),
    problems=(503,),
)
def get_advice(name: SpacecraftPath, query: FromQuery[AdviceQuery], advice: AdviceDep) -> Response:
    """Recommended mission settings from recorded batches: tolerances, noise, alignment."""
    return json_response(advice.of_spacecraft(name, **query.asked(), limit_s=ADVICE_LIMIT_S))
