"""API routes of limits and alarms."""

from typing import Annotated, ClassVar

from fastapi import Path
from pydantic import AfterValidator, ConfigDict, Field
from starlette.requests import Request
from starlette.responses import Response

from service.access import Caller
from service.contract.alarms import Limit
from service.errors import NotFound
from service.features.alarms import records
from service.features.alarms.part import Alarms
from service.features.alarms.state import StateFilter
from service.observations.schema import Key, Wire
from service.trends.limits import LimitSettings
from service.trends.quantities import QuantityName, limited_names
from service.web.openapi import LINK, ApiRouter, ClientMethod, Returns
from service.web.requests import query_parameters as params
from service.web.requests.access import (
    AppDep,
    CallerDep,
    ChangeDep,
    Policy,
    json_response,
    page_response,
)
from service.web.requests.query_parameters import FromQuery, SpacecraftPath, Who
from service.web.requests.request_body import JsonBody, read_model

router = ApiRouter("alarms")
ROUTERS = (router,)

QuantityPath = Annotated[str, Path(description="A quantity, such as `ambiguous_share`.")]
AlarmId = Annotated[str, Path(description="The `id` of an alarm.")]


class AlarmQuery(params.Query):
    """Query that selects alarms by run, spacecraft and state."""

    run: params.RunOrAll = "live"
    spacecraft: params.SpacecraftFilter = None
    state: Annotated[
        StateFilter, Field(description="`active`: all alarms that are not cleared.")
    ] = "active"
    limit: params.PageLimit = 100
    cursor: params.Cursor = None


class LimitQuery(params.Query):
    """Query that selects the limits of a tracker instead of the whole spacecraft."""

    tracker: Annotated[
        Key | None,
        Field(
            description="Of this tracker, if the spacecraft has several; default: of the "
            "spacecraft as a whole. A tracker without limits of its own has the spacecraft's."
        ),
    ] = None


class LimitStatementQuery(params.StatementQuery, LimitQuery):
    """Query for a change of a limit: the tracker, the author and a comment."""


class _Statement(Wire):
    who: Who = None
    comment: params.Comment = None


class StatementIn(_Statement):
    """The author of an action on an alarm, and a comment."""

    component: ClassVar[str] = "Said"
    model_config = ConfigDict(title=component)


class ShelveIn(_Statement):
    """Request body to shelve an alarm for a number of minutes."""

    minutes: Annotated[int, Field(ge=1, le=10_080, description="At most a week.")]


class CommentIn(_Statement):
    """Request body with a comment on an alarm."""

    comment: Annotated[
        str, Field(min_length=1, max_length=2_000), AfterValidator(params.without_nul)
    ]


class LimitTrialIn(Wire):
    """Request body with a limit to evaluate without setting it."""

    settings: LimitSettings


class LimitPreviewQuery(LimitQuery, params.RunQuery):
    """Query that selects the recorded batches for the preview of a limit."""

    days: Annotated[int, Field(ge=1, le=30, description="Up to the run's latest batch.")] = 7


class LimitIn(_Statement):
    """Request body with a new limit, its author and a comment."""

    settings: LimitSettings


@router.serves(
    "GET /spacecraft/{name}/limits",
    Policy("read", "path"),
    Returns("Every limit.", records.LimitList),
)
def list_limits(name: SpacecraftPath, query: FromQuery[LimitQuery], app: AppDep) -> Response:
    """The limits of every quantity of a spacecraft or a tracker, set or shipped."""
    return json_response({"items": app.part(Alarms).limits.all(name, query.tracker)})


@router.serves(
    "GET /spacecraft/{name}/limits/{quantity}",
    Policy("read", "path"),
    Returns("The limit and its history.", records.LimitHistory),
)
def get_limit(
    name: SpacecraftPath, quantity: QuantityPath, query: FromQuery[LimitQuery], app: AppDep
) -> Response:
    """The limit of one quantity, the shipped limit, and the history of changes."""
    return json_response(
        app.part(Alarms).limits.get(name, _quantity_with_limits(quantity), query.tracker)
    )


@router.serves(
    "PUT /spacecraft/{name}/limits/{quantity}",
    Policy("operate", "path"),
    Returns("The limit, which applies from the next batch on.", Limit),
    body=LimitIn,
)
def set_limit(
    name: SpacecraftPath,
    quantity: QuantityPath,
    query: FromQuery[LimitQuery],
    body: JsonBody,
    app: AppDep,
    change: ChangeDep,
) -> Response:
    """Set the limit of a quantity; the previous one stays in the history."""
    asked = read_model(LimitIn, body)
    return json_response(_set(app, name, quantity, query.tracker, asked.settings, asked, change))


@router.serves(
    "POST /spacecraft/{name}/limits/{quantity}/preview",
    Policy("read", "path"),
    Returns("How this limit and the one in force evaluate them.", records.LimitPreview),
    body=LimitTrialIn,
)
def preview_limit(
    name: SpacecraftPath,
    quantity: QuantityPath,
    query: FromQuery[LimitPreviewQuery],
    body: JsonBody,
    app: AppDep,
) -> Response:
    """Evaluate recorded batches of the latest days against a limit without setting it."""
    asked = read_model(LimitTrialIn, body)
    limited = _quantity_with_limits(quantity)
    return json_response(
        app.part(Alarms).limits.preview(name, limited, asked.settings, **query.asked())
    )


