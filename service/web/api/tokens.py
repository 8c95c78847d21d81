"""API routes for access: tokens, browser sessions, and the audit list."""

from typing import Annotated

from fastapi import Path
from pydantic import Field
from starlette.requests import Request
from starlette.responses import Response

from service import access
from service.contract.access import AuditPage, NewToken, Scope, Session, Token, TokenList
from service.errors import Unauthenticated
from service.observations.schema import Key, Wire
from service.web.openapi import LINK, ApiRouter, ClientMethod, Example, Returns
from service.web.requests.access import (
    COOKIE,
    OPEN,
    OPERATE,
    AppDep,
    CallerDep,
    ChangeDep,
    Policy,
    json_response,
    page_response,
)
from service.web.requests.query_parameters import AuditQuery, FromQuery
from service.web.requests.request_body import JsonBody, SessionBody, read_model

router = ApiRouter("access")


class SignIn(Wire):
    """Request body with the token for a browser session."""

    token: Annotated[str, Field(min_length=1, max_length=200)]


@router.serves(
    "POST /session", OPEN, Returns("The signed-in caller.", Session), body=SignIn, problems=(401,)
)
def sign_in(request: Request, body: SessionBody, app: AppDep) -> Response:
    """Exchange a token for a session cookie (`HttpOnly`, `SameSite=Strict`)."""
    secret, caller = app.access.sign_in(read_model(SignIn, body).token)
    response = json_response(_shown(caller))
    response.set_cookie(
        COOKIE,
        secret,
        max_age=access.SESSION_H * 3600,
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return response


@ClientMethod(
    "session",
    example="""
    >>> client.session().scopes
    ['operate', 'read', 'submit']
    """,
)
@Example("open_access")
@router.serves("GET /session", Policy("read", "nothing"), Returns("The caller.", Session))
def session(caller: CallerDep) -> Response:
    """Name, scopes and spacecraft of the caller."""
    return json_response(_shown(caller))


@router.serves("DELETE /session", OPEN, Returns("The session has ended.", Session), problems=(401,))
def sign_out(request: Request, app: AppDep) -> Response:
    """End the browser session of the caller."""
    cookie = request.cookies.get(COOKIE)
    if cookie is None:
        raise Unauthenticated("there is no session to end")
    app.access.sign_out(cookie)
    response = json_response({"name": None, "scopes": [], "spacecraft": []})
    response.delete_cookie(COOKIE, httponly=True, samesite="strict")
    return response


class TokenIn(Wire):
    """Request body with a new access token."""

    name: Annotated[
        str,
        Field(
            pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._@+-]{0,63}$",
            description="Of a program or a person. The audit list records changes under it.",
            examples=["pipeline"],
        ),
    ]
    scopes: Annotated[list[Scope], Field(min_length=1, max_length=3)]
    spacecraft: Annotated[
        list[Key] | None,
        Field(min_length=1, max_length=200, description="Bind it to these; null: all."),
    ] = None
    days: Annotated[
        int, Field(ge=1, le=access.MAX_DAYS, strict=True, description="Days until it expires.")
    ] = access.DEFAULT_DAYS
    rate_per_s: Annotated[
        float | None, Field(ge=0.001, le=1e6, description="Requests per second; null: no limit.")
    ] = None


TokenName = Annotated[str, Path(max_length=64, description="The `name` of a token.")]


@ClientMethod("tokens")
@router.serves("GET /tokens", OPERATE, Returns("All tokens, without their secrets.", TokenList))
def list_tokens(app: AppDep) -> Response:
    """All tokens, with scopes, spacecraft, expiry and state."""
    return json_response(TokenList(items=app.tokens.all()))


@ClientMethod("create_token", by_place=("name", "scopes"))
@router.serves(
    "POST /tokens",
    OPERATE,
    Returns("The token, and its secret this once.", NewToken, status=201),
    body=TokenIn,
    problems=(409,),
)
def add_token(body: JsonBody, app: AppDep, change: ChangeDep) -> Response:
    """Create an access token; the first one ends open access."""
    asked = read_model(TokenIn, body)
    made = app.tokens.add(**asked.model_dump(), entry=change.entry(201))
    app.access.forget()
    return json_response(made, 201)


@ClientMethod("revoke_token", renamed={"token": "name"})
@router.serves(
    "DELETE /tokens/{token}",
    OPERATE,
    Returns("The token that was revoked.", Token),
    problems=(503,),
)
def revoke_token(token: TokenName, app: AppDep, change: ChangeDep) -> Response:
    """Revoke a token at once, with the browser sessions begun with it."""
    revoked = app.tokens.revoke(token, change.entry())
    app.access.forget()
    return json_response(revoked)


@router.serves("GET /audit", OPERATE, Returns("A page of changes.", AuditPage, LINK))
def list_audit(request: Request, query: FromQuery[AuditQuery], app: AppDep) -> Response:
    """The audit list of changes, newest first."""
    with app.context.reading() as connection:
        page = access.list_entries(connection, **query.asked())
    return page_response(request, page)


def _shown(caller: CallerDep) -> dict[str, object]:
    return {
        "name": caller.name,
        "scopes": sorted(caller.scopes),
        "spacecraft": None if caller.spacecraft is None else sorted(caller.spacecraft),
    }
