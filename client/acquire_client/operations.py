"""Client methods that submit a batch or adopt another result of it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import httpx
import msgspec

from . import models
from .calls import Call, model, single_request
from .encoding import Batch, path_of
from .errors import Problem, UnexpectedAnswer
from .retrying import Repeat

T = TypeVar("T")


@dataclass(frozen=True)
class RecordedAnswer:
    """Answer as recorded: its JSON, and True if the batch was recorded before."""

    body: bytes
    replayed: bool

    @cached_property
    def answer(self) -> models.Answer:
        """Decode the recorded answer to a model."""
        try:
            return msgspec.json.decode(self.body, type=models.Answer)
        except msgspec.DecodeError as error:
            raise UnexpectedAnswer(f"this is no answer to a batch: {error}") from None


@dataclass(frozen=True)
class BatchOutcome:
    """Outcome of a submitted batch: its answer, or the problem for which it was refused."""

    batch: Batch
    recorded: RecordedAnswer | None
    problem: Problem | None

    @property
    def answer(self) -> models.Answer:
        """Answer to the batch as a model; raises the problem of a refused one."""
        if self.recorded is None:
            assert self.problem is not None
            raise self.problem
        return self.recorded.answer


class Results:
    """Client methods that submit a batch or adopt another result of it."""

    @single_request
    def submit(self, batch: Batch, *, idempotency_key: str | None = None) -> Call[models.Answer]:
        """Identify the stars of a batch, solve for the attitude, and record both.

        Spacecraft, run and batch id identify the batch: to send it again is harmless, and gives
        the first answer.  Raises `BadInput` naming each field, `Conflict` where another body has
        this batch id.

        >>> answer = client.submit(batch)
        >>> answer.counts.unique, answer.attitude.status
        (4, 'good')
        """
        return _submission(batch, idempotency_key, lambda recorded: recorded.answer)

    @single_request
    def submit_json(
        self, batch: Batch, *, idempotency_key: str | None = None
    ) -> Call[RecordedAnswer]:
        """Submit a batch as `submit` does; the answer as recorded, with `replayed` for a repeat.

        >>> recorded = client.submit_json(batch)
        >>> recorded.replayed
        True
        """
        return _submission(batch, idempotency_key, lambda recorded: recorded)

    @single_request
    def adopt(self, id: str, options: Mapping[str, Any]) -> Call[models.Answer]:
        """Process a recorded batch again, and make the result the batch's current one.

        >>> latest = client.latest("XTE")
        >>> adopted = client.adopt(latest.answer.id, {"identifier": "verified"})
        >>> found = client.batch(adopted.id)
        >>> found.current
        True
        """
        body = {"options": dict(options), "adopt": True}
        return Call(model(models.Answer), "POST", path_of("batches", id, "what-if"), body=body)


def _submission(
    batch: Batch, idempotency_key: str | None, read: Callable[[RecordedAnswer], T]
) -> Call[T]:
    def recorded(response: httpx.Response) -> T:
        is_replayed = response.headers.get("Replayed") == "true"
        return read(RecordedAnswer(response.content, is_replayed))

    headers = {} if idempotency_key is None else {"Idempotency-Key": idempotency_key}
    return Call(
        recorded, "POST", path_of("batches"), body=batch, headers=headers, repeat=Repeat.ALWAYS
    )
