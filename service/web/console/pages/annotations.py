"""The page of annotations: notes of people on times and periods."""

from typing import Annotated, Literal

from pydantic import Field
from starlette.responses import Response

from service.contract.alarms import Annotation
from service.observations.schema import Key
from service.times import recorded_utc, shifted
from service.web.console.page import ContextDep, FromQuery, PageQuery, console_page, typed_utc
from service.web.requests.access import Policy
from service.web.requests.query_parameters import Cursor

ANNOTATION_ROWS = 50
AROUND_S = 1800.0
"""Before and after an annotation: what the link to the trends shows."""


class AnnotationsQuery(PageQuery):
    """Which annotations; an empty field of the form stands for any value."""

    spacecraft: Key | Literal[""] = ""
    start: Annotated[str, Field(max_length=40)] = ""
    end: Annotated[str, Field(max_length=40)] = ""
    cursor: Cursor = None

    @property
    def filters(self) -> dict[str, str | None]:
        """The filters, without the run and the cursor."""
        return {name: getattr(self, name) or None for name in ("spacecraft", "start", "end")}


@console_page("/annotations", "Annotations", Policy("read", "nothing"), position=25)
def annotations_page(query: FromQuery[AnnotationsQuery], context: ContextDep) -> Response:
    """The annotations of a period, the latest written first."""
    if query.spacecraft:
        context.caller.require(query.spacecraft)
    elif context.caller.spacecraft is not None:
        query = query.model_copy(update={"spacecraft": context.first_spacecraft})
    page = context.app.annotations.page(
        spacecraft=query.spacecraft or None,
        start=typed_utc(query.start, "start") if query.start else None,
        end=typed_utc(query.end, "end") if query.end else None,
        limit=ANNOTATION_ROWS,
        cursor=query.cursor,
    )
    return context.rendered(
        "annotations.html.jinja",
        query.run,
        query=query,
        page=page,
        around=_around,
        spacecraft=context.spacecraft,
    )


def _around(annotation: Annotation) -> dict[str, str]:
    """The period of the trends about an annotation."""
    end = annotation.end or annotation.start
    return {
        "start": shifted(recorded_utc(annotation.start), -AROUND_S).text,
        "end": shifted(recorded_utc(end), AROUND_S).text,
    }
