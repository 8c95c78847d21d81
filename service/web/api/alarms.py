"""Limits, the alarms that they raise, and annotations: notes on times and periods."""

from typing import Annotated, ClassVar, Self

from fastapi import Path
from pydantic import AfterValidator, ConfigDict, Field, StringConstraints, model_validator
from starlette.requests import Request
from starlette.responses import Response

from service.access import Caller
from service.contract import alarms as models
from service.errors import NotFound, shown_value
from service.observations.schema import Key, Wire
from service.trends.limits import LimitSettings
from service.trends.quantities import QuantityName, limited_names
from service.web.openapi import LINK, ApiRouter, Returns
from service.web.requests import query_parameters as params
from service.web.requests.access import (
    AppDep,
    CallerDep,
    ChangeDep,
    json_response,
    page_response,
    require_all_spacecraft,
)
from service.web.requests.query_parameters import FromQuery, SpacecraftPath, Time, Who
from service.web.requests.request_body import JsonBody, read_model

router = ApiRouter("alarms")

QuantityPath = Annotated[str, Path(description="A quantity, such as `ambiguous_share`.")]
AlarmId = Annotated[str, Path(description="The `id` of an alarm.")]


class _Statement(Wire):
    who: Who = None
    comment: params.Comment = None


class StatementIn(_Statement):
    """The author of an action, and a comment."""

    component: ClassVar[str] = "Said"
    model_config = ConfigDict(title=component)


class ShelveIn(_Statement):
    """How long to shelve an alarm."""

    minutes: Annotated[int, Field(ge=1, le=10_080, description="At most a week.")]


class CommentIn(_Statement):
    """A comment on an alarm."""

    comment: Annotated[
        str, Field(min_length=1, max_length=2_000), AfterValidator(params.without_nul)
    ]


class LimitTrialIn(Wire):
    """A limit to try."""

    settings: LimitSettings


class LimitPreviewQuery(params.LimitQuery, params.RunQuery):
    """What a limit is tried on."""

    days: Annotated[int, Field(ge=1, le=30, description="Up to the run's latest batch.")] = 7


class LimitIn(_Statement):
    """A new limit."""

    settings: LimitSettings


@router.serves("GET /spacecraft/{name}/limits", Returns("Every limit.", models.LimitList))
def list_limits(name: SpacecraftPath, query: FromQuery[params.LimitQuery], app: AppDep) -> Response:
    """The limits of every quantity of a spacecraft or a tracker, set or shipped."""
    return json_response({"items": app.limits.all(name, query.tracker)})


@router.serves(
    "GET /spacecraft/{name}/limits/{quantity}",
    Returns("The limit and its history.", models.LimitHistory),
)
def get_limit(
    name: SpacecraftPath, quantity: QuantityPath, query: FromQuery[params.LimitQuery], app: AppDep
) -> Response:
    """The limit of one quantity, the shipped limit, and the history of changes."""
    return json_response(app.limits.get(name, _quantity_with_limits(quantity), query.tracker))


@router.serves(
    "PUT /spacecraft/{name}/limits/{quantity}",
    Returns("The limit, which applies from the next batch on.", models.Limit),
    body=LimitIn,
)
def set_limit(
    name: SpacecraftPath,
    quantity: QuantityPath,
    query: FromQuery[params.LimitQuery],
    body: JsonBody,
    app: AppDep,
    change: ChangeDep,
) -> Response:
    """Set a limit; the previous one stays in the history."""
    asked = read_model(LimitIn, body)
    return json_response(_set(app, name, quantity, query.tracker, asked.settings, asked, change))


@router.serves(
    "POST /spacecraft/{name}/limits/{quantity}/preview",
    Returns("How this limit and the one in force evaluate them.", models.LimitPreview),
    body=LimitTrialIn,
)
def preview_limit(
    name: SpacecraftPath,
    quantity: QuantityPath,
    query: FromQuery[LimitPreviewQuery],
    body: JsonBody,
    app: AppDep,
) -> Response:
    """Evaluate the latest days against a limit without setting it."""
    asked = read_model(LimitTrialIn, body)
    limited = _quantity_with_limits(quantity)
    return json_response(app.limits.preview(name, limited, asked.settings, **query.asked()))


@router.serves(
    "DELETE /spacecraft/{name}/limits/{quantity}",
    Returns("The shipped limit, which applies again.", models.Limit),
    problems=(503,),
)
def reset_limit(
    name: SpacecraftPath,
    quantity: QuantityPath,
    query: FromQuery[params.LimitStatementQuery],
    app: AppDep,
    change: ChangeDep,
) -> Response:
    """Restore the shipped limit; earlier limits stay in the history."""
    return json_response(_set(app, name, quantity, query.tracker, None, query, change))


def _set(
    app: AppDep,
    name: str,
    quantity: str,
    tracker: str | None,
    settings: LimitSettings | None,
    statement: LimitIn | params.LimitStatementQuery,
    change: ChangeDep,
) -> models.Limit:
    """Set a limit, or without settings restore the shipped one."""
    limited, who = _quantity_with_limits(quantity), change.author(statement.who)
    return app.limits.set(
        name,
        limited,
        settings,
        who=who,
        comment=statement.comment,
        entry=change.entry(),
        tracker=tracker,
    )


