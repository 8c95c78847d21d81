"""Who may use which route.

Every route stands in `POLICIES` under its name: the scope it needs, and where
it says which spacecraft it is about.  A route that does not stand there is
refused to everybody, so a new one cannot be forgotten.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, TypeVar
from urllib.parse import quote

from anyio import CapacityLimiter, fail_after
from anyio.to_thread import run_sync
from fastapi import Depends
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import Scope as HttpScope

from service import logs
from service.errors import NotAdmitted, NotAllowed, NotFound
from service.operations import Operations
from service.records.access import OPEN_CALLER, Access
from service.records.audit import Entry
from service.records.tokens import Caller, Scope

COOKIE = "acquire_session"
SIGN_IN = "/sign-in"
SAFE_METHODS = ("GET", "HEAD")

T = TypeVar("T")
About = Literal["nothing", "path", "query", "result", "body", "every"]


@dataclass(frozen=True)
class Policy:
    """What a route asks of its caller.

    `about` says where the spacecraft stands, for a token that is bound to some:
    in the `path`, in the `query` (which must then name it), in the recorded
    `result` of the path, or in the `body`, which the handler itself checks
    with `Caller.require`; `every` is for tokens that are bound to none, and
    `nothing` for what is about no spacecraft, or where the handler shows a
    caller no other's.  `or_scope` will do as well as the scope.  `open` asks
    for no token.  `noted` is what changes more than records of the caller's own.
    """

    scope: Scope
    about: About = "every"
    or_scope: Scope | None = None
    open: bool = False
    noted: bool = False

    @property
    def scopes(self) -> tuple[Scope, ...]:
        """Those of which one is needed."""
        return (self.scope,) if self.or_scope is None else (self.scope, self.or_scope)


READ, SUBMIT, OPERATE = Policy("read"), Policy("submit"), Policy("operate")
OPEN = Policy("read", "nothing", open=True)

POLICIES: Mapping[str, Policy] = {
    "livez": OPEN,
    "readyz": OPEN,
    "metrics": READ,
    "sign_in_page": OPEN,
    "sign_in": OPEN,
    "sign_out": OPEN,
    "session": Policy("read", "nothing"),
    "submit_batch": Policy("submit", "body"),
    "list_batches": Policy("read", "query"),
    "get_batch": Policy("read", "result"),
    "what_if": Policy("read", "result"),
    "list_spacecraft": Policy("read", "nothing"),
    "get_spacecraft": Policy("read", "path"),
    "submit_frame": Policy("submit", "path"),
    "get_overlay": Policy("read", "result"),
    "list_attitudes": Policy("read", "path"),
    "list_rates": Policy("read", "path"),
    "get_history": Policy("read", "path"),
    "list_worst": Policy("read", "path"),
    "get_advice": Policy("read", "path"),
    "advice_page": Policy("read", "path"),
    "list_zones": READ,
    "warm_zones": Policy("operate", "body"),
    "drop_zones": Policy("operate", "query"),
    "list_runs": READ,
    "start_replay": Policy("submit", "body"),
    "list_replays": READ,
    # Its id can be known only from having started it, or from somebody who may read everything:
    # see `lone_ulid`.
    "get_replay": Policy("read", "nothing", or_scope="submit"),
    # Of tokens that are bound to spacecraft only the one that started it: see the handler.
    "cancel_replay": Policy("submit", "nothing", noted=True),
    "watch_run": Policy("submit", noted=True),
    "compare": Policy("read", "body"),
    "list_limits": Policy("read", "path"),
    "get_limit": Policy("read", "path"),
    "set_limit": Policy("operate", "path"),
    "reset_limit": Policy("operate", "path"),
    "list_alarms": Policy("read", "query"),
    "get_alarm": Policy("read", "nothing"),
    "acknowledge_alarm": Policy("operate", "nothing"),
    "shelve_alarm": Policy("operate", "nothing"),
    "unshelve_alarm": Policy("operate", "nothing"),
    "comment_alarm": Policy("operate", "nothing"),
    "get_about": Policy("read", "nothing"),
    "get_overview": Policy("read", "nothing"),
    "events": Policy("read", "query"),
    "list_audit": OPERATE,
    "overview_page": Policy("read", "nothing"),
    "spacecraft_page": Policy("read", "path"),
    "latest_batch": Policy("read", "path"),
    "batches_page": Policy("read", "nothing"),
    "batch_page": Policy("read", "result"),
    "alarms_page": Policy("read", "nothing"),
    "alarm_page": Policy("read", "nothing"),
    "limits_page": Policy("read", "path"),
    "compare_page": Policy("read", "nothing"),
    "zones_page": READ,
    "missions_page": Policy("read", "nothing"),
    "runs_page": READ,
    "replay_page": READ,
    "about_page": Policy("read", "nothing"),
}

_FOLLOWED_LINK = (
    ("sec-fetch-mode", "navigate"),
    ("sec-fetch-dest", "document"),
    ("sec-fetch-user", "?1"),
)
"""What a browser sends where its user has followed a link, and not a script or a frame."""

_THREADS = CapacityLimiter(8)
"""Their own: a handler may wait for a commit, and who asks shall not wait for that."""
_OWNERS = CapacityLimiter(8)
_KNOWN_WITHIN_S = 1.5
"""A look at the database that takes longer will not tell who asks: probes are due within 2 s."""


async def guard(request: Request) -> None:
    """Let a request through to its handler, or raise what it lacks.

    What a caller with the scope `operate` changes, and what a policy says is
    `noted`, is noted with the change (`Audited`), or once it is answered
    (`service.web.middleware`) where it was refused or changed no record.
    """
    route = request.scope["route"]
    policy = POLICIES.get(route.name)
    if policy is None:
        raise NotAllowed(f"no policy is known for {route.name}")
    operations: Operations = request.app.state.operations
    if policy.open:
        request.state.caller = None
        return
    token, session = credentials(request)
    caller = operations.access.known(token, session)
    try:
        if caller is None:
            caller = await _in_time(operations.access, operations.access.caller, token, session)
    except NotAdmitted:
        if _is_page(request):
            wanted = quote(
                request.url.path + (f"?{request.url.query}" if request.url.query else "")
            )
            raise HTTPException(
                303, "sign in first", {"Location": f"{SIGN_IN}?next={wanted}"}
            ) from None
        raise
    if caller is OPEN_CALLER:
        _refuse_pages_of_other_sites(request)
    elif token is None and request.method not in SAFE_METHODS:
        _require_own_page(request)
    request.state.caller = caller
    if (about := logs.request.get()) is not None:
        about.caller = caller.name
    operations.access.take_turn(caller)
    require_scope(caller, *policy.scopes)
    if caller.spacecraft is not None:
        await _require_own(request, operations, caller, policy.about)
    if (policy.scope == "operate" or policy.noted) and request.method not in SAFE_METHODS:
        request.state.changes = route.name


async def is_open(access: Access) -> bool:
    """`Access.is_open`, without a wait for the database in the event loop."""
    if access.known_open is not None:
        return access.known_open
    return await _in_time(access, lambda: access.is_open)


async def _in_time(access: Access, ask: Callable[..., T], *given: object) -> T:
    """What a function finds in the database; raises `Busy` where that takes long, or just did."""
    access.require_within_reach()
    try:
        with fail_after(_KNOWN_WITHIN_S):
            return await run_sync(ask, *given, limiter=_THREADS, abandon_on_cancel=True)
    except TimeoutError:
        access.out_of_reach()
        access.require_within_reach()
        raise


async def _caller(request: Request) -> Caller:
    caller = request.state.caller
    assert isinstance(caller, Caller)
    return caller


Asking = Annotated[Caller, Depends(_caller)]


def entry_of(scope: HttpScope, access: Access, status: int) -> Entry:
    """What the audit list is to say of a request that is answered with this status."""
    state = scope["state"]
    query = scope["query_string"].decode("latin-1")
    about = scope["path"] + (f"?{query}" if query else "")
    body = state.get("body")
    text = None if not body else body.decode("utf-8", "replace")
    return access.entry(state["caller"].name, state["changes"], about, text, status)


class Auditing:
    """Gives a handler the entry that becomes part of the change it makes."""

    def __init__(self, request: Request) -> None:
        self._request = request

    def entry(self, status: int = 200) -> Entry:
        """The entry for a change that is answered with this status.

        For the operation that makes the change: nothing more is noted of it then.
        """
        request = self._request
        request.state.noted = True
        return entry_of(request.scope, request.app.state.operations.access, status)


async def _auditing(request: Request) -> Auditing:
    return Auditing(request)


Audited = Annotated[Auditing, Depends(_auditing)]


def require_scope(caller: Caller, *scopes: Scope) -> None:
    """Raise `NotAllowed` unless a caller has one of the scopes."""
    if caller.scopes.isdisjoint(scopes):
        raise NotAllowed(
            f"{caller.name} may {', '.join(sorted(caller.scopes))}; "
            f"this needs the scope {' or '.join(scopes)}"
        )


def require_unbound(caller: Caller) -> None:
    """Raise `NotAllowed` where a caller is bound to spacecraft."""
    if caller.spacecraft is not None:
        raise NotAllowed(f"{caller.name} is bound to spacecraft, and this is about all of them")


def bearer(request: Request) -> str | None:
    """The token in the header, if there is one."""
    kind, _, token = request.headers.get("authorization", "").partition(" ")
    return token.strip() if kind.lower() == "bearer" else None


def credentials(request: Request) -> tuple[str | None, str | None]:
    """The token and the session that a request shows, each None where there is none."""
    return bearer(request), request.cookies.get(COOKIE)


def _is_page(request: Request) -> bool:
    route = request.scope["route"]
    return not route.include_in_schema and request.method in SAFE_METHODS


def _site(request: Request) -> str | None:
    """Where the page stands that had a browser ask, as `Sec-Fetch-Site` says; None: not told."""
    site = request.headers.get("sec-fetch-site")
    if site is None and (origin := request.headers.get("origin")) is not None:
        host = request.headers.get("host")
        site = "same-origin" if origin.partition("://")[2] == host else "cross-site"
    return site


def _require_own_page(request: Request) -> None:
    """A browser sends its cookie by itself: a page elsewhere must not have things changed by it."""
    if _site(request) != "same-origin":
        raise NotAllowed("a session changes things from the service's own pages alone")


def _refuse_pages_of_other_sites(request: Request) -> None:
    """While access is open, a page elsewhere must not have the service work either.

    Its reader may follow a link to a page.  Programs that are no browsers say nothing of sites.
    """
    if _site(request) in (None, "same-origin", "none"):
        return
    followed = _is_page(request) and all(
        request.headers.get(name) == value for name, value in _FOLLOWED_LINK
    )
    if not followed:
        raise NotAllowed("while access is open, the service's own pages alone may ask for this")


async def _require_own(
    request: Request, operations: Operations, caller: Caller, about: About
) -> None:
    if about == "path":
        caller.require(request.path_params["name"])
    elif about == "query":
        named = request.query_params.getlist("spacecraft")
        for each in named:
            caller.require(each)
        if not named:
            theirs = " or ".join(f"?spacecraft={each}" for each in sorted(caller.spacecraft or ()))
            raise NotAllowed(f"{caller.name} must say which spacecraft: {theirs}")
    elif about == "result":
        id = request.path_params["id"]
        owner = await run_sync(operations.spacecraft_of, id, limiter=_OWNERS)
        if owner is None or not caller.may_see(owner):
            # As if it were not there: ids of others are not to be tried out.
            raise NotFound(f"there is no batch with the id {id[:80]!r}")
    elif about == "every":
        require_unbound(caller)
