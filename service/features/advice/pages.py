"""Console page with advice on the settings of a mission, and panel on ambiguous stars."""

import re
from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import urlencode

from markupsafe import Markup, escape
from pydantic import model_validator
from starlette.responses import Response

from service.errors import BadInput
from service.features.advice.part import AdviceService, best_setting, no_changes_text
from service.features.advice.routes import ADVICE_LIMIT_S, MAX_SAMPLE, AdviceQuery
from service.features.advice.text import mission_lines
from service.missions.mission import Tolerances
from service.times import DAY_S, Utc, shifted
from service.web.console.options import SYMBOLS
from service.web.console.page import ContextDep, FromQuery, PageContext, Panel, console_page
from service.web.console.pages.spacecraft_page import PeriodBefore, ShownPeriod
from service.web.requests.access import Policy

FIRST_SAMPLE, FIRST_LIMIT_S = 60, 1.5
"""Sample size (batches) and time limit (seconds) of the first view of the advice page."""


class AdviceForm(AdviceQuery):
    """Query of the advice page, sent by a form whose empty fields are ignored."""

    @model_validator(mode="before")
    @classmethod
    def _without_empty(cls, asked: Mapping[str, Any]) -> dict[str, Any]:
        filled = {name: value for name, value in asked.items() if value != ""}
        if isinstance(filled.get("tolerance"), list):
            filled["tolerance"] = [each for each in filled["tolerance"] if each != ""]
        return filled


_SYMBOLS = {**SYMBOLS, "zone.radius_deg": "CCAP", "zone.half_width_deg": "WBAND"}
_NAMED = re.compile(rf"\b({'|'.join(map(re.escape, _SYMBOLS))})\b")


def with_settings(text: str) -> Markup:
    """Mark up setting names in a sentence, with the symbols of Fink & Shoup as tooltips."""
    marked = _NAMED.sub(
        lambda found: (
            f'<abbr title="{_SYMBOLS[found[0]]} in Fink &amp; Shoup (1994)">{found[0]}</abbr>'
        ),
        str(escape(text)),
    )
    return Markup(marked)


@console_page("/advice/{name}", "Advice", Policy("read", "path"), section="/")
def advice_page(name: str, query: FromQuery[AdviceForm], context: ContextDep) -> Response:
    """Console page with recommended tolerances, noise, magnitudes, alignment, trial outcomes."""
    is_first = "sample" not in query.model_fields_set and not query.tolerance
    asked = query.asked() | ({"sample": FIRST_SAMPLE} if is_first else {})
    advice = context.app.part(AdviceService).of_spacecraft(
        name, **asked, limit_s=FIRST_LIMIT_S if is_first else ADVICE_LIMIT_S
    )
    found = (
        advice.groups
        + advice.zone
        + advice.tolerances
        + advice.noise
        + advice.magnitudes
        + advice.alignment
        + advice.innovations
    )
    used = [each for each in found if getattr(each, "verdict", "") != "not_used"]
    return context.rendered(
        "advice.html.jinja",
        query.run,
        advice=advice,
        query=query,
        is_first=is_first,
        with_settings=with_settings,
        best=best_setting(advice),
        to_do=[each for each in used if each.action not in ("keep", "wait")],
        to_keep=[each for each in used if each.action in ("keep", "wait")],
        tried=[
            each for each in advice.tried if query.tolerance or each.identifier == advice.identifier
        ],
        asked=urlencode(
            {name: getattr(query, name) for name in sorted(query.model_fields_set)}, doseq=True
        ),
        max_sample=MAX_SAMPLE,
        tolerances=list(Tolerances.model_fields),
        mission_lines=mission_lines(advice),
        no_changes=no_changes_text(advice),
    )


def ambiguity_of_period(
    context: PageContext, name: str, run: str, shown: ShownPeriod, before: PeriodBefore
) -> Iterator[Panel]:
    """Panel that compares ambiguous stars of a period with an earlier one, with causes."""
    found = context.app.part(AdviceService).ambiguity(
        name, run, shown.start, shown.end, before.shift_s
    )
    if found.parts:
        yield Panel("_ambiguity.html.jinja", found)


def causes_of_alarm(
    context: PageContext, name: str, run: str, start: Utc, end: Utc
) -> Iterator[Panel]:
    """Panel of the causes that explain the stars of an alarm's first day, if there are any."""
    last = min(end, shifted(start, DAY_S), key=lambda each: each.tai_ns)
    try:
        found = context.app.part(AdviceService).ambiguity(name, run, start, last)
    except BadInput:
        # A recorded batch cannot be read any more: the page of the alarm does without.
        return
    if found.causes:
        yield Panel("_causes_of_alarm.html.jinja", found.causes)


PANELS = {"ambiguity": ambiguity_of_period, "alarm_page": causes_of_alarm}
