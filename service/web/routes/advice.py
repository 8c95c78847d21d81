"""Advice: what recorded batches say of a mission's settings."""

from typing import Annotated, Any

from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from pydantic import Field
from starlette.responses import Response

from service.observe.wire import tolerances_from_text
from service.operations import ADVICE_SAMPLE
from service.web.describe import Gives, described
from service.web.holding import Held, json_response
from service.web.queries import Stretch
from service.web.schemas.advice import Advice

router = APIRouter(prefix="/api/v1/spacecraft", tags=["spacecraft"])

MAX_SAMPLE = 2_000
ADVICE_LIMIT_S = 20.0
"""Nobody waits longer for an answer; a sample that takes more is cut short, and says so."""

Name = Annotated[str, Path(description="The spacecraft's name, such as `XTE`.")]


class AdviceQuery(Stretch):
    """Which batches to advise from, and how much work to spend on them."""

    sample: Annotated[
        int, Field(ge=1, le=MAX_SAMPLE, description="The most batches that are run again.")
    ] = ADVICE_SAMPLE
    tolerance: Annotated[
        list[Annotated[str, Field(max_length=80)]],
        Field(
            default_factory=list,
            max_length=8,
            description="Tolerances to be tried as well, together: `separation_deg=0.01`.",
        ),
    ]

    def asked(self) -> dict[str, Any]:
        """Every parameter as the operations take them."""
        asked = super().asked()
        return asked | {"tolerances": tolerances_from_text(asked.pop("tolerance"), "tolerance")}


@router.get(
    "/{name}/advice",
    **described({200: Gives("The advice.", Advice)}, problems=(404, 503)),
)
def get_advice(name: Name, query: Annotated[AdviceQuery, InQuery()], operations: Held) -> Response:
    """What recorded batches say of the mission's settings: tolerances, noise, alignment."""
    return json_response(operations.advise(name, **query.asked(), limit_s=ADVICE_LIMIT_S))
