"""Request headers that mean something here."""

from typing import Annotated

from fastapi import Depends
from starlette.requests import Request

from service.errors import BadBatch, Fault, shown_value

MAX_KEY_LENGTH = 255


def _idempotency_key(request: Request) -> str | None:
    keys = request.headers.getlist("Idempotency-Key")
    if not keys:
        return None
    key = keys[0]
    if len(set(keys)) > 1:
        raise BadBatch(Fault("Idempotency-Key", "must stand there once", shown_value(keys)))
    if not (1 <= len(key) <= MAX_KEY_LENGTH and key.isascii() and key.isprintable()):
        message = f"must be 1 to {MAX_KEY_LENGTH} printable ASCII characters"
        raise BadBatch(Fault("Idempotency-Key", message, shown_value(key)))
    return key


IdempotencyKey = Annotated[str | None, Depends(_idempotency_key)]
