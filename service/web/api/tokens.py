"""Access: a token exchanged for a browser's session, and the list of what was changed."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from pydantic import Field
from starlette.requests import Request
from starlette.responses import Response

from service.access.tokens import SESSION_H
from service.errors import Unauthenticated
from service.observations.schema import Wire
from service.storage.models.access import AuditPage, Session
from service.web.openapi.route import LINK, ResponseDoc, route_docs
from service.web.requests.access import COOKIE, CallerDep
from service.web.requests.dependencies import AppDep, json_response, page_response
from service.web.requests.query_parameters import NO_QUERY, AuditQuery
from service.web.requests.request_body import SessionBody, read_model

router = APIRouter(prefix="/api/v1", tags=["access"])


class SignIn(Wire):
    """The token for a browser's session."""

    token: Annotated[str, Field(min_length=1, max_length=200)]


@router.post(
    "/session",
    dependencies=[NO_QUERY],
    **route_docs(
        {200: ResponseDoc("The signed-in caller.", Session)}, body=SignIn, problems=(401, 503)
    ),
)
def sign_in(request: Request, body: SessionBody, app: AppDep) -> Response:
    """Exchange a token for a session cookie (`HttpOnly`, `SameSite=Strict`)."""
    secret, caller = app.access.sign_in(read_model(SignIn, body).token)
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
    **route_docs({200: ResponseDoc("The caller.", Session)}),
)
def session(caller: CallerDep) -> Response:
    """The caller and its scopes."""
    return json_response(_shown(caller))


@router.delete(
    "/session",
    dependencies=[NO_QUERY],
    **route_docs({200: ResponseDoc("The session has ended.", Session)}, problems=(401,)),
)
def sign_out(request: Request, app: AppDep) -> Response:
    """End the browser's session."""
    cookie = request.cookies.get(COOKIE)
    if cookie is None:
        raise Unauthenticated("there is no session to end")
    app.access.sign_out(cookie)
    response = json_response({"name": None, "scopes": [], "spacecraft": []})
    response.delete_cookie(COOKIE, httponly=True, samesite="strict")
    return response


@router.get("/audit", **route_docs({200: ResponseDoc("A page of changes.", AuditPage, LINK)}))
def list_audit(request: Request, query: Annotated[AuditQuery, InQuery()], app: AppDep) -> Response:
    """The audit list of changes, newest first."""
    return page_response(request, app.audit.page(query.limit, query.cursor))


def _shown(caller: CallerDep) -> dict[str, object]:
    return {
        "name": caller.name,
        "scopes": sorted(caller.scopes),
        "spacecraft": None if caller.spacecraft is None else sorted(caller.spacecraft),
    }
