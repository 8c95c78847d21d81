"""The advice for a spacecraft as a page: what its batches say of its mission file."""

from collections.abc import Mapping
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import APIRouter
from fastapi import Query as InQuery
from pydantic import model_validator
from starlette.responses import Response

from service.advice.report import no_changes_text
from service.missions.mission import Tolerances
from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import AtDesk
from service.web.routes.advice import ADVICE_LIMIT_S, MAX_SAMPLE, AdviceQuery

router = APIRouter(include_in_schema=False, route_class=PageRoute)


class AdviceForm(AdviceQuery):
    """The same as a form sends it: a field that was left empty asks for nothing."""

    @model_validator(mode="before")
    @classmethod
    def _without_empty(cls, asked: Mapping[str, Any]) -> dict[str, Any]:
        filled = {name: value for name, value in asked.items() if value != ""}
        if isinstance(filled.get("tolerance"), list):
            filled["tolerance"] = [each for each in filled["tolerance"] if each != ""]
        return filled


@router.get("/advice/{name}")
def advice_page(name: str, query: Annotated[AdviceForm, InQuery()], desk: AtDesk) -> Response:
    """Tolerances, noise, magnitudes, alignment, and what other settings would have come to."""
    advice = desk.operations.advise(name, **query.asked(), limit_s=ADVICE_LIMIT_S)
    return rendered(
        "advice.html.jinja",
        desk.shell(query.run, "/"),
        advice=advice,
        query=query,
        asked=urlencode(
            {name: getattr(query, name) for name in sorted(query.model_fields_set)}, doseq=True
        ),
        max_sample=MAX_SAMPLE,
        tolerances=list(Tolerances.model_fields),
        no_changes=no_changes_text(advice),
    )
