"""Page of annotations: notes of people on times and periods."""

from typing import Literal

from starlette.responses import Response

from service.contract.alarms import Annotation
from service.observations.schema import Key
from service.times import recorded_utc, shifted
from service.web.console.page import ContextDep, FromQuery, PeriodQuery, console_page
from service.web.requests.access import Policy
from service.web.requests.query_parameters import Cursor

AROUND_S = 1800.0
"""Seconds before and after an annotation in the linked trends."""


class AnnotationsQuery(PeriodQuery):
    """Query that selects annotations; an empty form field selects any value."""

    spacecraft: Key | Literal[""] = ""
    cursor: Cursor = None


@console_page("/annotations", "Annotations", Policy("read", "nothing"), position=25)
def annotations_page(query: FromQuery[AnnotationsQuery], context: ContextDep) -> Response:
    """Page with the annotations of a period, the latest written first."""
    query = query.model_copy(update={"spacecraft": context.listed(query.spacecraft)})
    page = context.app.annotations.page(
        spacecraft=query.spacecraft or None,
        **query.bounds,
        limit=50,
        cursor=query.cursor,
    )
    return context.rendered(
        "annotations.html.jinja",
        query.run,
        query=query,
        page=page,
        around=_around,
        spacecraft=context.spacecraft,
        may_write_of_all=context.caller.spacecraft is None,
    )


def _around(annotation: Annotation) -> dict[str, str]:
    """Period of the trends about an annotation."""
    end = annotation.end or annotation.start
    return {
        "start": shifted(recorded_utc(annotation.start), -AROUND_S).text,
        "end": shifted(recorded_utc(end), AROUND_S).text,
    }
