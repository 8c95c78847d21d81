"""Conversion of errors to problem answers (RFC 9457) with status and explanation.

A client's error names the field and the value.  An internal error is logged, and its answer reveals
nothing about the service.
"""

import json
import logging
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
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
from service.contract.problems import Problem
from service.gyro.blocks import SampleTaken
from service.missions.faults import causes, plain_message


@dataclass(frozen=True)
class ProblemType:
    """Common part of all problems of one type; a `slug` gives the type a page of its own.

    The page explains the problem and its remedy.
    """

    status: int
    title: str
    slug: str | None = None
    meaning: str = ""
    remedy: str = ""

    @property
    def type(self) -> str:
        """URI of the problem's `type`; `about:blank` without a page."""
        return "about:blank" if self.slug is None else f"/problems/{self.slug}"


class NotJson(errors.BadInput):
    """Raised for a body that is not JSON: truncated, empty, or in another encoding."""


PROBLEM_TYPES: dict[type[errors.AcquisitionError], ProblemType] = {
    NotJson: ProblemType(
        400,
        "The body is not JSON",
        "not-json",
        "The body is truncated, empty, not JSON, or not in UTF-8. The service used no part of it.",
        "Check that the client sends the whole body. The detail names the place of the first "
        "fault.",
    ),
    errors.BadInput: ProblemType(
        422,
        "Invalid input",
        "bad-input",
        "A field of the body, a parameter of the query or a header has a value that the service "
        "does not accept, or that does not fit the mission. Nothing was recorded.",
        "Correct every field that errors names; each entry has the field, what is expected and "
        "the value that was received. The same request will fail again.",
    ),
    errors.NotAvailable: ProblemType(
        422,
        "Not available",
        "not-available",
        "The value is known, but this version or this installation lacks what it needs.",
        "Choose another value, or ask the operator of the service for the missing part; the "
        "detail names it.",
    ),
    errors.Unauthenticated: ProblemType(
        401,
        "Unauthorized",
        "not-admitted",
        "The request has no token, or one that is unknown, has expired or was revoked. The "
        "service does not say which.",
        "Send the header Authorization: Bearer acq_... with a valid token. On the machine of the "
        "service, acquire token list shows the valid ones and acquire token create makes another. "
        "In a browser, sign in again.",
    ),
    errors.Forbidden: ProblemType(
        403,
        "Forbidden",
        "not-allowed",
        "The token is valid, but lacks the scope of this request or is bound to other spacecraft; "
        "or a page of another site sent the request.",
        "Use a token with the scope that the detail names. A token that is bound to spacecraft "
        "must name one of them.",
    ),
    errors.RateLimited: ProblemType(
        429,
        "Too many requests",
        "too-often",
        "The rate of the token is used up, or all of its ten event streams are in use. An array of "
        "batches counts as many requests as it has batches.",
        "Wait for as many seconds as the header Retry-After says, then send the same request "
        "again.",
    ),
    errors.NotFound: ProblemType(
        404,
        "Not found",
        "not-found",
        "No spacecraft, batch, alarm, run or replay has the name or id in the address, or "
        "the token may not see it.",
        "Check the name in the address. GET /api/v1/spacecraft and GET /api/v1/batches list the "
        "existing ones.",
    ),
    errors.Conflict: ProblemType(
        409,
        "Already recorded with another body",
        "conflict",
        "Spacecraft, run and batch id together identify a batch. A batch with the same three is "
        "already recorded, and its body differs from the one that was sent. The recorded batch "
        "does not change. The same holds for gyro blocks and their names.",
        "Give the new batch another batch id. To process the recorded one with other options, "
        "use a what-if.",
    ),
    SampleTaken: ProblemType(
        409,
        "Time already recorded in another gyro block",
        "sample-taken",
        "A sample of the gyro block has the time of a sample that is recorded in another block of "
        "the spacecraft and the run. The service recorded no part of the block.",
        "The detail names both blocks and the time. If the samples are the recorded ones, leave "
        "them out; if a clock was wrong, correct the times.",
    ),
    errors.WrongState: ProblemType(
        409,
        "The state does not allow this",
        "not-now",
        "The state of the object does not allow the action. For example, an alarm is already "
        "acknowledged or cleared, or is not shelved; a replay has ended; a batch is archived; a "
        "calibration is not done. The detail says what.",
        "Read the object again: another client may have changed it in the meantime.",
    ),
    errors.KeyReused: ProblemType(
        422,
        "The Idempotency-Key was used with another body",
        "key-reused",
        "The same token sent another body with this Idempotency-Key before. Nothing was recorded.",
        "Use a new key for each new body. A batch needs no key: its batch id already makes a "
        "repeat harmless.",
    ),
    errors.Busy: ProblemType(
        503,
        "The service is busy",
        "busy",
        "The service is starting or stopping, its queue is full, or its database does not answer. "
        "The answer does not say whether the request was recorded.",
        "Wait for as many seconds as the header Retry-After says, then send the same request "
        "again. A batch that was recorded after all is not recorded twice.",
    ),
}
WRONG_HOST = ProblemType(
    421,
    "Misdirected request",
    "not-this-host",
    "While access is open, the service answers only requests for a name of its own machine, so "
    "that pages of other sites cannot reach it.",
    "Use localhost or 127.0.0.1 in the address, or create a token: with tokens, every name is "
    "answered.",
)
INTERNAL_ERROR = ProblemType(500, HTTPStatus(500).phrase)


