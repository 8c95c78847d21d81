"""Access: a token exchanged for a browser's session, and the list of what was changed."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from pydantic import Field
from starlette.requests import Request
from starlette.responses import Response

from service.errors import NotAdmitted
from service.observe.wire import Wire
from service.records.tokens import SESSION_H
from service.web.access import COOKIE, Asking
from service.web.bodies import SessionBody, read_model
from service.web.describe import LINK, Gives, described
from service.web.holding import Held, json_response, page_response
from service.web.queries import NO_QUERY, AuditQuery
from service.web.schemas.access import AuditPage, Session

router = APIRouter(prefix="/api/v1", tags=["access"])


class SignIn(Wire):
    """What a browser's session is begun with."""

    token: Annotated[str, Field(min_length=1, max_length=200)]


@router.post(
    "/session",
    dependencies=[NO_QUERY],
    **described({200: Gives("Who is signed in now.", Session)}, body=SignIn, problems=(401, 503)),
)
def sign_in(request: Request, body: SessionBody, operations: Held) -> Response:
    """Exchange a token for a cookie that scripts cannot read and other sites cannot use."""
    secret, caller = operations.access.sign_in(read_model(SignIn, body).token)
    response = json_response(_shown(caller))
    response.set_cookie(
        COOKIE,
        secret,
        max_age=SESSION_H * 3600,
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return response


@router.get(
    "/session",
    dependencies=[NO_QUERY],
    **described({200: Gives("Who asks.", Session)}),
)
def session(caller: Asking) -> Response:
    """Who asks, and what they may."""
    return json_response(_shown(caller))


@router.delete(
    "/session",
    dependencies=[NO_QUERY],
    **described({200: Gives("Nobody is signed in any more.", Session)}, problems=(401,)),
)
def sign_out(request: Request, operations: Held) -> Response:
    """End the browser's session."""
    cookie = request.cookies.get(COOKIE)
    if cookie is None:
        raise NotAdmitted("nobody is signed in here")
    operations.access.sign_out(cookie)
    response = json_response({"name": None, "scopes": [], "spacecraft": []})
    response.delete_cookie(COOKIE, httponly=True, samesite="strict")
    return response


@router.get("/audit", **described({200: Gives("A page of changes.", AuditPage, LINK)}))
def list_audit(
    request: Request, query: Annotated[AuditQuery, InQuery()], operations: Held
) -> Response:
    """Who changed what, newest first."""
    return page_response(request, operations.audit(query.limit, query.cursor))


def _shown(caller: Asking) -> dict[str, object]:
    return {
        "name": caller.name,
        "scopes": sorted(caller.scopes),
        "spacecraft": None if caller.spacecraft is None else sorted(caller.spacecraft),
    }
