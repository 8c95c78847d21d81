"""Request headers with a meaning of their own."""

from typing import Annotated, Any

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


def _no_idempotency_key(message: str) -> Any:
    async def require_none(request: Request) -> None:
        key = request.headers.get("Idempotency-Key")
        if key is not None:
            # Ignored, it would let a client believe something of it.
            raise BadBatch(Fault("Idempotency-Key", message, shown_value(key)))

    return Depends(require_none)


NO_IDEMPOTENCY_KEY = _no_idempotency_key(
    "belongs to new batches: a what-if that is recorded twice is there twice"
)
"""For a route where a repeat makes another result."""
NO_KEY_OF_MANY = _no_idempotency_key(
    "belongs to one batch: of an array, each batch is recognised by its own batch id"
)
"""For a route that takes several batches."""
NO_KEY_OF_A_BLOCK = _no_idempotency_key(
    "belongs to batches: a gyro block is recognised by its own name"
)
"""For a route that takes gyro blocks."""
