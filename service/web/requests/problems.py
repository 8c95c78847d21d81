"""Errors as problems (RFC 9457).

A client's error names the field and the value.  An internal error is logged, and
its answer tells nothing about the inside of the service.
"""

import json
import logging
from collections.abc import Awaitable, Callable, Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from msgspec import convert
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Match

from service import errors
from service.storage.models.base import Problem
from service.web.requests import problem_types as types
from service.web.requests.problem_types import ProblemType

MEDIA_TYPE = "application/problem+json"

log = logging.getLogger(__name__)


FAILED = {"detail": "The service has failed; its log contains the cause."}


def problem_response(
    request: Request,
    kind: ProblemType,
    details: Mapping[str, Any],
    headers: dict[str, str] | None = None,
) -> Response:
    """The response for a problem: its type, the address, and `details` with its `detail`."""
    content = _content(request, kind, details)
    # ASCII only: a client's text may hold lone surrogates, which UTF-8 cannot carry.
    body = json.dumps(content, ensure_ascii=True, separators=(",", ":"))
    return Response(body, kind.status, headers, media_type=MEDIA_TYPE)


def root_path(request: Request) -> str:
    """The path below which a proxy serves the service; empty without one."""
    path: str = getattr(request.app.state, "root_path", "") if "app" in request.scope else ""
    return path


def _content(request: Request, kind: ProblemType, details: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "type": kind.type if kind.slug is None else root_path(request) + kind.type,
        "title": kind.title,
        "status": kind.status,
        "detail": details["detail"],
        "instance": request.url.path,
        **details,
    }


def problem_within(request: Request, error: BaseException) -> Problem:
    """The problem of a part of a request whose other parts are answered."""
    if (
        not isinstance(error, errors.AcquisitionError)
        or types.problem_type_of(error) is types.INTERNAL_ERROR
    ):
        log.error("%s %s failed in part", request.method, request.url.path, exc_info=error)
        return convert(_content(request, types.INTERNAL_ERROR, FAILED), Problem)
    return convert(
        _content(request, types.problem_type_of(error), errors.problem_of(error)), Problem
    )


async def _on_acquisition_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, errors.AcquisitionError)
    kind = types.problem_type_of(error)
    if kind.status == 500:
        return internal_error(request, error)
    return problem_response(request, kind, errors.problem_of(error), _headers_of(error))


def _headers_of(error: errors.AcquisitionError) -> dict[str, str] | None:
    if isinstance(error, errors.Busy | errors.RateLimited):
        return {"Retry-After": str(error.retry_after_s)}
    if isinstance(error, errors.Unauthenticated):
        return {"WWW-Authenticate": 'Bearer realm="attitude acquisition"'}
    return None


def faults_in_query(error: RequestValidationError) -> list[errors.Fault]:
    """The faults of a query, parameter by parameter."""
    return [
        errors.Fault(
            # Below the parameter, `loc` names the form of it that was tried.
            str(each["loc"][min(1, len(each["loc"]) - 1)])[:80],
            str(each["msg"]).removeprefix("Value error, "),
            None if each["type"] == "missing" else errors.shown_value(each["input"]),
        )
        for each in error.errors()
    ]


async def _on_query_fault(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    return problem_response(
        request,
        types.PROBLEM_TYPES[errors.BadInput],
        errors.problem_of_faults(faults_in_query(error)),
    )


async def on_http_error(request: Request, error: Exception) -> Response:
    """The problem of an address or a method that there is not."""
    assert isinstance(error, HTTPException)
    phrase = HTTPStatus(error.status_code).phrase
    headers = dict(error.headers or {})
    detail = error.detail
    if error.status_code == 405:
        headers["Allow"] = ", ".join(_methods_at(request))
        detail = f"{request.method} is not allowed here; allowed: {headers['Allow']}"
    if error.status_code == 404 and detail == phrase:
        detail = "There is nothing at this address; the routes are in /api/v1/openapi.json"
    return problem_response(
        request, ProblemType(error.status_code, phrase), {"detail": detail}, headers
    )


def _methods_at(request: Request) -> list[str]:
    # The router knows the methods of one route only; a path may have several.
    methods: set[str] = set()
    for route in request.app.state.routes:
        match, _ = route.matches(request.scope)
        if match is not Match.NONE:
            methods |= route.methods
    if not methods or "GET" in methods:
        methods |= {"GET", "HEAD"}
    return sorted(methods)


def internal_error(request: Request, error: Exception) -> Response:
    """Log an unexpected error, and answer without details of it."""
    log.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return problem_response(request, types.INTERNAL_ERROR, FAILED)


async def _on_disconnect(request: Request, error: Exception) -> Response:
    # The client has gone.
    return Response(status_code=400)


_HANDLERS: Mapping[type[Exception], Callable[[Request, Exception], Awaitable[Response]]] = {
    errors.AcquisitionError: _on_acquisition_error,
    RequestValidationError: _on_query_fault,
    HTTPException: on_http_error,
    ClientDisconnect: _on_disconnect,
}


def add_error_handlers(app: FastAPI) -> None:
    """Answer every expected error as a problem."""
    for kind, handler in _HANDLERS.items():
        app.add_exception_handler(kind, handler)


async def error_response(request: Request, error: Exception) -> Response:
    """The response to an expected error; any other is raised again."""
    for kind in type(error).__mro__:
        if kind in _HANDLERS:
            return await _HANDLERS[kind](request, error)
    raise error
