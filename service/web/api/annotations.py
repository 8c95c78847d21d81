"""Annotations: notes on times and periods, of one spacecraft or of all."""

from typing import Annotated, ClassVar, Self

from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from pydantic import ConfigDict, Field, StringConstraints, model_validator
from starlette.requests import Request
from starlette.responses import Response

from service.access.tokens import Caller
from service.errors import NotFound, shown_value
from service.observations.schema import Key, Wire
from service.storage.models.alarms import Annotation, AnnotationPage
from service.web.openapi.route import LINK, ResponseDoc, route_docs
from service.web.requests.access import AuditDep, CallerDep, author, require_all_spacecraft
from service.web.requests.dependencies import AppDep, json_response, page_response
from service.web.requests.query_parameters import AnnotationQuery, AuthorQuery, Time, Who
from service.web.requests.request_body import JsonBody, read_model

router = APIRouter(prefix="/api/v1", tags=["annotations"])

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
    """A new annotation."""

    component: ClassVar[str] = "AnnotationIn"
    model_config = ConfigDict(title=component)

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


@router.get(
    "/annotations",
    **route_docs({200: ResponseDoc("A page of annotations.", AnnotationPage, LINK)}),
)
def list_annotations(
    request: Request, query: Annotated[AnnotationQuery, InQuery()], app: AppDep
) -> Response:
    """Notes that touch a period, the latest written first."""
    return page_response(request, app.annotations.page(**query.asked()))


@router.post(
    "/annotations",
    **route_docs(
        {201: ResponseDoc("The annotation.", Annotation)}, body=AnnotationIn, problems=(503,)
    ),
)
def add_annotation(body: JsonBody, app: AppDep, caller: CallerDep, audited: AuditDep) -> Response:
    """Write a note on a time or a period; the name of its author is stored with it."""
    asked = read_model(AnnotationIn, body)
    _require(caller, asked.spacecraft)
    written = app.annotations.add(
        asked.text,
        start=asked.start,
        end=asked.end,
        spacecraft=asked.spacecraft,
        who=author(caller, asked.who),
        entry=audited.entry(201),
    )
    return json_response(written, 201)


@router.delete(
    "/annotations/{id}",
    **route_docs(
        {200: ResponseDoc("The annotation that was deleted.", Annotation)}, problems=(404, 503)
    ),
)
def delete_annotation(
    id: AnnotationId,
    query: Annotated[AuthorQuery, InQuery()],
    app: AppDep,
    caller: CallerDep,
    audited: AuditDep,
) -> Response:
    """Delete a note; the audit list keeps its text, and who deleted it."""
    author(caller, query.who)
    found = app.annotations.get(id)
    if found.spacecraft is not None and not caller.may_see(found.spacecraft):
        raise NotFound(f"there is no annotation with the id {shown_value(id)}")
    _require(caller, found.spacecraft)
    return json_response(app.annotations.delete(id, audited.entry()))


def _require(caller: Caller, spacecraft: str | None) -> None:
    """Raise `Forbidden` where a caller that is bound to spacecraft writes about others."""
    if spacecraft is None:
        require_all_spacecraft(caller)
    else:
        caller.require(spacecraft)
