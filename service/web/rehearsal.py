"""A post before the first client's: what runs for the first time takes ten times as long."""

import json

from starlette.types import ASGIApp, Message, Scope

REHEARSAL = "service.rehearsal"
"""Stands in the scope of a request that is nobody's, and that is not counted."""

_PATH = "/api/v1/batches"
# Nothing is wrong with its form, but no spacecraft can have a name with a space in it.
_STARS = [{"vector": [0.0, 0.01 * k, 0.999], "magnitude": 5.0} for k in range(5)]
_BATCH = {
    "spacecraft": "no spacecraft",
    "batch": "rehearsal",
    "time": "2000-01-01T00:00:00Z",
    "a_priori": {"quaternion": [0.0, 0.0, 0.0, 1.0]},
    "velocity_km_per_s": [7.5, 0.0, 0.0],
    "observations": [{"tracker": "1", "stars": _STARS}],
}
_BODY = json.dumps(_BATCH).encode()


async def rehearse(app: ASGIApp) -> int:
    """Send the app a batch of nobody's; gives the status of its answer.

    It is checked, goes all the way to the backend and is refused there; where
    tokens are asked for, at the door.
    """
    head = (
        ("host", "localhost"),
        ("content-type", "application/json"),
        ("content-length", str(len(_BODY))),
    )
    scope: Scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "scheme": "http",
        "method": "POST",
        "path": _PATH,
        "raw_path": _PATH.encode(),
        "root_path": "",
        "query_string": b"",
        "headers": [(name.encode(), value.encode()) for name, value in head],
        "client": None,
        "server": None,
        REHEARSAL: True,
    }
    status = 0

    async def receive() -> Message:
        return {"type": "http.request", "body": _BODY, "more_body": False}

    async def send(message: Message) -> None:
        nonlocal status
        status = message.get("status", status)

    await app(scope, receive, send)
    return status
