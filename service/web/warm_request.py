"""A request before the first client's: code that runs for the first time takes ten times longer."""

import json

from starlette.types import ASGIApp, Message, Scope

WARM_REQUEST = "service.warm_request"
"""Key in the scope of the request that `warm_request` makes; metrics and logs leave it out."""

_PATH = "/api/v1/batches"
# Its form is right, but there is no such spacecraft.
_STARS = [{"vector": [0.0, 0.01 * k, 1.0 - 5e-5 * k * k], "magnitude": 5.0} for k in range(5)]
_BATCH = {
    "spacecraft": "none:warm-up",
    "batch": "warm-up",
    "time": "2000-01-01T00:00:00Z",
    "a_priori": {"quaternion": [0.0, 0.0, 0.0, 1.0]},
    "velocity_km_per_s": [7.5, 0.0, 0.0],
    "observations": [{"tracker": "1", "stars": _STARS}],
}
_BODY = json.dumps(_BATCH).encode()


async def warm_request(app: ASGIApp) -> int:
    """Send the app a batch of an unknown spacecraft; gives the status of the answer.

    It is checked, queued and refused by the writer's thread; where tokens are
    required, by the check of access.
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
        WARM_REQUEST: True,
    }
    status = 0

    async def receive() -> Message:
        return {"type": "http.request", "body": _BODY, "more_body": False}

    async def send(message: Message) -> None:
        nonlocal status
        status = message.get("status", status)

    await app(scope, receive, send)
    return status
