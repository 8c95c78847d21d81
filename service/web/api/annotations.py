"""API routes for annotations: notes on times and periods of telemetry."""

from typing import Annotated, Self

from fastapi import Path
from pydantic import Field, StringConstraints, model_validator
from starlette.requests import Request
from starlette.responses import Response

from service.access import Caller
from service.contract import alarms as models
from service.errors import NotFound, shown_value
from service.observations.schema import Key, Wire
from service.web.openapi import LINK, ApiRouter, Returns
from service.web.requests import query_parameters as params
from service.web.requests.access import (
    AppDep,
    ChangeDep,
    Policy,
    json_response,
    page_response,
    require_all_spacecraft,
)
from service.web.requests.query_parameters import FromQuery, Time, Who
from service.web.requests.request_body import JsonBody, read_model

router = ApiRouter("annotations")

AnnotationId = Annotated[str, Path(description="The `id` of an annotation.")]
NoteText = Annotated[
    str,
    StringConstraints(strip_whitespace=True, min_length=1, max_length=2_000),
    Field(
        # PostgreSQL stores no NUL; the other control characters show as nothing.
        pattern=r"^[^\x00-\x08\x0b-\x1f\x7f]+$",
        description="Plain text of one or more lines.",
        examples=["Wheel 2 unloaded; the slew ends at 12:20."],
    ),
]


class AnnotationIn(Wire):
    """Request body with a new annotation."""

    text: NoteText
    start: Annotated[Time, Field(description="Telemetry time that the note is about.")]
    end: Annotated[Time | None, Field(description="End of a period; null: a moment.")] = None
    spacecraft: Annotated[Key | None, Field(description="null: every spacecraft.")] = None
    who: Who = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.end is not None and self.end.tai_ns <= self.start.tai_ns:
            raise ValueError(f"end {self.end} must be after start {self.start}")
        return self


@router.serves(
    "GET /annotations",
    Policy("read", "query"),
    Returns("A page of annotations.", models.AnnotationPage, LINK),
)
def list_annotations(
    request: Request, query: FromQuery[params.AnnotationQuery], app: AppDep
) -> Response:
    """Annotations that touch a period, the latest written first."""
    return page_response(request, app.annotations.page(**query.asked()))


@router.serves(
    "POST /annotations",
    Policy("operate", "body"),
    Returns("The annotation.", models.Annotation, status=201),
    body=AnnotationIn,
)
def add_annotation(body: JsonBody, app: AppDep, change: ChangeDep) -> Response:
    """Write an annotation on a time or a period; the name of its author is stored with it."""
    asked = read_model(AnnotationIn, body)
    _require(change.caller, asked.spacecraft)
    written = app.annotations.add(
        asked.text,
        start=asked.start,
        end=asked.end,
        spacecraft=asked.spacecraft,
        who=change.author(asked.who),
        entry=change.entry(201),
    )
    return json_response(written, 201)


@router.serves(
    "DELETE /annotations/{id}",
    # Of tokens that are bound to spacecraft only notes on these: see the handler.
    Policy("operate", "nothing"),
    Returns("The annotation that was deleted.", models.Annotation),
    problems=(503,),
)
def delete_annotation(
    id: AnnotationId, query: FromQuery[params.StatementQuery], app: AppDep, change: ChangeDep
) -> Response:
    """Delete an annotation; the audit list keeps its text, and who deleted it and why."""
    who = change.author(query.who)
    found = app.annotations.get(id)
    if found.spacecraft is not None and not change.caller.may_see(found.spacecraft):
        raise NotFound(f"there is no annotation with the id {shown_value(id)}")
    _require(change.caller, found.spacecraft)
    return json_response(app.annotations.delete(id, who, query.comment, change.entry()))


def _require(caller: Caller, spacecraft: str | None) -> None:
    """Raise `Forbidden` if a caller bound to spacecraft writes about others, or about all."""
    if spacecraft is None:
        require_all_spacecraft(caller)
    else:
        caller.require(spacecraft)
