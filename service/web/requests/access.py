"""Access control of routes: required scope and spacecraft, and dependencies of handlers.

A handler declares its policy with its address.  A route without one is refused to every
caller, so a new route cannot be forgotten.

All dependencies are asynchronous: they never wait for a worker thread, because
all of them may be busy when a probe arrives.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar
from urllib.parse import quote

import msgspec
from anyio import CapacityLimiter, fail_after
from anyio.to_thread import run_sync
from fastapi import Depends
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Scope as HttpScope

from service import logs
from service.access import OPEN_CALLER, Access, Caller, Entry
from service.app.factory import App
from service.contract.access import Scope
from service.contract.base import Page
from service.errors import BadBatch, Busy, Fault, Forbidden, NotFound, Unauthenticated
from service.web.requests.metrics import Metrics
from service.web.requests.request_body import JSON

COOKIE = "acquire_session"
SIGN_IN = "/sign-in"
SAFE_METHODS = ("GET", "HEAD")

T = TypeVar("T")
SpacecraftPlace = Literal["nothing", "path", "query", "result", "body", "every"]


@dataclass(frozen=True)
class Policy:
    """Access that a route requires of its caller: scope, and spacecraft named in the request.

    `spacecraft_in` says which part of the request names the spacecraft, for tokens
    bound to some: the `path`; the `query`, which must then name it; the recorded
    `result` of the path; or the `body`, which the handler itself checks with
    `Caller.require`.  `every` is for tokens bound to none; `nothing` is for what
    concerns no spacecraft, or where the handler hides those of others.  `or_scope`
    is accepted in place of the scope.  `open` requires no token.  `audited` marks
    a change of more than the caller's own records.  `without_database` lets in a caller that
    was known before while the database does not answer.
    """

    scope: Scope
    spacecraft_in: SpacecraftPlace = "every"
    or_scope: Scope | None = None
    open: bool = False
    audited: bool = False
    without_database: bool = False

    @property
    def scopes(self) -> tuple[Scope, ...]:
        """Scopes of which the caller must have at least one."""
        return (self.scope,) if self.or_scope is None else (self.scope, self.or_scope)


READ, OPERATE = Policy("read"), Policy("operate")
OPEN = Policy("read", "nothing", open=True)

POLICIES: dict[str, Policy] = {}
"""Policies of all routes by name, declared by their handlers."""

_LINK_NAVIGATION = (
    ("sec-fetch-mode", "navigate"),
    ("sec-fetch-dest", "document"),
    ("sec-fetch-user", "?1"),
)
"""Headers that a browser sends if its user follows a link; scripts and frames send others."""

_CALLER_THREADS = CapacityLimiter(8)
"""Threads for looking up callers, apart from handlers' threads, which may wait for a commit."""
_OWNER_THREADS = CapacityLimiter(8)
_LOOK_UP_S = 1.5
"""Time limit in seconds for looking up a caller in the database: probes are due within 2 s."""


async def authorize(request: Request) -> None:
    """Check the access of a request; raises the error for missing access.

    What a caller with the scope `operate` changes, and what a policy marks as `audited`, gets
    its audit entry with the change (`ChangeDep`), or once it is answered
    (`service.web.middleware`) where it was refused or changed no record.
    """
    route = request.scope["route"]
    policy = POLICIES.get(route.name)
    if policy is None:
        raise Forbidden(f"no policy is known for {route.name}")
    app: App = request.app.state.app
    if policy.open:
        request.state.caller = None
        return
    token, session = credentials(request)
    caller = app.access.cached_caller(token, session)
    try:
        if caller is None:
            try:
                caller = await _within_deadline(app.access, app.access.caller, token, session)
            except Busy:
                if policy.without_database:
                    caller = app.access.last_known_caller(token, session)
                if caller is None:
                    raise
    except Unauthenticated:
        if _is_page(request):
            wanted = quote(
                request.url.path + (f"?{request.url.query}" if request.url.query else "")
            )
            raise HTTPException(
                303, "sign in first", {"Location": f"{SIGN_IN}?next={wanted}"}
            ) from None
        raise
    if caller is OPEN_CALLER:
        _refuse_other_sites(request)
    elif token is None and request.method not in SAFE_METHODS:
        _require_same_origin(request)
    request.state.caller = caller
    if (about := logs.request.get()) is not None:
        about.caller = caller.name
    app.access.count_request(caller)
    require_scope(caller, *policy.scopes)
    if caller.spacecraft is not None:
        await _require_spacecraft_access(request, app, caller, policy.spacecraft_in)
    if (policy.scope == "operate" or policy.audited) and request.method not in SAFE_METHODS:
        request.state.changes = route.name


async def is_open(access: Access) -> bool:
    """True if access is open, asked without blocking the event loop on the database."""
    if access.cached_is_open is not None:
        return access.cached_is_open
    return await _within_deadline(access, lambda: access.is_open)


async def _within_deadline(access: Access, ask: Callable[..., T], *arguments: object) -> T:
    """Run a database look-up in a thread; raises `Busy` on a timeout, or shortly after one."""
    access.require_database()
    try:
        with fail_after(_LOOK_UP_S):
            return await run_sync(ask, *arguments, limiter=_CALLER_THREADS, abandon_on_cancel=True)
    except TimeoutError:
        access.database_timed_out()
        access.require_database()
        raise


async def _caller(request: Request) -> Caller:
    caller = request.state.caller
    assert isinstance(caller, Caller)
    return caller


CallerDep = Annotated[Caller, Depends(_caller)]


