"""Limits, and the alarms that come of them."""

from typing import Annotated

from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from pydantic import Field
from starlette.requests import Request
from starlette.responses import Response

from service.alarms.limits import LIMITED, LimitSettings
from service.alarms.quantities import QuantityName
from service.errors import BadBatch, Fault, NotFound
from service.observe.wire import Wire
from service.records.tokens import Caller
from service.web.access import Asking, Audited
from service.web.bodies import JsonBody, read_model
from service.web.describe import LINK, Gives, described
from service.web.holding import Held, json_response, page_response
from service.web.queries import NO_QUERY, AlarmQuery, Comment, SaidQuery, Who
from service.web.schemas.alarms import AlarmPage, AlarmRecord, LimitHistory, LimitList, LimitOut

router = APIRouter(prefix="/api/v1", tags=["alarms"])

Name = Annotated[str, Path(description="The spacecraft's name, such as `XTE`.")]
Quantity = Annotated[str, Path(description="A quantity, such as `ambiguous_share`.")]
AlarmId = Annotated[str, Path(description="The `id` of an alarm.")]
HERE = "/spacecraft/{name}/limits"


class Said(Wire):
    """Who does something, and what they say of it."""

    who: Who = None
    comment: Comment = None


class ShelveIn(Said):
    """How long an alarm is put aside."""

    minutes: Annotated[int, Field(ge=1, le=10_080, description="A week at most.")]


class CommentIn(Said):
    """What somebody says of an alarm."""

    comment: Annotated[str, Field(min_length=1, max_length=2_000)]


class LimitIn(Said):
    """A limit that is to hold from now on."""

    settings: LimitSettings


@router.get(
    HERE,
    dependencies=[NO_QUERY],
    **described({200: Gives("Every limit.", LimitList)}, problems=(404,)),
)
def list_limits(name: Name, operations: Held) -> Response:
    """The limits of every quantity of a spacecraft, the shipped ones where none were set."""
    return json_response({"items": operations.limits(name)})


@router.get(
    HERE + "/{quantity}",
    dependencies=[NO_QUERY],
    **described({200: Gives("The limit and its history.", LimitHistory)}, problems=(404,)),
)
def get_limit(name: Name, quantity: Quantity, operations: Held) -> Response:
    """The limit of one quantity, the shipped one, and every one that was set."""
    return json_response(operations.limit(name, _limited(quantity)))


@router.put(
    HERE + "/{quantity}",
    dependencies=[NO_QUERY],
    **described(
        {200: Gives("The limit, which holds from the next batch on.", LimitOut)},
        body=LimitIn,
        problems=(404, 503),
    ),
)
def set_limit(
    name: Name,
    quantity: Quantity,
    body: JsonBody,
    operations: Held,
    caller: Asking,
    audited: Audited,
) -> Response:
    """Set a limit; the one before stays in its history."""
    asked = read_model(LimitIn, body)
    limited, who = _limited(quantity), _who(caller, asked.who)
    return json_response(
        operations.set_limit(
            name, limited, asked.settings, who=who, comment=asked.comment, entry=audited.entry()
        )
    )


@router.delete(
    HERE + "/{quantity}",
    **described(
        {200: Gives("The shipped limit, which holds again.", LimitOut)}, problems=(404, 503)
    ),
)
def reset_limit(
    name: Name,
    quantity: Quantity,
    query: Annotated[SaidQuery, InQuery()],
    operations: Held,
    caller: Asking,
    audited: Audited,
) -> Response:
    """Let the shipped limit hold again; those that were set stay in the history."""
    limited, who = _limited(quantity), _who(caller, query.who)
    return json_response(
        operations.set_limit(
            name, limited, None, who=who, comment=query.comment, entry=audited.entry()
        )
    )


