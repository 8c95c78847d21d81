"""Advice: what recorded batches say of a mission's settings."""

from typing import Annotated, Any

from fastapi import APIRouter
from fastapi import Query as InQuery
from pydantic import Field
from starlette.responses import Response

from service.app.advice import ADVICE_SAMPLE
from service.observations.schema import tolerances_from_text
from service.storage.models.advice import Advice
from service.web.openapi.route import ResponseDoc, route_docs
from service.web.requests.dependencies import AppDep, json_response
from service.web.requests.query_parameters import PeriodQuery, SpacecraftPath

router = APIRouter(prefix="/api/v1/spacecraft", tags=["spacecraft"])

MAX_SAMPLE = 2_000
ADVICE_LIMIT_S = 20.0
"""The longest wait for an answer; a sample that takes longer is cut short, and says so."""


class AdviceQuery(PeriodQuery):
    """Which batches to advise from, and how much work to spend on them."""

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
        """Every parameter as the app's functions take them."""
        asked = super().asked()
        return asked | {"tolerances": tolerances_from_text(asked.pop("tolerance"), "tolerance")}


@router.get(
    "/{name}/advice",
    **route_docs({200: ResponseDoc("The advice.", Advice)}, problems=(404, 503)),
)
def get_advice(
    name: SpacecraftPath, query: Annotated[AdviceQuery, InQuery()], app: AppDep
) -> Response:
    """Recommended mission settings from recorded batches: tolerances, noise, alignment."""
    return json_response(app.advice.of_spacecraft(name, **query.asked(), limit_s=ADVICE_LIMIT_S))