def problem_type_of(error: errors.AcquisitionError) -> ProblemType:
    """Problem type of an error, by its class or the nearest base class."""
    return next(
        (PROBLEM_TYPES[each] for each in type(error).__mro__ if each in PROBLEM_TYPES),
        INTERNAL_ERROR,
    )


def types_with_pages() -> dict[str, ProblemType]:
    """Problem types with a page, by slug, in the order of their statuses."""
    kinds = sorted((*PROBLEM_TYPES.values(), WRONG_HOST), key=lambda kind: kind.status)
    return {kind.slug: kind for kind in kinds if kind.slug is not None}


MEDIA_TYPE = "application/problem+json"

log = logging.getLogger(__name__)


FAILED = {"detail": "The service has failed; its log contains the cause."}


def problem_response(
    request: Request,
    kind: ProblemType,
    details: Mapping[str, Any],
    headers: dict[str, str] | None = None,
) -> Response:
    """HTTP response for a problem: its type, the path, and `details`."""
    content = _content(request, kind, details)
    # ASCII only: a client's text may hold lone surrogates, which UTF-8 cannot carry.
    body = json.dumps(content, ensure_ascii=True, separators=(",", ":"))
    return Response(body, kind.status, headers, media_type=MEDIA_TYPE)


def root_path(request: Request) -> str:
    """Path below which a proxy serves the service; empty without one."""
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
    """Problem of one part of a request whose other parts are answered."""
    if not isinstance(error, errors.AcquisitionError) or problem_type_of(error) is INTERNAL_ERROR:
        log.error("%s %s failed in part", request.method, request.url.path, exc_info=error)
        return convert(_content(request, INTERNAL_ERROR, FAILED), Problem)
    return convert(_content(request, problem_type_of(error), errors.problem_of(error)), Problem)


async def _on_acquisition_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, errors.AcquisitionError)
    kind = problem_type_of(error)
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
    """Faults of the query parameters of a request."""
    return [
        errors.Fault(
            # Below the parameter, `loc` names the form of it that was tried.
            str(each["loc"][min(1, len(each["loc"]) - 1)])[:80],
            plain_message(each),
            None if each["type"] == "missing" else errors.shown_value(each["input"]),
        )
        for each in causes(error.errors())
    ]


async def _on_query_fault(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    return problem_response(
        request,
        PROBLEM_TYPES[errors.BadInput],
        errors.problem_of_faults(faults_in_query(error)),
    )


async def on_http_error(request: Request, error: Exception) -> Response:
    """Problem answer to an HTTP error of the framework, such as an unknown address."""
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
    return problem_response(request, INTERNAL_ERROR, FAILED)


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
    """Register handlers that answer every expected error as a problem."""
    for kind, handler in _HANDLERS.items():
        app.add_exception_handler(kind, handler)


async def error_response(request: Request, error: Exception) -> Response:
    """HTTP response to an expected error; others are raised again."""
    for kind in type(error).__mro__:
        if kind in _HANDLERS:
            return await _HANDLERS[kind](request, error)
    raise error
