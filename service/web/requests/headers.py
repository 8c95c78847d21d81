"""Request headers with a meaning of their own."""

from typing import Annotated

from fastapi import Depends
from starlette.requests import Request

from service.errors import BadBatch, Fault, shown_value


async def idempotency_key(request: Request) -> str | None:
    """The request's key, None without one; raises `BadBatch` where there are several."""
    keys = request.headers.getlist("Idempotency-Key")
    if not keys:
        return None
    key = keys[0]
    if len(set(keys)) > 1:
        raise BadBatch(Fault("Idempotency-Key", "must be sent only once", shown_value(keys)))
    return key


IdempotencyKey = Annotated[str | None, Depends(idempotency_key)]


async def _no_idempotency_key(request: Request) -> None:
    key = request.headers.get("Idempotency-Key")
    if key is not None:
        # Ignored, it would let a client believe that a repeat is harmless.
        message = "belongs to new batches: a what-if that is recorded twice is there twice"
        raise BadBatch(Fault("Idempotency-Key", message, shown_value(key)))


NO_IDEMPOTENCY_KEY = Depends(_no_idempotency_key)
"""For a route where a repeat makes another result."""