@router.get("/alarms", **described({200: Gives("A page of alarms.", AlarmPage, LINK)}))
def list_alarms(
    request: Request, query: Annotated[AlarmQuery, InQuery()], operations: Held
) -> Response:
    """Alarms, newest first: those that are not cleared, unless another state is asked for."""
    return page_response(request, operations.alarms(**query.asked()))


@router.get(
    "/alarms/{id}",
    dependencies=[NO_QUERY],
    **described({200: Gives("The alarm.", AlarmRecord)}, problems=(404,)),
)
def get_alarm(id: AlarmId, operations: Held, caller: Asking) -> Response:
    """One alarm with all that was done about it."""
    return json_response(_theirs(operations, id, caller))


@router.post(
    "/alarms/{id}/acknowledge",
    dependencies=[NO_QUERY],
    **described(
        {200: Gives("The alarm, now acknowledged.", AlarmRecord)},
        body=Said,
        problems=(404, 409, 503),
    ),
)
def acknowledge_alarm(
    id: AlarmId, body: JsonBody, operations: Held, caller: Asking, audited: Audited
) -> Response:
    """Say that an alarm was seen; with the quantity back in limits it is cleared."""
    asked = read_model(Said, body)
    _theirs(operations, id, caller)
    who = _who(caller, asked.who)
    return json_response(operations.acknowledge(id, who, asked.comment, audited.entry()))


@router.post(
    "/alarms/{id}/shelve",
    dependencies=[NO_QUERY],
    **described(
        {200: Gives("The alarm, now on the shelf.", AlarmRecord)},
        body=ShelveIn,
        problems=(404, 409, 503),
    ),
)
def shelve_alarm(
    id: AlarmId, body: JsonBody, operations: Held, caller: Asking, audited: Audited
) -> Response:
    """Put an alarm aside for a while; it comes back by itself."""
    asked = read_model(ShelveIn, body)
    _theirs(operations, id, caller)
    who = _who(caller, asked.who)
    return json_response(operations.shelve(id, who, asked.minutes, asked.comment, audited.entry()))


@router.post(
    "/alarms/{id}/unshelve",
    dependencies=[NO_QUERY],
    **described({200: Gives("The alarm.", AlarmRecord)}, body=Said, problems=(404, 409, 503)),
)
def unshelve_alarm(
    id: AlarmId, body: JsonBody, operations: Held, caller: Asking, audited: Audited
) -> Response:
    """Take an alarm off the shelf."""
    asked = read_model(Said, body)
    _theirs(operations, id, caller)
    who = _who(caller, asked.who)
    return json_response(operations.unshelve(id, who, asked.comment, audited.entry()))


@router.post(
    "/alarms/{id}/comment",
    dependencies=[NO_QUERY],
    **described({200: Gives("The alarm.", AlarmRecord)}, body=CommentIn, problems=(404, 503)),
)
def comment_alarm(
    id: AlarmId, body: JsonBody, operations: Held, caller: Asking, audited: Audited
) -> Response:
    """Say something about an alarm."""
    asked = read_model(CommentIn, body)
    _theirs(operations, id, caller)
    who = _who(caller, asked.who)
    return json_response(operations.comment(id, who, asked.comment, audited.entry()))


def _limited(quantity: str) -> QuantityName:
    for name in LIMITED:
        if name == quantity:
            return name
    raise NotFound(f"there are no limits for {quantity[:80]!r}; for {', '.join(LIMITED)} there are")


def _who(caller: Caller, named: str | None) -> str:
    """Whoever holds the token; without tokens, whoever they say they are."""
    if caller.token_id is not None:
        return caller.name
    if named is None:
        raise BadBatch(Fault("who", "must say who does this: 1 to 64 characters"))
    return named


def _theirs(operations: Held, id: str, caller: Caller) -> dict[str, object]:
    """An alarm, where it is one of the caller's spacecraft; else it is not there for them."""
    found = operations.alarm(id)
    if not caller.may_see(found["spacecraft"]):
        raise NotFound(f"there is no alarm with the id {id[:80]!r}")
    return found
