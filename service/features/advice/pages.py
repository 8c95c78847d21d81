"""The page of advice."""

from collections.abc import Mapping
from typing import Any
from urllib.parse import urlencode

from pydantic import model_validator
from starlette.responses import Response

from service.features.advice.part import AdviceService, no_changes_text
from service.features.advice.routes import ADVICE_LIMIT_S, MAX_SAMPLE, AdviceQuery
from service.missions.mission import Tolerances
from service.web.console.page import ContextDep, FromQuery, console_page
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
def advice_page(name: str, query: FromQuery[AdviceForm], context: ContextDep) -> Response:
    """Tolerances, noise, magnitudes, alignment, and the outcomes of other settings."""
    advice = context.app.part(AdviceService).of_spacecraft(
        name, **query.asked(), limit_s=ADVICE_LIMIT_S
    )
    return context.rendered(
        "advice.html.jinja",
        query.run,
        advice=advice,
        query=query,
        asked=urlencode(
            {name: getattr(query, name) for name in sorted(query.model_fields_set)}, doseq=True
        ),
        max_sample=MAX_SAMPLE,
        tolerances=list(Tolerances.model_fields),
        no_changes=no_changes_text(advice),
    )
