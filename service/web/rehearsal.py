"""A post before the first client's: what runs for the first time takes ten times as long."""

from starlette.types import ASGIApp, Message, Scope

REHEARSAL = "service.rehearsal"
"""Stands in the scope of a request that is nobody's, and that is not counted."""

_PATH, _BODY = "/api/v1/batches", b"{}"


async def rehearse(app: ASGIApp) -> int:
    """Send the app an empty batch; gives the status of its answer.

    It goes all the way to the backend and is refused there; where tokens are
    asked for, at the door.
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