def entry_of(scope: HttpScope, access: Access, status: int) -> Entry:
    """Audit entry of a request that is answered with a status."""
    state = scope["state"]
    query = scope["query_string"].decode("latin-1")
    about = scope["path"] + (f"?{query}" if query else "")
    body = state.get("body")
    text = None if not body else body.decode("utf-8", "replace")
    return access.entry(state["caller"].name, state["changes"], about, text, status)


class Change:
    """Author and audit entry of a change, which its handler stores."""

    def __init__(self, request: Request) -> None:
        self._request = request
        self.caller: Caller = request.state.caller

    def author(self, named: str | None) -> str:
        """Name of the caller's token; without tokens, the name given in the request."""
        return author(self.caller, named)

    def entry(self, status: int = 200) -> Entry:
        """Audit entry for a change that is answered with `status`.

        The handler stores it with the change; the middleware then makes no other entry.
        """
        request = self._request
        request.state.noted = True
        return entry_of(request.scope, request.app.state.app.access, status)


async def _change(request: Request) -> Change:
    return Change(request)


ChangeDep = Annotated[Change, Depends(_change)]


def require_scope(caller: Caller, *scopes: Scope) -> None:
    """Raise `Forbidden` unless a caller has one of the scopes."""
    if caller.scopes.isdisjoint(scopes):
        raise Forbidden(
            f"{caller.name} may {', '.join(sorted(caller.scopes))}; "
            f"this needs the scope {' or '.join(scopes)}"
        )


def require_all_spacecraft(caller: Caller) -> None:
    """Raise `Forbidden` if a caller is bound to spacecraft."""
    if caller.spacecraft is not None:
        raise Forbidden(f"{caller.name} is bound to spacecraft; this request is about all of them")


def author(caller: Caller, named: str | None) -> str:
    """Name of the caller's token; without tokens, the name given in the request."""
    if caller.token_id is not None:
        return caller.name
    if named is None:
        raise BadBatch(Fault("who", "is required while access is open: 1 to 64 characters"))
    return named


def credentials(request: Request) -> tuple[str | None, str | None]:
    """Token and session of a request, each None if absent."""
    kind, _, token = request.headers.get("authorization", "").partition(" ")
    is_bearer = kind.lower() == "bearer"
    return token.strip() if is_bearer else None, request.cookies.get(COOKIE)


def _is_page(request: Request) -> bool:
    route = request.scope["route"]
    return not route.include_in_schema and request.method in SAFE_METHODS


def _site(request: Request) -> str | None:
    """Relation of the sending page's site to the service, as in `Sec-Fetch-Site`; None: unknown."""
    site = request.headers.get("sec-fetch-site")
    if site is None and (origin := request.headers.get("origin")) is not None:
        host = request.headers.get("host")
        site = "same-origin" if origin.partition("://")[2] == host else "cross-site"
    return site


def _require_same_origin(request: Request) -> None:
    """Refuse changes from pages of other sites, since a browser sends its cookie to any."""
    if _site(request) != "same-origin":
        raise Forbidden("with a session, only the service's own pages can change something")


def _refuse_other_sites(request: Request) -> None:
    """While access is open, refuse requests from pages of other sites.

    Following a link to a page is allowed.  Programs other than browsers send no site.
    """
    if _site(request) in (None, "same-origin", "none"):
        return
    followed = _is_page(request) and all(
        request.headers.get(name) == value for name, value in _LINK_NAVIGATION
    )
    if not followed:
        raise Forbidden("while access is open, only the service's own pages may send this request")


async def _require_spacecraft_access(
    request: Request, app: App, caller: Caller, place: SpacecraftPlace
) -> None:
    if place == "path":
        caller.require(request.path_params["name"])
    elif place == "query":
        named = request.query_params.getlist("spacecraft")
        for each in named:
            caller.require(each)
        if not named:
            theirs = " or ".join(f"?spacecraft={each}" for each in sorted(caller.spacecraft or ()))
            raise Forbidden(f"{caller.name} must name a spacecraft: {theirs}")
    elif place == "result":
        id = request.path_params["id"]
        owner = await run_sync(app.results.spacecraft_of, id, limiter=_OWNER_THREADS)
        if owner is None or not caller.may_see(owner):
            # Same answer as for an unknown id: probing must not reveal batches of other spacecraft.
            raise NotFound(f"there is no batch with the id {id[:80]!r}")
    elif place == "every":
        require_all_spacecraft(caller)


_JSON = msgspec.json.Encoder()


async def _app(request: Request) -> App:
    app = request.app.state.app
    assert isinstance(app, App)
    return app


async def _metrics(request: Request) -> Metrics:
    metrics = request.app.state.metrics
    assert isinstance(metrics, Metrics)
    return metrics


AppDep = Annotated[App, Depends(_app)]
MetricsDep = Annotated[Metrics, Depends(_metrics)]


def json_response(
    content: Any, status: int = 200, headers: dict[str, str] | None = None
) -> Response:
    """HTTP response with plain values as JSON."""
    return Response(_JSON.encode(content), status, headers, media_type=JSON)


def page_response(request: Request, page: Page[Any]) -> Response:
    """HTTP response with a page of a list; `Link` leads to the next page with the same filters."""
    headers = None
    if page.next_cursor is not None:
        following = request.url.include_query_params(cursor=page.next_cursor)
        headers = {"Link": f'<{following.path}?{following.query}>; rel="next"'}
    content = {"items": page.items, "next_cursor": page.next_cursor}
    return json_response(content, headers=headers)