@router.serves("GET /alarms", Returns("A page of alarms.", models.AlarmPage, LINK))
def list_alarms(request: Request, query: FromQuery[params.AlarmQuery], app: AppDep) -> Response:
    """Alarms, newest first; by default those that are not cleared."""
    return page_response(request, app.alarms.page(**query.asked()))


@router.serves("GET /alarms/{id}", Returns("The alarm.", models.AlarmWithActions))
def get_alarm(id: AlarmId, app: AppDep, caller: CallerDep) -> Response:
    """One alarm with its history."""
    return json_response(_visible_alarm(app, id, caller))


@router.serves(
    "POST /alarms/{id}/acknowledge",
    Returns("The alarm, now acknowledged.", models.AlarmWithActions),
    body=StatementIn,
    problems=(409,),
)
def acknowledge_alarm(id: AlarmId, body: JsonBody, app: AppDep, change: ChangeDep) -> Response:
    """Acknowledge an alarm; it is cleared if the quantity is back in limits."""
    asked = read_model(StatementIn, body)
    _visible_alarm(app, id, change.caller)
    who = change.author(asked.who)
    return json_response(app.alarms.acknowledge(id, who, asked.comment, change.entry()))


@router.serves(
    "POST /alarms/{id}/shelve",
    Returns("The alarm, now shelved.", models.AlarmWithActions),
    body=ShelveIn,
    problems=(409,),
)
def shelve_alarm(id: AlarmId, body: JsonBody, app: AppDep, change: ChangeDep) -> Response:
    """Shelve an alarm for some minutes; it returns by itself."""
    asked = read_model(ShelveIn, body)
    _visible_alarm(app, id, change.caller)
    who = change.author(asked.who)
    return json_response(app.alarms.shelve(id, who, asked.minutes, asked.comment, change.entry()))


@router.serves(
    "POST /alarms/{id}/unshelve",
    Returns("The alarm.", models.AlarmWithActions),
    body=StatementIn,
    problems=(409,),
)
def unshelve_alarm(id: AlarmId, body: JsonBody, app: AppDep, change: ChangeDep) -> Response:
    """Unshelve an alarm."""
    asked = read_model(StatementIn, body)
    _visible_alarm(app, id, change.caller)
    who = change.author(asked.who)
    return json_response(app.alarms.unshelve(id, who, asked.comment, change.entry()))


@router.serves(
    "POST /alarms/{id}/comment", Returns("The alarm.", models.AlarmWithActions), body=CommentIn
)
def comment_alarm(id: AlarmId, body: JsonBody, app: AppDep, change: ChangeDep) -> Response:
    """Add a comment to an alarm."""
    asked = read_model(CommentIn, body)
    _visible_alarm(app, id, change.caller)
    who = change.author(asked.who)
    return json_response(app.alarms.comment(id, who, asked.comment, change.entry()))


def _quantity_with_limits(quantity: str) -> QuantityName:
    if quantity not in limited_names():
        known = ", ".join(limited_names())
        raise NotFound(f"limits do not apply to {quantity[:80]!r}, only to {known}")
    return quantity


def _visible_alarm(app: AppDep, id: str, caller: Caller) -> models.AlarmWithActions:
    """An alarm of the caller's spacecraft; raises `NotFound` for those of others."""
    found = app.alarms.get(id)
    if not caller.may_see(found.spacecraft):
        raise NotFound(f"there is no alarm with the id {id[:80]!r}")
    return found


annotations_router = ApiRouter("annotations")

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


@annotations_router.serves(
    "GET /annotations", Returns("A page of annotations.", models.AnnotationPage, LINK)
)
def list_annotations(
    request: Request, query: FromQuery[params.AnnotationQuery], app: AppDep
) -> Response:
    """Notes that touch a period, the latest written first."""
    return page_response(request, app.annotations.page(**query.asked()))


@annotations_router.serves(
    "POST /annotations",
    Returns("The annotation.", models.Annotation, status=201),
    body=AnnotationIn,
)
def add_annotation(body: JsonBody, app: AppDep, change: ChangeDep) -> Response:
    """Write a note on a time or a period; the name of its author is stored with it."""
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


@annotations_router.serves(
    "DELETE /annotations/{id}",
    Returns("The annotation that was deleted.", models.Annotation),
    problems=(503,),
)
def delete_annotation(
    id: AnnotationId, query: FromQuery[params.AuthorQuery], app: AppDep, change: ChangeDep
) -> Response:
    """Delete a note; the audit list keeps its text, and who deleted it."""
    change.author(query.who)
    found = app.annotations.get(id)
    if found.spacecraft is not None and not change.caller.may_see(found.spacecraft):
        raise NotFound(f"there is no annotation with the id {shown_value(id)}")
    _require(change.caller, found.spacecraft)
    return json_response(app.annotations.delete(id, change.entry()))


def _require(caller: Caller, spacecraft: str | None) -> None:
    """Raise `Forbidden` where a caller that is bound to spacecraft writes about others."""
    if spacecraft is None:
        require_all_spacecraft(caller)
    else:
        caller.require(spacecraft)
