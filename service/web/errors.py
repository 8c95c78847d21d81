"""Every error as a problem (RFC 9457): the one place that knows which error has which status.

A client's mistake names the field and the value.  A mistake of ours is
logged, and its answer says nothing of what is inside.
"""

import json
import logging
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Match

from service.errors import (
    AcquisitionError,
    BadInput,
    Busy,
    Conflict,
    Fault,
    KeyReused,
    NotAdmitted,
    NotAllowed,
    NotAvailable,
    NotFound,
    NotNow,
    TooOften,
    problem_of,
    problem_of_faults,
    shown_value,
)

MEDIA_TYPE = "application/problem+json"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Kind:
    """What all problems of one kind share; a `slug` makes a type of its own."""

    status: int
    title: str
    slug: str | None = None

    @property
    def type(self) -> str:
        """The problem's `type`; without a slug the status says all."""
        return "about:blank" if self.slug is None else f"/problems/{self.slug}"


KINDS: dict[type[AcquisitionError], Kind] = {
    BadInput: Kind(422, "The input is refused", "bad-input"),
    NotAvailable: Kind(422, "This is not there yet", "not-available"),
    NotAdmitted: Kind(401, "Nobody is known by this", "not-admitted"),
    NotAllowed: Kind(403, "This is not yours to ask", "not-allowed"),
    TooOften: Kind(429, "Too many requests", "too-often"),
    NotFound: Kind(404, "There is no such thing", "not-found"),
    Conflict: Kind(409, "The batch is recorded with another body", "conflict"),
    NotNow: Kind(409, "It is not in a state for this", "not-now"),
    KeyReused: Kind(422, "The Idempotency-Key is taken by another body", "key-reused"),
    Busy: Kind(503, "The service cannot take this now", "busy"),
}
OUR_FAULT = Kind(500, HTTPStatus(500).phrase)


def kind_of(error: AcquisitionError) -> Kind:
    """The kind of an error: its own, or that of the nearest class above it."""
    return next((KINDS[each] for each in type(error).__mro__ if each in KINDS), OUR_FAULT)


class NotJson(BadInput):
    """A body that is no JSON at all: truncated, empty, in another encoding."""


KINDS[NotJson] = Kind(400, "The body is not JSON", "not-json")


def problem(
    request: Request, kind: Kind, told: Mapping[str, Any], headers: dict[str, str] | None = None
) -> Response:
    """The answer that tells of a problem: what `told` says, with the kind and the address."""
    content: dict[str, object] = {
        "type": kind.type,
        "title": kind.title,
        "status": kind.status,
        "detail": told["detail"],
        "instance": request.url.path,
        **told,
    }
    # ASCII only: a client's text may hold lone surrogates, which UTF-8 cannot carry.
    body = json.dumps(content, ensure_ascii=True, separators=(",", ":"))
    return Response(body, kind.status, headers, media_type=MEDIA_TYPE)


async def _on_acquisition_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, AcquisitionError)
    kind = kind_of(error)
    if kind.status == 500:
        return our_fault(request, error)
    return problem(request, kind, problem_of(error), _headers_of(error))


def _headers_of(error: AcquisitionError) -> dict[str, str] | None:
    if isinstance(error, Busy | TooOften):
        return {"Retry-After": str(error.retry_after_s)}
    if isinstance(error, NotAdmitted):
        return {"WWW-Authenticate": 'Bearer realm="attitude acquisition"'}
    return None


def query_faults(error: RequestValidationError) -> list[Fault]:
    """What is wrong with a query, parameter by parameter."""
    return [
        Fault(
            # What lies below a parameter is which of its forms was tried.
            str(each["loc"][min(1, len(each["loc"]) - 1)])[:80],
            str(each["msg"]).removeprefix("Value error, "),
            None if each["type"] == "missing" else shown_value(each["input"]),
        )
        for each in error.errors()
    ]


async def _on_query_fault(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    return problem(request, KINDS[BadInput], problem_of_faults(query_faults(error)))


async def _on_http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    phrase = HTTPStatus(error.status_code).phrase
    headers = dict(error.headers or {})
    detail = error.detail
    if error.status_code == 405:
        headers["Allow"] = ", ".join(_methods_at(request))
        detail = f"{request.method} does not work here; {headers['Allow']} do"
    if error.status_code == 404 and detail == phrase:
        detail = "There is nothing at this address; the routes are in /api/v1/openapi.json"
    return problem(request, Kind(error.status_code, phrase), {"detail": detail}, headers)


def _methods_at(request: Request) -> list[str]:
    # The router names the methods of the first route it meets; there may be several on one path.
    methods: set[str] = set()
    for route in request.app.state.routes:
        match, _ = route.matches(request.scope)
        if match is not Match.NONE:
            methods |= route.methods
    if not methods or "GET" in methods:
        methods |= {"GET", "HEAD"}
    return sorted(methods)


def our_fault(request: Request, error: Exception) -> Response:
    """Log an error that nobody foresaw, and answer without a word of what is inside."""
    log.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return problem(
        request, OUR_FAULT, {"detail": "The fault is on the service's side; it is logged."}
    )


async def _on_disconnect(request: Request, error: Exception) -> Response:
    # Nobody reads this answer.
    return Response(status_code=400)


_HANDLERS: Mapping[type[Exception], Callable[[Request, Exception], Awaitable[Response]]] = {
    AcquisitionError: _on_acquisition_error,
    RequestValidationError: _on_query_fault,
    HTTPException: _on_http_error,
    ClientDisconnect: _on_disconnect,
}


def add_error_handlers(app: FastAPI) -> None:
    """Let every error that is raised on purpose answer as a problem."""
    for kind, handler in _HANDLERS.items():
        app.add_exception_handler(kind, handler)


async def answer_to(request: Request, error: Exception) -> Response:
    """What the app answers to an error; one that was not raised on purpose is raised again."""
    for kind in type(error).__mro__:
        if kind in _HANDLERS:
            return await _HANDLERS[kind](request, error)
    raise error
