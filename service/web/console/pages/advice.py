"""The page of advice on a spacecraft's mission file."""

from collections.abc import Mapping
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import Query as InQuery
from pydantic import model_validator
from starlette.responses import Response

from service.app.advice import no_changes_text
from service.missions.mission import Tolerances
from service.web.api.advice import ADVICE_LIMIT_S, MAX_SAMPLE, AdviceQuery
from service.web.console.page_context import ContextDep
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import Policy


class AdviceForm(AdviceQuery):
    """The same from a form, whose empty fields are left out."""

    @model_validator(mode="before")
    @classmethod
    def _without_empty(cls, asked: Mapping[str, Any]) -> dict[str, Any]:
        filled = {name: value for name, value in asked.items() if value != ""}
        if isinstance(filled.get("tolerance"), list):
            filled["tolerance"] = [each for each in filled["tolerance"] if each != ""]
        return filled


@console_page("/advice/{name}", "Advice", Policy("read", "path"), section="/")
def advice_page(
    name: str, query: Annotated[AdviceForm, InQuery()], context: ContextDep
) -> Response:
    """Tolerances, noise, magnitudes, alignment, and the outcomes of other settings."""
    advice = context.app.advice.of_spacecraft(name, **query.asked(), limit_s=ADVICE_LIMIT_S)
    return rendered(
        "advice.html.jinja",
        context.layout(query.run),
        advice=advice,
        query=query,
        asked=urlencode(
            {name: getattr(query, name) for name in sorted(query.model_fields_set)}, doseq=True
        ),
        max_sample=MAX_SAMPLE,
        tolerances=list(Tolerances.model_fields),
        no_changes=no_changes_text(advice),
    )