@router.serves(
    "DELETE /spacecraft/{name}/limits/{quantity}",
    Policy("operate", "path"),
    Returns("The shipped limit, which applies again.", Limit),
    problems=(503,),
)
def reset_limit(
    name: SpacecraftPath,
    quantity: QuantityPath,
    query: FromQuery[LimitStatementQuery],
    app: AppDep,
    change: ChangeDep,
) -> Response:
    """Restore the shipped limit of a quantity; earlier limits stay in the history."""
    return json_response(_set(app, name, quantity, query.tracker, None, query, change))


def _set(
    app: AppDep,
    name: str,
    quantity: str,
    tracker: str | None,
    settings: LimitSettings | None,
    statement: LimitIn | LimitStatementQuery,
    change: ChangeDep,
) -> Limit:
    """Set the limit of a quantity, or restore the shipped one if `settings` is None."""
    limited, who = _quantity_with_limits(quantity), change.author(statement.who)
    return app.part(Alarms).limits.set(
        name,
        limited,
        settings,
        who=who,
        comment=statement.comment,
        entry=change.entry(),
        tracker=tracker,
    )


@ClientMethod(
    "alarms",
    by_place=("spacecraft",),
    example="""
    >>> [alarm.severity for alarm in client.alarms("XTE")]
    []
    """,
)
@router.serves(
    "GET /alarms", Policy("read", "query"), Returns("A page of alarms.", records.AlarmPage, LINK)
)
def list_alarms(request: Request, query: FromQuery[AlarmQuery], app: AppDep) -> Response:
    """Alarms, newest first; by default those that are not cleared."""
    return page_response(request, app.part(Alarms).page(**query.asked()))


@ClientMethod("alarm")
@router.serves(
    "GET /alarms/{id}", Policy("read", "nothing"), Returns("The alarm.", records.AlarmWithActions)
)
def get_alarm(id: AlarmId, app: AppDep, caller: CallerDep) -> Response:
    """One alarm with the history of its actions."""
    return json_response(_visible_alarm(app, id, caller))


@ClientMethod("acknowledge")
@router.serves(
    "POST /alarms/{id}/acknowledge",
    Policy("operate", "nothing"),
    Returns("The alarm, now acknowledged.", records.AlarmWithActions),
    body=StatementIn,
    problems=(409,),
)
def acknowledge_alarm(id: AlarmId, body: JsonBody, app: AppDep, change: ChangeDep) -> Response:
    """Acknowledge an alarm; an alarm back in limits is cleared."""
    asked = read_model(StatementIn, body)
    _visible_alarm(app, id, change.caller)
    who = change.author(asked.who)
    return json_response(app.part(Alarms).acknowledge(id, who, asked.comment, change.entry()))


@ClientMethod("shelve", by_place=("minutes",))
@router.serves(
    "POST /alarms/{id}/shelve",
    Policy("operate", "nothing"),
    Returns("The alarm, now shelved.", records.AlarmWithActions),
    body=ShelveIn,
    problems=(409,),
)
def shelve_alarm(id: AlarmId, body: JsonBody, app: AppDep, change: ChangeDep) -> Response:
    """Shelve an alarm for some minutes; shelving ends by itself."""
    asked = read_model(ShelveIn, body)
    _visible_alarm(app, id, change.caller)
    who = change.author(asked.who)
    return json_response(
        app.part(Alarms).shelve(id, who, asked.minutes, asked.comment, change.entry())
    )


@ClientMethod("unshelve")
@router.serves(
    "POST /alarms/{id}/unshelve",
    Policy("operate", "nothing"),
    Returns("The alarm.", records.AlarmWithActions),
    body=StatementIn,
    problems=(409,),
)
def unshelve_alarm(id: AlarmId, body: JsonBody, app: AppDep, change: ChangeDep) -> Response:
    """End the shelving of an alarm."""
    asked = read_model(StatementIn, body)
    _visible_alarm(app, id, change.caller)
    who = change.author(asked.who)
    return json_response(app.part(Alarms).unshelve(id, who, asked.comment, change.entry()))


@ClientMethod("comment", by_place=("comment",))
@router.serves(
    "POST /alarms/{id}/comment",
    Policy("operate", "nothing"),
    Returns("The alarm.", records.AlarmWithActions),
    body=CommentIn,
)
def comment_alarm(id: AlarmId, body: JsonBody, app: AppDep, change: ChangeDep) -> Response:
    """Add a comment to an alarm."""
    asked = read_model(CommentIn, body)
    _visible_alarm(app, id, change.caller)
    who = change.author(asked.who)
    return json_response(app.part(Alarms).comment(id, who, asked.comment, change.entry()))


def _quantity_with_limits(quantity: str) -> QuantityName:
    if quantity not in limited_names():
        known = ", ".join(limited_names())
        raise NotFound(f"limits do not apply to {quantity[:80]!r}, only to {known}")
    return quantity


def _visible_alarm(app: AppDep, id: str, caller: Caller) -> records.AlarmWithActions:
    """An alarm that the caller may see; raises `NotFound` for other callers' spacecraft."""
    found = app.part(Alarms).get(id)
    if not caller.may_see(found.spacecraft):
        raise NotFound(f"there is no alarm with the id {id[:80]!r}")
    return found
